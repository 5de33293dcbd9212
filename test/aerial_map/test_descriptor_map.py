"""The index: exact neighbours, the same from disk, damage is named."""

from __future__ import annotations

from pathlib import Path

import faiss
import numpy as np
import pytest

from crossloc3d_ros.aerial_map import descriptor_map
from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap, write_descriptors
from crossloc3d_ros.errors import MapError


def descriptors(count: int = 500, size: int = 16, seed: int = 0) -> np.ndarray:
    """Return whole numbers: float32 holds their squared distances exactly, however they are summed."""
    return np.random.default_rng(seed).integers(-500, 501, (count, size)).astype(np.float32)


def without_equals(stored: np.ndarray) -> np.ndarray:
    """Return 30 queries of which none is equally far from two of the stored descriptors."""
    queries = descriptors(30, seed=6)
    squares = ((queries[:, None].astype(np.float64) - stored) ** 2).sum(axis=2)
    assert squares.max() < 1 << 24 and np.diff(np.sort(squares, axis=1), axis=1).min() >= 1
    return queries


@pytest.mark.parametrize("k", [1, 5, 500])
def test_neighbours_are_those_of_a_full_comparison(k: int) -> None:
    stored = descriptors()
    index = DescriptorMap(stored)
    for query in without_equals(stored):
        ids, distances = index.search(query, k)
        true = np.linalg.norm(stored.astype(np.float64) - query, axis=1)
        np.testing.assert_array_equal(ids, np.argsort(true, kind="stable")[:k])
        np.testing.assert_allclose(distances, np.sort(true)[:k], rtol=1e-4)


def test_many_queries_are_answered_as_each_alone() -> None:
    stored = descriptors()
    index, queries = DescriptorMap(stored), without_equals(stored)
    ids, distances = index.search_many(queries, 7)
    for row, query in enumerate(queries):
        alone_ids, alone_distances = index.search(query, 7)
        np.testing.assert_array_equal(ids[row], alone_ids)
        np.testing.assert_allclose(distances[row], alone_distances, rtol=1e-3)


def test_a_stored_descriptor_finds_itself() -> None:
    stored = descriptors()
    ids, distances = DescriptorMap(stored).search(stored[123], 1)
    assert ids[0] == 123
    assert distances[0] == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_array_equal(DescriptorMap(stored).descriptors(np.array([3, 1])), stored[[3, 1]])


def test_no_more_neighbours_than_there_are() -> None:
    ids, distances = DescriptorMap(descriptors(3)).search(descriptors(1)[0], 25)
    assert sorted(ids.tolist()) == [0, 1, 2] and len(distances) == 3


@pytest.mark.parametrize("mapped", [False, True])
def test_what_is_saved_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mapped: bool) -> None:
    if mapped:
        monkeypatch.setattr(descriptor_map, "_MAPPED_FROM_BYTES", 0)
    stored = descriptors(9_000)
    DescriptorMap(stored).save(tmp_path / "a.faiss")
    again = DescriptorMap.load(tmp_path / "a.faiss")
    assert (len(again), again.descriptor_size) == stored.shape
    np.testing.assert_array_equal(again.descriptors(np.arange(len(stored))), stored)
    query = descriptors(1, seed=5)[0]
    np.testing.assert_array_equal(again.search(query, 9)[0], DescriptorMap(stored).search(query, 9)[0])


def test_writing_in_blocks_gives_the_file_that_faiss_writes(tmp_path: Path) -> None:
    stored = descriptors(1_000)
    write_descriptors(tmp_path / "blocks", iter(np.array_split(stored, 13)), 1_000, 16)
    index = faiss.IndexFlatL2(16)
    index.add(stored)
    faiss.write_index(index, str(tmp_path / "whole"))
    assert (tmp_path / "blocks").read_bytes() == (tmp_path / "whole").read_bytes()


@pytest.mark.parametrize("promised", [999, 1_001])
def test_a_wrong_number_of_descriptors_is_refused(tmp_path: Path, promised: int) -> None:
    with pytest.raises(MapError):
        write_descriptors(tmp_path / "a", iter([descriptors(1_000)]), promised, 16)


@pytest.mark.parametrize("kept", [0, 10, 44, 5_000])
def test_a_truncated_index_is_named(tmp_path: Path, kept: int) -> None:
    DescriptorMap(descriptors()).save(tmp_path / "a.faiss")
    content = (tmp_path / "a.faiss").read_bytes()
    (tmp_path / "a.faiss").write_bytes(content[:kept])
    with pytest.raises(MapError, match=r"a\.faiss is damaged"):
        DescriptorMap.load(tmp_path / "a.faiss")


def test_a_query_of_another_size_is_refused() -> None:
    with pytest.raises(MapError, match="do not belong together"):
        DescriptorMap(descriptors()).search(descriptors(1, 8)[0], 3)
