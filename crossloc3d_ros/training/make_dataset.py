"""Recordings with GNSS and the aerial survey of the area, made into a dataset in the layout of CS-Campus3D.

The work lies in a folder beside the output, `NAME.build`: the submaps of the survey, the scans of each recording and
the dataset while it is put together. Every piece appears under its name when it is whole, so the work may be stopped at
any moment, and the same call goes on. The dataset appears in one rename.
"""

from __future__ import annotations

import json
import logging
import math
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from crossloc3d_ros import __version__
from crossloc3d_ros.aerial_map.aerial_patches import AerialPatches, cut_aerial
from crossloc3d_ros.aerial_map.survey import read_survey
from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.config import BuildConfig, DatasetConfig, PreprocessingConfig, ScanConfig, to_dict
from crossloc3d_ros.datasets.recordings import RecordedScans, Topics, find_topics, read_scans
from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.files import atomic_path, size_of, work_lock, write_atomically, write_error
from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.formats.cs_campus3d import PRESETS, CloudTable, QueryTable
from crossloc3d_ros.formats.cs_campus3d_writer import (
    write_cloud,
    write_database,
    write_info,
    write_queries,
    write_training,
)
from crossloc3d_ros.formats.las import expand_inputs
from crossloc3d_ros.training.areas import NONE, TEST, TRAINING, VALIDATION, Areas, Roles, cut_areas
from crossloc3d_ros.types import Int64Array

log = logging.getLogger(__name__)

NO_SUBMAP = "no submap of the survey near"
BORDER = "across the border of two areas"
_DIAGONAL = math.sqrt(2.0)
_AT_ONCE = 256
_WORK_VERSION = 2

Progress = Callable[[str, float, float, str], None]
"""Stage, done, total, unit."""


@dataclass(frozen=True)
class DatasetRequest:
    """What a dataset is to be made of, and how."""

    bags: tuple[Path, ...]
    survey: tuple[str | Path, ...]
    output: Path
    topics: Topics = field(default_factory=Topics)
    crs: str | None = None
    """Of the survey, in place of what its files say."""
    database_bags: tuple[Path, ...] = ()
    """Recordings of `bags` whose scans in the test area are a ground database, not queries."""
    test_boxes: tuple[Bounds, ...] = ()
    """Areas to test on: west, south, east, north in UTM metres; none: cut by shares."""
    validation_boxes: tuple[Bounds, ...] = ()
    config: DatasetConfig = field(default_factory=DatasetConfig)
    scan: ScanConfig = field(default_factory=ScanConfig)
    preprocessing: PreprocessingConfig = field(default_factory=PreprocessingConfig)
    build: BuildConfig = field(default_factory=BuildConfig)


@dataclass(frozen=True)
class RecordingReport:
    """What a recording gave."""

    name: str
    seen: int
    used: int
    dropped: Mapping[str, int]
    """Scans left out, by reason."""
    topics: Mapping[str, str | None]
    damage: str


@dataclass(frozen=True)
class DatasetReport:
    """What a dataset came to."""

    output: Path
    crs: str
    scans: Mapping[str, int]
    """By role."""
    submaps: Mapping[str, int]
    """By role; under '' those across a border."""
    recordings: tuple[RecordingReport, ...]
    areas: Areas


def make_dataset(request: DatasetRequest, progress: Progress | None = None) -> DatasetReport:
    """Make the dataset and return what it came to.

    Raises BagError and AerialDataError for inputs that cannot be used, DatasetError for an output that cannot be
    written, for recordings that the survey does not hold, and where an area would be left without scans or positives.
    Whatever happens, what is done is kept, and the same call goes on.
    """
    show = progress or (lambda *_: None)
    work = request.output.with_name(f"{request.output.name}.build")
    try:
        with work_lock(work, DatasetError, "process"):
            _check(request)
            _continue_or_start(work, _job(request))
            aerial = cut_aerial(
                request.survey, work / "aerial", request.build, request.preprocessing, crs=request.crs,
                progress=lambda p: show(p.stage, p.done, p.total, p.unit),
            )  # fmt: skip
            recordings = [_recorded(work, number, request, aerial.crs, show) for number in range(len(request.bags))]
            report = _Dataset(request, aerial, recordings).write(work / "dataset", show)
            (work / "dataset").rename(request.output)  # which does not exist, or is an empty folder
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise write_error(work, error, DatasetError) from error
    return report


class _Dataset:
    """Submaps and scans with their roles, and the files that say so."""

    def __init__(
        self, request: DatasetRequest, aerial: AerialPatches, recordings: Sequence[tuple[str, RecordedScans]]
    ) -> None:
        self.request, self.aerial, self.recordings = request, aerial, recordings
        config, preprocessing = request.config, request.preprocessing
        names = [name for name, _ in recordings]
        self.recording = np.repeat(np.arange(len(names)), [len(scans) for _, scans in recordings])
        self.number = np.concatenate([np.arange(len(scans)) for _, scans in recordings])
        scan_xy = np.concatenate([scans.xy_m for _, scans in recordings])
        heading = np.concatenate([scans.heading_rad for _, scans in recordings])
        self.submaps = CloudTable(
            tuple(f"clouds/aerial/{row:06d}.bin" for row in range(len(aerial))),
            aerial.grid[:, :2], np.zeros(len(aerial)), np.zeros(len(aerial), np.bool_),
        )  # fmt: skip
        files = [
            f"clouds/ground_{number:02d}_{names[number]}/{row:06d}.bin"
            for number, row in zip(self.recording.tolist(), self.number.tolist(), strict=True)
        ]
        self.scans = CloudTable(tuple(files), scan_xy, heading, np.ones(len(files), np.bool_))

        near = _tree(self.submaps).query(scan_xy, k=1)[0] <= config.positive_m if len(scan_xy) else np.zeros(0, bool)
        if not near.any():
            raise DatasetError(self._nothing())
        self.areas = _areas(request, self.scans.rows(near))
        reach_m = _DIAGONAL * preprocessing.scan_half_extent_m  # a scan's square lies at any angle
        self.scan_roles = np.where(near, self.areas.roles(scan_xy, reach_m), "out")
        self.submap_roles = self.areas.roles(self.submaps.xy_m, preprocessing.half_extent_m)

    def write(self, folder: Path, show: Progress) -> DatasetReport:
        folder.mkdir(parents=True, exist_ok=True)
        plain = PRESETS["plain"]
        self._write_training(folder / plain.training)
        assert plain.validation_database is not None
        assert plain.validation_queries is not None
        self._write_evaluation(folder / plain.validation_database, folder / plain.validation_queries, VALIDATION)
        self._write_evaluation(folder / plain.database, folder / plain.queries, TEST)
        self._write_clouds(folder, show)
        report = self._report()
        write_info(folder, self._info(report))
        return report

    def _write_training(self, path: Path) -> None:
        config = self.request.config
        submaps, scans = self.submaps.rows(self.submap_roles == TRAINING), self.scans.rows(self.scan_roles == TRAINING)
        clouds = CloudTable(
            submaps.files + scans.files,
            np.concatenate([submaps.xy_m, scans.xy_m]),
            np.concatenate([submaps.heading_rad, scans.heading_rad]),
            np.concatenate([submaps.is_ground, scans.is_ground]),
        )
        tree = _tree(clouds)
        same = tree.query_ball_point(clouds.xy_m, config.positive_m, return_sorted=True)
        if not any(row < len(submaps) for rows in same[len(submaps) :] for row in rows):
            raise DatasetError(
                f"the area to learn from holds {len(scans):,} scans and {len(submaps):,} submaps, and none of them "
                f"within {config.positive_m:g} m of each other: record where the survey is, or name other areas"
            )

        def pairs() -> Iterator[tuple[list[int], Int64Array]]:
            for row in range(len(clouds)):
                positives = [other for other in same[row] if other != row]
                offsets = clouds.xy_m - clouds.xy_m[row]
                far = np.hypot(offsets[:, 0], offsets[:, 1]) > config.negative_m
                yield positives, np.flatnonzero(far)

        write_training(path, clouds, pairs())

    def _write_evaluation(self, database_path: Path, query_path: Path, role: str) -> None:
        """Write both pickles of an area: aerial and ground database, the aerial one alone, and the queries."""
        bags = [path.resolve() for path in self.request.bags]
        held = {bags.index(path.resolve()) for path in self.request.database_bags}
        in_database = np.isin(self.recording, sorted(held)) if role == TEST else np.zeros(len(self.scans), np.bool_)
        here = self.scan_roles == role
        submaps, ground = self.submaps.rows(self.submap_roles == role), self.scans.rows(here & in_database)
        both = CloudTable(
            submaps.files + ground.files,
            np.concatenate([submaps.xy_m, ground.xy_m]),
            np.concatenate([submaps.heading_rad, ground.heading_rad]),
            np.concatenate([submaps.is_ground, ground.is_ground]),
        )
        queries = self.scans.rows(here & ~in_database)
        subsets = (both, submaps)
        right = []
        for row in range(len(queries)):
            neighbours = {}
            for number, subset in enumerate(subsets):
                offsets = subset.xy_m - queries.xy_m[row]
                neighbours[number] = np.flatnonzero(np.hypot(offsets[:, 0], offsets[:, 1]) <= self.request.config.hit_m)
            right.append(neighbours)
        write_database(database_path, subsets)
        write_queries(query_path, [QueryTable(queries, tuple(right))])

    def _write_clouds(self, folder: Path, show: Progress) -> None:
        submap_rows = np.flatnonzero(self.submap_roles != NONE)
        scan_rows = np.flatnonzero(np.isin(self.scan_roles, (TRAINING, VALIDATION, TEST)))
        total = len(submap_rows) + len(scan_rows)
        needed = total * self.request.preprocessing.n_points * 24
        lying = size_of(folder, ".bin")
        free = shutil.disk_usage(folder).free
        if free + lying < 1.02 * needed:
            raise DatasetError(
                f"the disk of {folder} has too little room: {total:,} clouds need {needed / 1e9:.2f} GB there and "
                f"{(free + lying) / 1e9:.2f} GB is free; make room and give the same command again"
            )
        done = 0
        for start in range(0, len(submap_rows), _AT_ONCE):
            rows = submap_rows[start : start + _AT_ONCE]
            for row, patch in zip(rows.tolist(), self.aerial.patches(rows), strict=True):
                write_cloud(folder, self.submaps.files[row], patch)
            done += len(rows)
            show("writing", done, total, "clouds")
        for row in scan_rows.tolist():
            patch = self.recordings[self.recording[row]][1].patches[self.number[row]]
            write_cloud(folder, self.scans.files[row], patch)
            done += 1
            show("writing", done, total, "clouds")

    def _report(self) -> DatasetReport:
        recordings = []
        for number, (name, scans) in enumerate(self.recordings):
            roles = self.scan_roles[self.recording == number]
            dropped = dict(scans.dropped)
            for reason, mark in ((NO_SUBMAP, "out"), (BORDER, NONE)):
                if (roles == mark).any():
                    dropped[reason] = int((roles == mark).sum())
            used = int(np.isin(roles, (TRAINING, VALIDATION, TEST)).sum())
            recordings.append(RecordingReport(name, scans.seen, used, dropped, scans.topics, scans.damage))
        return DatasetReport(
            output=self.request.output,
            crs=self.aerial.crs,
            scans=_counts(self.scan_roles, (TRAINING, VALIDATION, TEST)),
            submaps=_counts(self.submap_roles, (TRAINING, VALIDATION, TEST, NONE)),
            recordings=tuple(recordings),
            areas=self.areas,
        )

    def _info(self, report: DatasetReport) -> dict[str, Any]:
        request, preprocessing = self.request, self.request.preprocessing
        return {
            "software": f"crossloc3d_ros {__version__}",
            "crs": report.crs,
            "points": preprocessing.n_points,
            "half_extent_m": preprocessing.half_extent_m,
            "scan_half_extent_m": preprocessing.scan_half_extent_m,
            "units": "x and y from the centre, z above the ground, metres over the half extent; heading from grid east",
            "areas": self.areas.to_json(),
            "scans": dict(report.scans),
            "submaps": {role or BORDER: count for role, count in report.submaps.items()},
            "recordings": [vars(recording) for recording in report.recordings],
            "ground_database": [path.name for path in request.database_bags],
            "survey": [vars(source) for source in self.aerial.sources],
            "settings": to_dict(request.config),
            "scan": to_dict(request.scan),
            "preprocessing": to_dict(preprocessing),
            "build": to_dict(request.build),
        }

    def _nothing(self) -> str:
        seen = sum(scans.seen for _, scans in self.recordings)
        if not len(self.scans):
            reasons: dict[str, int] = {}
            for _, scans in self.recordings:
                for reason, count in scans.dropped.items():
                    reasons[reason] = reasons.get(reason, 0) + count
            why = "; ".join(f"{count:,} {reason}" for reason, count in sorted(reasons.items(), key=lambda r: -r[1]))
            return f"none of the {seen:,} scans can be used: {why or 'the recordings hold none'}"
        west, south, east, north = self.aerial.bounds
        x, y = np.median(self.scans.xy_m, axis=0)
        return (
            f"none of the {len(self.scans):,} scans lies within {self.request.config.positive_m:g} m of a submap: they "
            f"were taken around {x:.0f}, {y:.0f} and the survey covers {west:.0f} to {east:.0f}, {south:.0f} to "
            f"{north:.0f} ({self.aerial.crs}); is it the survey of that place, and its CRS the right one?"
        )


def _areas(request: DatasetRequest, scans: CloudTable) -> Areas:
    config = request.config
    if request.test_boxes or request.validation_boxes:
        boxes = [(TEST, box) for box in request.test_boxes] + [(VALIDATION, box) for box in request.validation_boxes]
        return Areas(tuple(boxes))
    shares = {VALIDATION: config.validation_share, TEST: config.test_share}
    reach_m = _DIAGONAL * request.preprocessing.scan_half_extent_m
    return cut_areas(scans.xy_m, reach_m, {TRAINING: 1.0 - sum(shares.values()), **shares})


def _tree(clouds: CloudTable) -> Any:
    return cKDTree(clouds.xy_m.reshape(-1, 2))


def _counts(roles: Roles, names: Sequence[str]) -> dict[str, int]:
    return {name: int((roles == name).sum()) for name in names}


def _check(request: DatasetRequest) -> None:
    """Refuse before the long work what can be refused."""
    output = request.output
    if output.exists() and not (output.is_dir() and not any(output.iterdir())):
        raise DatasetError(f"{output} exists already: give --output another name, or remove it")
    if not request.bags:
        raise DatasetError("a dataset needs at least one recording")
    resolved = [path.resolve() for path in request.bags]
    if len(set(resolved)) < len(resolved):
        raise DatasetError("a recording is named twice")
    for path in request.database_bags:
        if path.resolve() not in resolved:
            raise DatasetError(f"the recording {path} of the ground database is none of the recordings")
    for path in request.bags:
        with open_bag(path) as bag:
            find_topics(bag, request.topics)
    read_survey(request.survey, request.crs)


def _job(request: DatasetRequest) -> dict[str, Any]:
    """Return what half-done work must agree in to be continued."""
    files = [file for bag in request.bags for file in ([bag] if bag.is_file() else sorted(bag.iterdir()))]
    files += expand_inputs(request.survey)
    build = to_dict(request.build)
    for name in ("workers", "chunk_points"):  # how the work is done, not what comes out
        del build[name]
    config = to_dict(request.config)
    reading = {name: config.pop(name) for name in ("max_gnss_std_m", "max_gap_s", "scan_spacing_m")}
    job = {
        "pieces": {
            "work_version": _WORK_VERSION,
            "bags": [str(path.resolve()) for path in request.bags],
            "files": [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in files],
            "topics": vars(request.topics),
            "crs": request.crs,
            "reading": reading,
            "scan": to_dict(request.scan),
            "preprocessing": to_dict(request.preprocessing),
            "build": build,
        },
        "dataset": {
            "database_bags": [str(path.resolve()) for path in request.database_bags],
            "boxes": [request.test_boxes, request.validation_boxes],
            "config": config,
        },
    }
    restored: dict[str, Any] = json.loads(json.dumps(job))
    return restored


def _continue_or_start(work: Path, job: dict[str, Any]) -> None:
    """Keep what half-done work of the same job has, and the pieces of one with other areas; empty the folder else."""
    file = work / "job.json"
    try:
        earlier = json.loads(file.read_text(encoding="utf-8"))
        pieces, dataset = earlier["pieces"], earlier["dataset"]
    except (OSError, ValueError, KeyError, TypeError):
        pieces, dataset = None, None
    stale = ["dataset"] if dataset != job["dataset"] else []
    if pieces == job["pieces"]:
        log.info("continuing the work in %s", work)
    else:
        stale = ["aerial", "aerial.build", "scans", "dataset"]
        if pieces is not None:
            changed = sorted(k for k in {*pieces, *job["pieces"]} if pieces.get(k) != job["pieces"].get(k))
            log.warning("starting anew: the half-done work in %s has other %s", work, ", ".join(changed))
    for name in stale:
        shutil.rmtree(work / name, ignore_errors=True)
    write_atomically(file, json.dumps(job), DatasetError)


def _recorded(work: Path, number: int, request: DatasetRequest, crs: str, show: Progress) -> tuple[str, RecordedScans]:
    """Return a recording's name and scans, read now or in an earlier run."""
    path = request.bags[number]
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", path.resolve().stem).strip("_") or "recording"
    kept = work / "scans" / f"{number:03d}.npz"
    known = _read_kept(kept)
    if known is not None:
        return name, known
    scans = read_scans(
        path, request.topics, crs, request.scan, request.preprocessing, request.config,
        lambda done, total: show(f"scans {number + 1}", done, total, "scans"),
    )  # fmt: skip
    about = json.dumps(
        {"seen": scans.seen, "dropped": dict(scans.dropped), "topics": dict(scans.topics), "damage": scans.damage}
    )
    with atomic_path(kept, DatasetError, parents=True) as partial, partial.open("wb") as file:
        np.savez(
            file, stamp_ns=scans.stamp_ns, xy_m=scans.xy_m, heading_rad=scans.heading_rad, patches=scans.patches,
            about=np.frombuffer(about.encode(), np.uint8),
        )  # fmt: skip
    return name, scans


def _read_kept(path: Path) -> RecordedScans | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(file["about"].tobytes())
            return RecordedScans(file["stamp_ns"], file["xy_m"], file["heading_rad"], file["patches"], **about)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
