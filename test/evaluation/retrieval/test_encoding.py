"""Descriptors are encoded once, whatever happens in between."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.datasets.place_sets import PlaceSet
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.evaluation.retrieval.encoding import (
    CHUNK_CLOUDS,
    EncodingJob,
    encode_places,
    north_angles,
    time_queries,
)
from crossloc3d_ros.training.handcrafted import ScanContext


class Counting:
    """Encodes the mean of the points and counts the clouds; may be told to fail after some."""

    preprocessing = PreprocessingConfig()
    descriptor_size = 3

    def __init__(self, fingerprint: str = "counting", fail_after: float = float("inf")) -> None:
        self.fingerprint = fingerprint
        self.clouds = 0
        self.fail_after = fail_after

    def encode(self, points: np.ndarray) -> np.ndarray:
        return self.encode_batch([points])[0]

    def encode_batch(self, clouds: list[np.ndarray]) -> np.ndarray:
        self.clouds += len(clouds)
        if self.clouds > self.fail_after:
            raise KeyboardInterrupt
        return np.array([cloud.mean(axis=0) for cloud in clouds], np.float32)

    def warm_up(self) -> None:
        pass


def places(count: int = 2 * CHUNK_CLOUDS + 10, seed: int = 0) -> PlaceSet:
    rng = np.random.default_rng(seed)
    patches = rng.uniform(-1, 1, (count, 4, 3)).astype(np.float32)
    return PlaceSet(patches, np.zeros(count, np.int64), rng.uniform(0, 100, (count, 2)), rng.uniform(-3, 3, count))


def encode(encoder: Counting, folder: Path, asked: PlaceSet, angles: np.ndarray | None = None) -> np.ndarray:
    job = EncodingJob(encoder, lambda: encoder, folder)
    return encode_places(job, asked, np.zeros((len(asked), 1)) if angles is None else angles, "places")


def test_descriptors_are_those_of_the_turned_patches(tmp_path: Path) -> None:
    asked = places(300)
    angles = np.random.default_rng(1).uniform(-3, 3, (300, 2))
    found = encode(Counting(), tmp_path, asked, angles)
    for i in (0, 17, 299):
        for a in (0, 1):
            np.testing.assert_allclose(
                found[i, a], rotate_about_z(np.asarray(asked.patches[i]), angles[i, a]).mean(axis=0), atol=1e-6
            )


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    first, second, other = Counting(), Counting(), Counting("other weights")
    one = encode(first, tmp_path, places())
    np.testing.assert_array_equal(encode(second, tmp_path, places()), one)
    assert (first.clouds, second.clouds) == (len(one), 0)
    for encoder, asked, angles in (
        (other, places(), None), (second, places(seed=1), None), (second, places(), north_angles(places())),
    ):  # fmt: skip
        before = encoder.clouds
        encode(encoder, tmp_path, asked, angles)
        assert encoder.clouds == before + len(one)


def test_a_stopped_run_goes_on(tmp_path: Path) -> None:
    stopped, goes_on = Counting(fail_after=CHUNK_CLOUDS + 50), Counting()
    with pytest.raises(KeyboardInterrupt):
        encode(stopped, tmp_path, places())
    whole = encode(goes_on, tmp_path, places())
    assert goes_on.clouds == len(whole) - CHUNK_CLOUDS
    np.testing.assert_array_equal(whole, encode(Counting(), tmp_path / "elsewhere", places()))
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("content", [b"", b"nonsense"])
def test_a_damaged_chunk_is_encoded_again(tmp_path: Path, content: bytes) -> None:
    whole = encode(Counting(), tmp_path, places())
    chunk = sorted(tmp_path.rglob("*.npy"))[1]
    chunk.write_bytes(content)
    again = Counting()
    np.testing.assert_array_equal(encode(again, tmp_path, places()), whole)
    assert again.clouds == CHUNK_CLOUDS


def test_descriptors_that_are_no_numbers_are_told(tmp_path: Path) -> None:
    class Broken(Counting):
        def encode_batch(self, clouds: list[np.ndarray]) -> np.ndarray:
            return np.full((len(clouds), 3), np.nan, np.float32)

    with pytest.raises(EvaluationError, match="not finite"):
        encode(Broken(), tmp_path, places(5))


def test_a_cache_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(EvaluationError, match="cannot write"):
        encode(Counting(), tmp_path / "file", places(5))
    with pytest.raises(EvaluationError, match="angles"):
        encode(Counting(), tmp_path, places(5), np.zeros((4, 1)))


def test_places_without_a_heading_are_not_turned() -> None:
    asked = places(3)
    unknown = PlaceSet(asked.patches, asked.area, asked.xy_m, np.array([0.5, np.nan, 0.0]))
    assert north_angles(unknown).tolist() == [[0.5], [0.0], [0.0]]


def test_a_query_takes_some_time() -> None:
    encoder = Counting()
    encode_ms, search_ms = time_queries(encoder, places(5), 4, np.zeros((10, 3), np.float32), 3)
    assert encode_ms > 0
    assert search_ms > 0
    assert encoder.clouds == 5 * 4


@pytest.mark.slow
def test_two_processes_encode_the_same(tmp_path: Path) -> None:
    asked = places(300)
    loader = functools.partial(ScanContext, PreprocessingConfig())
    found = [
        encode_places(EncodingJob(loader(), loader, tmp_path / str(workers), workers), asked, np.zeros((300, 1)), "p")
        for workers in (1, 2)
    ]
    np.testing.assert_array_equal(*found)
