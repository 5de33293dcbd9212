"""Maps on disk: whole ones are read, every damage is named with what to do about it."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.geotiff import BLOCK, read_geotiff, write_geotiff
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import MapError

CRS = "EPSG:32631"
ECHOES = (store.SURFACE, store.LOWEST, store.SUPPORT)
RASTERS = (store.TERRAIN, *ECHOES)


@pytest.fixture(scope="module")
def pristine(survey_file: Path, tmp_path_factory: pytest.TempPathFactory, town: Any) -> Path:
    output = tmp_path_factory.mktemp("maps") / "town"
    build_map([survey_file], output, town.__globals__["PolarHistogram"](), BuildConfig(spacing_m=38.0))
    return output


@pytest.fixture
def folder(pristine: Path, tmp_path: Path) -> Path:
    """A map to be damaged."""
    shutil.copytree(pristine, tmp_path / "map")
    return tmp_path / "map"


def change_manifest(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    values = json.loads((folder / store.MANIFEST).read_text())
    change(values)
    (folder / store.MANIFEST).write_text(json.dumps(values))


def test_a_map_can_be_moved_and_loaded(folder: Path, encoder: Any, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere" / "map"
    moved.parent.mkdir()
    folder.rename(moved)
    aerial = AerialMap.load(str(moved), encoder.fingerprint)
    assert aerial.preprocessing == encoder.preprocessing
    assert aerial.frame.crs == aerial.manifest.crs
    ids, distances = aerial.index.search(aerial.index.descriptors(np.array([4]))[0], 3)
    assert ids[0] == 4 and distances[0] == pytest.approx(0, abs=1e-3)
    assert aerial.terrain_path.is_file() and aerial.surface_path.is_file()
    west, south, _, north = aerial.bounds
    assert np.isfinite(aerial.terrain((west, south, west + 20, north)).values).any()


def test_the_manifest_reads_back(folder: Path) -> None:
    manifest = store.read_manifest(folder)
    store.write_manifest(folder, manifest)
    assert store.read_manifest(folder) == manifest


def test_another_encoder_is_refused(folder: Path) -> None:
    with pytest.raises(MapError, match=r"made by other weights .*polar-histog.*another-enco.*--overwrite"):
        AerialMap.load(folder, "another-encoder")
    AerialMap.load(folder, None)


@pytest.mark.parametrize("name", store.DATA_FILES)
def test_a_truncated_file_is_named(folder: Path, name: str) -> None:
    file = folder / name
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(MapError, match=f"{name} is truncated.*copy the map again or build it anew"):
        AerialMap.load(folder)


@pytest.mark.parametrize("name", store.DATA_FILES)
def test_a_flipped_bit_is_noticed(folder: Path, name: str) -> None:
    content = bytearray((folder / name).read_bytes())
    content[len(content) // 2] ^= 1
    (folder / name).write_bytes(content)
    with pytest.raises(MapError, match=f"{name} is damaged: its checksum"):
        AerialMap.load(folder)


@pytest.mark.parametrize("name", store.DATA_FILES)
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(MapError, match=f"lacks its file {name}"):
        AerialMap.load(folder)


@pytest.mark.parametrize(
    ("version", "advice"),
    [(store.FORMAT_VERSION + 1, "update crossloc3d_ros"), (1, "build the map again"), (None, "build")],
)
def test_another_format_version_is_refused(folder: Path, version: int | None, advice: str) -> None:
    change_manifest(folder, lambda values: values.update(format_version=version))
    with pytest.raises(MapError, match=f"format version {version}.*{advice}"):
        AerialMap.load(folder)


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="does not exist; build one"):
        AerialMap.load(tmp_path / "nowhere")
    with pytest.raises(MapError, match=r"no manifest\.json"):
        AerialMap.load(tmp_path)
    (tmp_path / store.MANIFEST).write_text("[]")
    with pytest.raises(MapError, match="not the manifest"):
        AerialMap.load(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v.pop("crs"),
        lambda v: v.update(origin=[1.0]),
        lambda v: v.update(bounds="everywhere"),
        lambda v: v["preprocessing"].update(half_extent_m=-5.0),
        lambda v: v.update(colour="blue"),
        lambda v: v["counts"].update(submaps="many"),
    ],
)
def test_a_damaged_manifest_is_named(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    change_manifest(folder, change)
    with pytest.raises(MapError, match=r"manifest\.json is damaged"):
        AerialMap.load(folder)


@pytest.mark.parametrize("content", ["", "{", '{"format": "crossloc3d map"'])
def test_a_truncated_manifest_is_named(folder: Path, content: str) -> None:
    (folder / store.MANIFEST).write_text(content)
    with pytest.raises(MapError, match=r"manifest\.json is damaged"):
        AerialMap.load(folder)


def record_anew(folder: Path) -> None:
    """Write the checksums of the files as they are, as whoever edits a map by hand does."""
    manifest = store.read_manifest(folder)
    store.write_manifest(folder, dataclasses.replace(manifest, files=store.file_records(folder)))


def without_the_last_submap(folder: Path) -> None:
    np.save(folder / store.SUBMAPS, np.load(folder / store.SUBMAPS)[:-1])


def moved_submaps(folder: Path, **metres: float) -> None:
    rows = np.load(folder / store.SUBMAPS)
    for column, distance in metres.items():
        rows[column] += distance
    np.save(folder / store.SUBMAPS, rows)


def another_zone(folder: Path) -> None:
    change_manifest(folder, lambda values: values.update(crs="EPSG:32632"))


def another_origin(folder: Path) -> None:
    change_manifest(folder, lambda values: values.update(origin=[628_000.0, 580_300.0, 3.0]))


def other_bounds(folder: Path) -> None:
    change_manifest(folder, lambda values: values.update(bounds=[v + 19.0 for v in values["bounds"]]))


def rewritten(folder: Path, name: str, *, cells: int = 0, metres: float = 0.0, crs: str = CRS) -> None:
    """Shift the cells of a raster, or the whole raster, or name another CRS."""
    raster, kind = read_geotiff(folder / name), "counts" if name == store.SUPPORT else "heights"
    values = np.roll(raster.values, cells, axis=1)
    height, width = values.shape
    west, north = raster.west_m + metres, raster.north_m
    bounds = (west, north - height * raster.cell_m, west + width * raster.cell_m, north)

    def block(part: tuple[float, float, float, float]) -> np.ndarray:
        row, column = round((north - part[3]) / raster.cell_m), round((part[0] - west) / raster.cell_m)
        return values[row : row + BLOCK, column : column + BLOCK]

    write_geotiff(folder / name, bounds, raster.cell_m, crs, block, name, kind)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without_the_last_submap, "submaps and .* descriptors"),
        (another_zone, r"by its manifest it lies in EPSG:32632, by terrain\.tif in EPSG:32631"),
        (another_origin, "its origin 628000, 580300 lies .* km off"),
        (other_bounds, r"by its manifest it covers .*, by terrain\.tif"),
        (lambda folder: moved_submaps(folder, easting=500_000.0), "submaps lie outside of the area"),
        (lambda folder: moved_submaps(folder, northing=300.0), "submaps lie outside of the area"),
        (lambda folder: moved_submaps(folder, ground_height=44.0), r"another ground height than terrain\.tif"),
        *((lambda folder, name=name: rewritten(folder, name, metres=3.0), rf"by {name}") for name in RASTERS),
        *((lambda folder, name=name: rewritten(folder, name, crs="EPSG:28992"), "in EPSG:28992") for name in RASTERS),
        *((lambda f, name=name: rewritten(f, name, cells=3), "are not of the same echoes") for name in ECHOES),
        (lambda folder: rewritten(folder, store.SURFACE, cells=40), "are not of the same echoes"),
    ],
)  # fmt: skip
def test_a_map_that_disagrees_with_itself_is_refused(folder: Path, change: Callable[[Path], None], words: str) -> None:
    change(folder)
    record_anew(folder)
    with pytest.raises(MapError, match=f"does not agree with itself: .*{words}.*; (copy|build)"):
        AerialMap.load(folder)
