"""From an aerial survey to a map: `build_map` reads as the list of its steps.

The work lies in a folder beside the output, `NAME.build`: what has been read (`spool`), the tiles that are done
(`tiles`) and the map while it is put together (`result`). Every piece appears under its name when it is whole, so a
build may be stopped at any moment, and the same call goes on where it stopped. The map itself appears in one rename.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.assemble import write_map
from crossloc3d_ros.aerial_map.disk import bytes_needed, room_on_disk
from crossloc3d_ros.aerial_map.progress import Counter, ProgressCallback
from crossloc3d_ros.aerial_map.store import Manifest
from crossloc3d_ros.aerial_map.survey import Survey, read_survey
from crossloc3d_ros.aerial_map.tile import TileTimes
from crossloc3d_ros.aerial_map.tiles import BuiltTiles, TileJob, build_tiles, check_config, continue_or_start
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.files import publish, restore, work_lock
from crossloc3d_ros.stopwatch import Stopwatch
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import EncoderLoader, open_workers


@dataclass(frozen=True)
class BuildReport:
    """What a build came to."""

    output: Path
    survey: Survey
    manifest: Manifest
    resumed: bool
    """Whether an earlier, interrupted build was continued."""
    points_read: int
    """In this run."""
    submaps_encoded: int
    """Submaps made in this run."""
    reading_s: float
    encoding_s: float
    writing_s: float
    times: TileTimes
    """Seconds of each step, summed over the tiles of this run and over its workers."""

    @property
    def points_per_s(self) -> float:
        """Points read a second, 0 where none were."""
        return self.points_read / self.reading_s if self.reading_s > 0 else 0.0

    @property
    def submaps_per_s(self) -> float:
        """Submaps made a second, 0 where none were."""
        return self.submaps_encoded / self.encoding_s if self.encoding_s > 0 else 0.0


def build_map(
    inputs: Sequence[str | Path],
    output: str | Path,
    encoder: DescriptorEncoder | EncoderLoader,
    config: BuildConfig | None = None,
    *,
    crs: str | None = None,
    geoid_separation_m: float | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> BuildReport:
    """Build the map folder `output` from aerial files, folders and globs.

    `encoder`: an encoder, or the function that loads one, which several workers need. `crs` replaces that of the
    files. `geoid_separation_m`: ellipsoidal height minus the survey's height, where somebody knows it. `scheduler`: the
    address of a Dask cluster whose machines see inputs and output under the same paths.

    Raises AerialDataError for inputs that cannot be used, MapError for an output that cannot be written, ConfigError
    for settings that do not fit. Whatever happens, what is done stays in the work folder, and the same call goes on.
    """
    config = config or BuildConfig()
    output = Path(output).absolute()
    work, report = work_folder(output), progress or (lambda _: None)
    with work_lock(work, MapError, "build"):
        check_config(config)
        restore(output)
        check_output(output, overwrite)
        loader, encoder = _encoder_and_loader(encoder)
        survey = read_survey(inputs, crs)
        job = TileJob(work, survey, config, encoder.preprocessing, encoder)
        with room_on_disk(work, bytes_needed(survey, config, encoder.descriptor_size)):
            resumed = continue_or_start(job)
            with open_workers(loader, encoder, config.workers, scheduler, work) as workers:
                built = build_tiles(job, workers, report)
            watch = Stopwatch()
            geoid_m = 0.0 if survey.vertical.ellipsoidal else geoid_separation_m
            advance = Counter("writing", 0, len(store.DATA_FILES + store.OPTIONAL_FILES), "files", report)
            manifest = write_map(work / "result", survey, built, encoder, config, geoid_m, advance)
            publish(work / "result", output)
            writing_s = watch.lap()
        shutil.rmtree(work, ignore_errors=True)
    return _report(output, survey, manifest, resumed, built, writing_s)


def _report(
    output: Path, survey: Survey, manifest: Manifest, resumed: bool, built: BuiltTiles, writing_s: float
) -> BuildReport:
    return BuildReport(
        output=output,
        survey=survey,
        manifest=manifest,
        resumed=resumed,
        points_read=built.points_read,
        submaps_encoded=sum(r.submaps for r in built.fresh),
        reading_s=built.reading_s,
        encoding_s=built.encoding_s,
        writing_s=writing_s,
        times=sum((r.times for r in built.fresh), TileTimes()),
    )


def work_folder(output: Path) -> Path:
    """Return where the unfinished work of a map lies."""
    return output.with_name(f"{output.name}.build")


def check_output(output: Path, overwrite: bool) -> None:
    """Raise MapError where `output` may not be written: it exists, or is something else than a map."""
    if not output.exists():
        return
    is_map = (output / store.MANIFEST).is_file()
    if not is_map and not (output.is_dir() and not any(output.iterdir())):
        raise MapError(f"{output} exists and is no map: give --output another name")
    if is_map and not overwrite:
        raise MapError(f"the map {output} exists: give --overwrite to replace it, or --output another name")


def _encoder_and_loader(encoder: DescriptorEncoder | EncoderLoader) -> tuple[EncoderLoader, DescriptorEncoder]:
    if callable(encoder):
        return encoder, encoder()
    given = encoder
    return (lambda: given), given
