"""The submaps of a survey as patches on disk, cut as the map builder cuts them, without an encoder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.assemble import (
    build_counts,
    check_submaps,
    results,
    source_records,
    survey_bounds,
    write_submaps,
)
from crossloc3d_ros.aerial_map.coverage import survey_coverage
from crossloc3d_ros.aerial_map.disk import bytes_needed, room_on_disk
from crossloc3d_ros.aerial_map.progress import ProgressCallback
from crossloc3d_ros.aerial_map.store import SourceRecord, read_submaps
from crossloc3d_ros.aerial_map.survey import Survey, read_survey
from crossloc3d_ros.aerial_map.tiles import BuiltTiles, TileJob, build_tiles, check_config, continue_or_start
from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.files import atomic_path, work_lock
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array
from crossloc3d_ros.workers import open_workers

_PATCHES, _SURVEY = "patches.npy", "survey.json"


@dataclass(frozen=True, eq=False)
class AerialPatches:
    """The submaps of a survey."""

    crs: str
    """The UTM zone."""
    bounds: Bounds
    """Min easting, min northing, max easting, max northing of the survey, metres."""
    sources: tuple[SourceRecord, ...]
    grid: Float64Array
    """(M, 3) easting, northing, ground height of the centres, metres, UTM."""
    all_patches: Float32Array
    """(M, n, 3), mapped from the disk."""

    def __len__(self) -> int:
        return len(self.grid)

    def patches(self, rows: Int64Array) -> Float32Array:
        """Return the patches (len(rows), n, 3)."""
        return np.array(self.all_patches[rows])


def cut_aerial(
    inputs: Sequence[str | Path],
    folder: Path,
    config: BuildConfig,
    preprocessing: PreprocessingConfig,
    *,
    crs: str | None = None,
    progress: ProgressCallback | None = None,
) -> AerialPatches:
    """Cut the submaps of aerial files on the grid of `config.spacing_m` and keep them in `folder`.

    What was cut into the folder before is taken as it is; an interrupted call goes on. Raises as `build_map`.
    """
    work = folder.with_name(f"{folder.name}.build")
    with work_lock(work, MapError, "build"):
        if not folder.exists():
            check_config(config)
            survey = read_survey(inputs, crs)
            job = TileJob(work, survey, config, preprocessing, None)
            with room_on_disk(work, bytes_needed(survey, config, 3 * preprocessing.n_points)):
                continue_or_start(job)
                with open_workers(None, None, config.workers, None, work) as workers:
                    built = build_tiles(job, workers, progress or (lambda _: None))
                _write(folder, survey, built, preprocessing)
            shutil.rmtree(work, ignore_errors=True)
    return _read(folder)


def _write(folder: Path, survey: Survey, built: BuiltTiles, preprocessing: PreprocessingConfig) -> None:
    counts = build_counts(built)
    check_submaps(counts, preprocessing, survey_coverage(report.coverage for report in built.reports))
    about = {
        "crs": survey.map_crs,
        "bounds": survey_bounds(built),
        "sources": [asdict(source) for source in source_records(survey, built)],
    }
    with atomic_path(folder, None, synced=True) as partial:
        partial.mkdir()
        write_submaps(partial / store.SUBMAPS, built, counts.submaps)
        shape = (counts.submaps, preprocessing.n_points, 3)
        with (partial / _PATCHES).open("wb") as file:
            header = {"descr": "<f4", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, header)
            for result in results(built):
                file.write(np.ascontiguousarray(result.submap_values, "<f4").tobytes())
        (partial / _SURVEY).write_text(json.dumps(about), encoding="utf-8")


def _read(folder: Path) -> AerialPatches:
    try:
        about = json.loads((folder / _SURVEY).read_text(encoding="utf-8"))
        west, south, east, north = about["bounds"]
        sources = tuple(SourceRecord(**source) for source in about["sources"])
        patches: Float32Array = np.load(folder / _PATCHES, mmap_mode="r")
        crs = str(about["crs"])
    except (OSError, ValueError, KeyError, TypeError, EOFError) as error:
        raise MapError(
            f"the submaps in {folder} are damaged ({error}); delete the folder and cut them again"
        ) from error
    return AerialPatches(crs, (west, south, east, north), sources, read_submaps(folder / store.SUBMAPS).grid, patches)
