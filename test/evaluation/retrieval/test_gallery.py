"""The pictures show what was answered, north up, and are chosen by a rule."""

from __future__ import annotations

import base64
import io

import numpy as np
from PIL import Image

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.evaluation.retrieval.gallery import Picture, choose, gallery, top_view
from crossloc3d_ros.evaluation.retrieval.predictions import About, Predictions

CORNER = np.array([[0.8, 0.6, 0.3]] * 4, np.float32)
"""Something in the north-east of a place."""


def lit(picture: np.ndarray) -> tuple[float, float]:
    """Return where the picture is brightest: share from the left and from the top."""
    rows, columns = np.nonzero(picture.sum(axis=2) > 300)
    return columns.mean() / picture.shape[1], rows.mean() / picture.shape[0]


def decoded(picture: Picture) -> np.ndarray:
    content = base64.b64decode(picture.data_uri.split(",", 1)[1])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def test_north_is_up_and_east_is_right() -> None:
    across, down = lit(top_view(CORNER, 50.0))
    assert (round(across, 1), round(down, 1)) == (0.9, 0.2)


def test_the_highest_point_wins() -> None:
    low, high = np.array([[0.0, 0.0, 0.02]], np.float32), np.array([[0.0, 0.0, 0.5]], np.float32)
    both = top_view(np.concatenate([high, low]), 50.0)
    np.testing.assert_array_equal(both, top_view(high, 50.0))
    assert both.max() > top_view(low, 50.0).max()


def test_points_off_the_picture_are_left_out() -> None:
    far = np.array([[1.4, 0.0, 0.3], [np.float32(1.0), -1.2, 0.3]], np.float32)
    assert len(np.unique(top_view(far, 50.0).reshape(-1, 3), axis=0)) == 1


def test_the_choice_is_by_lot_and_always_the_same() -> None:
    right = np.random.default_rng(0).random(100) < 0.7
    hits, misses = choose(right, 4)
    assert (len(hits), len(misses)) == (4, 4)
    assert right[hits].all()
    assert not right[misses].any()
    again = choose(right, 4)
    np.testing.assert_array_equal(again[0], hits)
    assert len(choose(np.ones(3, np.bool_), 4)[0]) == 3
    assert len(choose(np.ones(3, np.bool_), 4)[1]) == 0


def test_frames_and_captions_say_what_is_right() -> None:
    heading = 1.2
    queries = PlaceSet([rotate_about_z(CORNER, -heading)], np.zeros(1, np.int64), np.zeros((1, 2)), np.array([heading]))
    places = PlaceSet(
        [CORNER] * 3, np.array([0, 0, 1]), np.array([[30.0, 40.0], [0.0, 400.0], [0.0, 0.0]]), np.zeros(3)
    )
    ground = PlaceSet([rotate_about_z(CORNER, 0.5)], np.zeros(1, np.int64), np.array([[0.0, 8.0]]), np.array([-0.5]))
    towns = EvaluationSet("t", queries, places, ground, ("old_town 1", "new_town 2"), ("a", "b"))
    about = About("t", towns.fingerprint(), "w", "e", "aerial+ground", "random")
    ids = np.array([[0, 1, 2, 3]])
    made = Predictions(about, ids, np.zeros((1, 4), np.float32), np.zeros((1, 4), np.int64))
    (row,), wrong = gallery(made, towns, 50.0)
    assert wrong == []
    assert row.query.right is None
    assert [answer.right for answer in row.places] == [True, False, False, True]
    assert [answer.caption for answer in row.places] == ["50 m", "400 m", "in new town 2", "8 m, scan"]
    # Scans are drawn north up by their true heading, so the corner lies where the submaps have it.
    for picture in (row.query, *row.places):
        np.testing.assert_allclose(lit(decoded(picture)), lit(top_view(CORNER, 50.0)), atol=0.02)
