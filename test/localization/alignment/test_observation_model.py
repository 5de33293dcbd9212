"""The observation model: classes cell by cell, shares that are known, files that are none."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from safetensors.numpy import save_file

from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS
from crossloc3d_ros.localization.alignment.observation_model import (
    CLASSES,
    HEIGHTS_M,
    HOLE,
    MARGIN_CELLS,
    MEASURES,
    PATTERNS,
    SUPPORT_BOUNDS,
    UNKNOWN,
    ObservationModel,
    fit_log_ratios,
    surface_classes,
)
from crossloc3d_ros.types import Float32Array

STEPS = len(HEIGHTS_M) + 1


def heights(seed: int, holes: float = 0.1, size: int = 24) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return a terrain, a surface with roofs and crowns, with holes in both, and lowest echoes."""
    rng = np.random.default_rng(seed)
    terrain = rng.normal(3.0, 0.1, (size, size))
    above = np.kron(rng.choice([0.0, 0.8, 4.0, 7.0, 13.0], (size // 4, size // 4)), np.ones((4, 4)))
    above += rng.exponential(1.5, (size, size)) * (rng.random((size, size)) < 0.3)
    above += rng.normal(0.0, 0.01, (size, size))  # no mean lies on a bound between two classes
    surface = terrain + above
    surface[rng.random((size, size)) < holes] = np.nan
    terrain[rng.random((size, size)) < holes / 4] = np.nan
    lowest = np.where(rng.random((size, size)) < 0.05, np.fmin(terrain, surface), surface)
    return terrain.astype(np.float32), surface.astype(np.float32), lowest.astype(np.float32)


def in_a_hole(known: npt.NDArray[np.bool_], i: int, j: int) -> bool:
    """Say whether no disc of 20 m that holds the cell is free of known ones, wherever it lies."""
    places = np.argwhere(known)
    offsets = np.stack(np.meshgrid(np.arange(-20, 21), np.arange(-20, 21)), -1).reshape(-1, 2)
    middles = np.array([i, j]) + offsets[(offsets**2).sum(axis=1) <= 20**2]
    return bool((((middles[:, None] - places[None]) ** 2).sum(axis=2).min(axis=1) <= 20**2).all())


def is_covered(known: npt.NDArray[np.bool_], i: int, j: int) -> bool:
    """Say whether every square of 5 x 5 cells that holds the cell, off the array or not, touches a known one."""
    padded = np.pad(known, 4)  # a square that reaches off the array may touch nothing there
    off = np.pad(np.zeros_like(known), 4, constant_values=True)
    for r in range(i, i + 5):
        for c in range(j, j + 5):
            middle_is_off = off[r + 2, c + 2]
            if not middle_is_off and not padded[r : r + 5, c : c + 5].any():
                return False
    return True


def support_by_hand(known: npt.NDArray[np.bool_], i: int, j: int) -> int:
    """Return how many of the bounds the share of covered cells with an echo around a cell falls short of."""
    rows, columns = range(len(known))[max(i - 5, 0) : i + 6], range(len(known))[max(j - 5, 0) : j + 6]
    covered = sum(is_covered(known, r, c) for r in rows for c in columns)
    share = known[rows.start : rows.stop, columns.start : columns.stop].sum() / max(covered, 1)
    return int(2 - np.digitize(share + 1e-5, SUPPORT_BOUNDS))


def gaps_filled(above: Float32Array) -> Float32Array:
    """Return the heights with each gap at the mean of its neighbours, up to three times where echoes are sparse."""
    was_known, filled = np.isfinite(above), above.copy()
    for step in range(3):
        before = filled.copy()
        for i, j in np.argwhere(~np.isfinite(before)):
            around = before[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
            sparse = is_covered(was_known, i, j) and support_by_hand(was_known, i, j) >= step
            if np.isfinite(around).any() and (sparse if step else in_a_hole(was_known, i, j)):
                filled[i, j] = np.nanmean(around)
    return filled


def class_by_hand(
    above: Float32Array, was_known: npt.NDArray[np.bool_], reached: npt.NDArray[np.bool_], i: int, j: int
) -> int:
    """Return the class of one cell from its neighbours."""
    if not math.isfinite(above[i, j]):
        return HOLE if in_a_hole(was_known, i, j) else UNKNOWN

    def around(values: npt.NDArray[Any], reach: int) -> npt.NDArray[Any]:
        return values[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1]

    beside = around(above, 1)
    here, low, high = (
        sum(v >= step for step in HEIGHTS_M) for v in (above[i, j], np.nanmin(beside), np.nanmax(beside))
    )
    openness = next((reach for reach in range(3) if around(reached, reach).any()), 3)
    pattern = ((here * STEPS + low) * STEPS + high) * 4 + openness
    return int(support_by_hand(was_known, i, j) * PATTERNS + pattern)


@pytest.mark.parametrize("holes", [0.02, 0.2, 0.7])
def test_classes_are_those_of_each_cell_s_neighbours(holes: float) -> None:
    terrain, surface, lowest = heights(1, holes)
    classes = surface_classes(terrain, surface, lowest)
    above = surface - terrain
    filled, known, reached = gaps_filled(above), np.isfinite(above), lowest - terrain < 1.0
    expected = [[class_by_hand(filled, known, reached, i, j) for j in range(24)] for i in range(24)]
    np.testing.assert_array_equal(classes, expected)
    assert len(np.unique(classes)) > 50
    assert (classes[np.isnan(filled)] >= HOLE).all()
    assert (classes[~known] < HOLE).any()
    assert set(np.unique(classes[classes < HOLE] // PATTERNS)) <= {0.02: {0, 1}, 0.2: {0, 1, 2}, 0.7: {2}}[holes]
    assert 0 <= classes.min() <= classes.max() < CLASSES


def test_houses_are_told_from_trees_by_what_gets_through() -> None:
    terrain = np.full((40, 40), 2.0, np.float32)
    surface = terrain.copy()
    surface[10:30, 10:30] = 9.0
    house = surface_classes(terrain, surface, surface)
    lowest = surface.copy()
    lowest[10:30:3, 10:30:3] = 2.0
    tree = surface_classes(terrain, surface, lowest)
    inside = (slice(13, 27), slice(13, 27))
    assert (house[inside] % 4 == 3).all() and (tree[inside] % 4 < 2).all()
    assert (house[11:29, 11] % 4 == 2).all() and (house[10:30, 10] % 4 == 1).all(), "beside the open it is not so sure"
    np.testing.assert_array_equal(house[:8], tree[:8])
    shipped = ObservationModel.load().log_ratios
    looked_through = slice(LAYERS, CHANNELS - 1)  # up to 6 m
    lower = shipped[looked_through, house[20, 20]] - shipped[looked_through, tree[20, 20]]
    assert (lower < -0.05).all() and (lower[:2] < -0.3).all()
    assert (shipped[looked_through, house[20, 20]] < -0.8).all()


def test_a_cell_s_class_depends_on_no_more_than_the_margin() -> None:
    rasters = heights(5, size=200)
    rasters[1][60:90, 20:190] = np.nan  # a canal
    rasters[1][120:180, 100:170] = np.nan  # more than a hole
    whole = surface_classes(*rasters)
    for start, stop in ((30, 150), (75, 200)):
        part, inner = slice(start, stop), slice(MARGIN_CELLS, stop - start - MARGIN_CELLS)
        classes = surface_classes(*(values[part, part] for values in rasters))
        np.testing.assert_array_equal(classes[inner, inner], whole[part, part][inner, inner])


def test_a_canal_is_a_hole_and_what_was_not_flown_over_is_none() -> None:
    terrain, surface = (np.full((160, 160), height, np.float32) for height in (3.0, 3.1))
    surface[50:80] = np.nan
    surface[:, 130:] = np.nan
    classes = surface_classes(terrain, surface, surface)
    assert (classes[51:79, 30:100] == HOLE).all()
    assert (classes[:, 130:] == UNKNOWN).all()
    wide = surface.copy()
    wide[40:90] = np.nan
    assert (surface_classes(terrain, wide, wide)[62:68] == UNKNOWN).all(), "50 m without an echo may be anything"


def test_of_a_map_without_terrain_nothing_is_known() -> None:
    terrain, surface, lowest = heights(1)
    assert (surface_classes(np.full_like(terrain, np.nan), surface, lowest) == UNKNOWN).all()
    assert (surface_classes(terrain, np.full_like(surface, np.nan), lowest) == UNKNOWN).all()


CLOSED = np.append(np.arange(HOLE) % 4 >= 2, np.zeros(CLASSES - HOLE, np.bool_))


def test_known_shares_are_recovered() -> None:
    rng = np.random.default_rng(0)
    share = rng.uniform(0.05, 0.6, (LAYERS, CLASSES))
    beams = rng.integers(200_000, 400_000, (LAYERS, CLASSES)).astype(float)
    here = np.concatenate([share * beams, (1.0 - share) * beams])
    elsewhere = here * np.where(CLOSED, rng.uniform(1.0, 9.0, CLASSES), 1.0)
    full, ratios, hit_share = fit_log_ratios(here, elsewhere)
    overall = (share * beams).sum(axis=1) / beams.sum(axis=1)
    known = np.arange(CLASSES) != UNKNOWN
    p = np.exp(ratios[:LAYERS]) * overall[:, None]
    np.testing.assert_allclose(p[:, known], share[:, known], rtol=0.02)
    np.testing.assert_allclose(
        (1.0 - np.exp(ratios[LAYERS:]) * (1.0 - overall[:, None]))[:, known], share[:, known], rtol=0.02
    )
    seen, others = (counts[:LAYERS] + counts[LAYERS:] for counts in (here, elsewhere))
    rarer = np.log(seen / seen.sum(axis=1, keepdims=True) * others.sum(axis=1, keepdims=True) / others)
    refuting = np.where(CLOSED & known, np.clip(rarer, -1.0, 0.0), 0.0)
    assert (rarer[:, CLOSED] < -1.0).any()
    np.testing.assert_allclose(full, np.clip(ratios + np.tile(refuting, (2, 1)), -3.0, 3.0), atol=0.02)
    assert (ratios[:, UNKNOWN] == 0.0).all() and (full[:, UNKNOWN] == 0.0).all()
    np.testing.assert_allclose(hit_share, overall, rtol=1e-9)


def test_a_class_that_was_hardly_seen_says_little_and_none_says_too_much() -> None:
    here = np.zeros((CHANNELS, CLASSES))
    here[:LAYERS, 0], here[LAYERS:, 0] = 1e6, 1e6
    here[0, 1] = 2.0  # two hits of two beams
    here[0, 4] = 1e9
    here[LAYERS, 5] = 1e9
    elsewhere = here.copy()
    elsewhere[0, 6] = 3.0  # inside of something, where elsewhere three beams came
    full, ratios, _ = fit_log_ratios(here, elsewhere)
    assert 0.0 < ratios[0, 1] < 0.1
    assert -0.1 < full[0, 6] < 0.0
    assert max(np.abs(ratios).max(), np.abs(full).max()) <= 3.0
    np.testing.assert_allclose(ratios[:, 6:PATTERNS], 0.0, atol=1e-6)


def test_a_pattern_that_is_rare_in_sparse_surveys_is_taken_as_in_dense_ones() -> None:
    here = np.zeros((CHANNELS, CLASSES))
    here[:LAYERS, 0], here[LAYERS:, 0] = 1e6, 1e6
    here[:LAYERS, 7], here[LAYERS:, 7] = 9e5, 1e5  # mostly hit where echoes are dense
    here[:LAYERS, 2 * PATTERNS + 7] = 1.0
    here[:LAYERS, PATTERNS + 7], here[LAYERS:, PATTERNS + 7] = 1e4, 9e4  # and not in between, as is well known
    _, ratios, _ = fit_log_ratios(here, here)
    assert ratios[0, 2 * PATTERNS + 7] == pytest.approx(ratios[0, 7], abs=0.2)
    assert ratios[0, PATTERNS + 7] < -1.0


def test_expectations_are_the_means_under_either_hypothesis() -> None:
    rng = np.random.default_rng(0)
    here = rng.uniform(1e6, 1e7, (CHANNELS, CLASSES))
    full, ratios, hit_share = fit_log_ratios(here, here)
    shipped = ObservationModel(full, ratios, hit_share, np.zeros(len(MEASURES) + 1))
    at_true, of_others = shipped.expectations
    p = here[:LAYERS] / (here[:LAYERS] + here[LAYERS:])
    q = here[:LAYERS].sum(axis=1, keepdims=True) / (here[:LAYERS] + here[LAYERS:]).sum(axis=1, keepdims=True)
    known = np.arange(CLASSES) != UNKNOWN
    for found, share in ((at_true, p), (of_others, np.broadcast_to(q, p.shape))):
        mean = share * full[:LAYERS] + (1.0 - share) * full[LAYERS:]
        np.testing.assert_allclose(found[:, known], mean[:, known], atol=0.01)
    open_ = known & ~CLOSED
    assert (at_true[:, open_] >= -1e-4).all() and (of_others[:, open_] <= 1e-4).all(), "Kullback-Leibler divergences"


@pytest.mark.parametrize("never", ["a hit", "free space", "anything"])
def test_a_layer_in_which_nothing_happened_says_nothing(never: str) -> None:
    here = np.random.default_rng(0).uniform(1, 100, (CHANNELS, CLASSES))
    if never in ("a hit", "anything"):
        here[LAYERS - 1] = 0.0
    if never in ("free space", "anything"):
        here[CHANNELS - 1] = 0.0
    full, ratios, hit_share = fit_log_ratios(here, here)
    for values in (full, ratios):
        assert np.isfinite(values).all()
        np.testing.assert_allclose(values[[LAYERS - 1, CHANNELS - 1]], 0.0, atol=1e-6)
        assert np.abs(values[0]).max() > 0.1
    assert ((hit_share > 0.0) & (hit_share < 1.0)).all()


def model(seed: int = 0) -> ObservationModel:
    rng = np.random.default_rng(seed)
    ratios = rng.uniform(-3, 3, (2, CHANNELS, CLASSES)).astype(np.float32)
    return ObservationModel(ratios[0], ratios[1], rng.uniform(0, 1, LAYERS), rng.uniform(0, 9, len(MEASURES) + 1))


def test_a_model_comes_back_from_its_file_as_it_was(tmp_path: Path) -> None:
    made, path = model(), tmp_path / "model.safetensors"
    made.save(path)
    read = ObservationModel.load(path)
    np.testing.assert_array_equal(read.log_ratios, made.log_ratios)
    np.testing.assert_array_equal(read.search_ratios, made.search_ratios)
    np.testing.assert_array_equal(read.hit_share, made.hit_share)
    np.testing.assert_array_equal(read.weights, made.weights)


def test_the_log_likelihood_is_the_weighted_sum_of_the_measures_and_a_constant() -> None:
    weighing = dataclasses.replace(model(), weights=np.array([2.0, 3.0, 5.0, -7.0]))
    found = weighing.log_likelihood(np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 2.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(found, [-5.0, 7.0, -7.0])
    assert (ObservationModel.load().weights[:-1] >= 0.0).all(), "what fits better is never less likely"


def test_the_shipped_model_knows_that_beams_hit_walls() -> None:
    shipped = ObservationModel.load()
    street, roof = 0, ((4 * STEPS + 4) * STEPS + 4) * 4 + 3  # all below 0.4 m; all between 5 and 10 m, and closed
    edge = ((4 * STEPS + 0) * STEPS + 4) * 4 + 1  # beside the ground
    assert np.isfinite(shipped.log_ratios).all()
    assert (shipped.log_ratios[: LAYERS - 1, edge] > 0.5).all()
    assert (shipped.log_ratios[:LAYERS, street] < 0.0).all()
    assert (shipped.log_ratios[LAYERS : CHANNELS - 1, roof] < -0.5).all(), "beams pass through no house"


@pytest.mark.parametrize(
    "damage",
    [
        "missing",
        "empty",
        "text",
        "cut",
        "other shape",
        "no measures",
        "other measures",
        "NaN",
        "too steep",
        "weights",
        "share",
        "folder",
    ],
)
def test_a_file_that_is_no_model_is_named(tmp_path: Path, damage: str) -> None:
    path = tmp_path / f"{damage}.safetensors"
    made = model()
    if damage == "empty":
        path.touch()
    elif damage == "text":
        path.write_text("no model")
    elif damage == "cut":
        made.save(path)
        path.write_bytes(path.read_bytes()[:-1000])
    elif damage == "other shape":
        save_file(
            {
                "log_ratios": made.log_ratios[:, :-1].copy(),
                "search_ratios": made.search_ratios,
                "hit_share": made.hit_share,
                "weights": made.weights,
            },
            path,
            {"measures": json.dumps(MEASURES)},
        )
    elif damage == "no measures":
        save_file({name: getattr(made, name) for name in ("log_ratios", "search_ratios", "hit_share", "weights")}, path)
    elif damage == "other measures":
        made.save(path)
        tensors = {name: getattr(made, name) for name in ("log_ratios", "search_ratios", "hit_share", "weights")}
        save_file(tensors, path, {"measures": json.dumps(["score"])})
    elif damage == "NaN":
        made.log_ratios[2, 5] = np.nan
        made.save(path)
    elif damage == "too steep":
        made.search_ratios[2, 5] = 50.0
        made.save(path)
    elif damage == "weights":
        dataclasses.replace(made, weights=made.weights * np.inf).save(path)
    elif damage == "share":
        dataclasses.replace(made, hit_share=np.zeros(LAYERS)).save(path)
    elif damage == "folder":
        path.mkdir()
    with pytest.raises(CrossLocError, match="is not an observation model of this version") as raised:
        ObservationModel.load(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)
