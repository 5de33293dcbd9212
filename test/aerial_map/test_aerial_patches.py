"""Submaps that are cut without an encoder are those that the map's builder encodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map import aerial_patches
from crossloc3d_ros.aerial_map.aerial_patches import cut_aerial
from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.progress import BuildProgress
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import AerialDataError, MapError
from crossloc3d_ros.types import Float32Array


@pytest.mark.parametrize("workers", [1, 2])
def test_cut_submaps_are_the_ones_that_the_builder_encodes(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig, workers: int
) -> None:
    encoded: dict[bytes, Float32Array] = {}

    def remember(clouds: Sequence[Float32Array]) -> Float32Array:
        values = type(encoder).encode_batch(encoder, clouds)
        encoded.update({value.tobytes(): cloud for value, cloud in zip(values, clouds, strict=True)})
        return values

    encoder.encode_batch = remember
    build_map([survey_file], tmp_path / "map", encoder, small_tiles)
    built = AerialMap.load(tmp_path / "map")
    config = BuildConfig(**{**vars(small_tiles), "workers": workers})
    cut = cut_aerial([survey_file], tmp_path / "cut", config, encoder.preprocessing)
    assert len(cut) == len(built.submaps) > 10
    assert (cut.crs, cut.bounds, cut.sources) == (built.manifest.crs, built.bounds, built.manifest.sources)
    np.testing.assert_array_equal(cut.grid, built.submaps.grid)
    rows = np.arange(len(cut))
    for patch, descriptor in zip(cut.patches(rows), built.index.descriptors(rows), strict=True):
        np.testing.assert_array_equal(patch, encoded[descriptor.tobytes()])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut", "map"]


def test_an_interrupted_cut_goes_on_and_a_finished_one_is_taken_as_it_is(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(progress: BuildProgress) -> None:
        if progress.stage == "cutting" and progress.done > progress.total // 2:
            raise KeyboardInterrupt

    arguments = ([survey_file], tmp_path / "cut", small_tiles, encoder.preprocessing)
    with pytest.raises(KeyboardInterrupt):
        cut_aerial(*arguments, progress=stop)
    assert not (tmp_path / "cut").exists()
    assert list((tmp_path / "cut.build" / "tiles").glob("*.npz"))
    first = cut_aerial(*arguments)
    monkeypatch.setattr(aerial_patches, "build_tiles", None)
    again = cut_aerial(*arguments)
    np.testing.assert_array_equal(first.all_patches, again.all_patches)
    (tmp_path / "cut" / "patches.npy").write_bytes(b"")
    with pytest.raises(MapError, match="are damaged"):
        cut_aerial(*arguments)


def test_a_survey_without_submaps_is_refused(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig
) -> None:
    config = BuildConfig(**{**vars(small_tiles), "min_coverage": 1.0})
    high = type(encoder.preprocessing)(**{**vars(encoder.preprocessing), "ground_clearance_m": 50.0})
    with pytest.raises(AerialDataError, match="the area is empty"):
        cut_aerial([survey_file], tmp_path / "cut", config, high)
    assert not (tmp_path / "cut").exists()
