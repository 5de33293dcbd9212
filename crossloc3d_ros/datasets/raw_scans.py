"""Scans as the sensor gave them, with the true pose of the robot, and a folder to keep them in."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from crossloc3d_ros.datasets.place_sets import Patches
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array, Scan

POINTS, COLUMNS = "points.npy", "scans.npz"


@dataclass(frozen=True, eq=False)
class RawScan:
    """One turn of the sensor and where the robot truly stood."""

    points: Float32Array
    """(N, 3) metres, lidar frame."""
    T_grid_base: Float64Array
    """(4, 4) true pose: easting, northing, height, and axes along the grid's east, north and up."""
    T_base_lidar: Float64Array
    """(4, 4) how the sensor is mounted."""
    up_base: Float64Array | None = None
    """(3,) the direction that an IMU calls up, base frame; None where the robot has no IMU."""
    stamp_ns: int = 0
    area: int = 0
    """Which of the set's areas it was taken in."""
    group: int = 0
    """Which of the set's groups it belongs to."""

    def as_scan(self) -> Scan:
        """Return it as the localizer takes it."""
        return Scan(self.points, self.stamp_ns, "velodyne")

    @property
    def heading_rad(self) -> float:
        """The robot's true heading, counter-clockwise from grid east."""
        return float(np.arctan2(self.T_grid_base[1, 0], self.T_grid_base[0, 0]))


class RawScans(Sequence[RawScan]):
    """Many scans, their points perhaps on the disk."""

    def __init__(
        self,
        points: Patches,
        T_grid_base: Float64Array,
        T_base_lidar: Float64Array,
        up_base: Float64Array,
        stamp_ns: Int64Array,
        area: Int64Array,
        group: Int64Array,
    ) -> None:
        """Take one row a scan in each column; `up_base` (N, 3) is NaN where there is no IMU."""
        self.points, self.T_grid_base, self.T_base_lidar = points, T_grid_base, T_base_lidar
        self.up_base, self.stamp_ns, self.area, self.group = up_base, stamp_ns, area, group

    @classmethod
    def of(cls, scans: Iterable[RawScan]) -> RawScans:
        """Return scans that lie in memory."""
        rows = list(scans)
        starts = np.cumsum([0, *(len(scan.points) for scan in rows)], dtype=np.int64)
        points = np.concatenate([np.empty((0, 3), np.float32), *(scan.points for scan in rows)])
        nobody = np.full(3, np.nan)
        return cls(
            Patches(points.astype(np.float32, copy=False), starts),
            np.array([scan.T_grid_base for scan in rows], np.float64).reshape(-1, 4, 4),
            np.array([scan.T_base_lidar for scan in rows], np.float64).reshape(-1, 4, 4),
            np.array([nobody if s.up_base is None else s.up_base for s in rows], np.float64).reshape(-1, 3),
            np.array([scan.stamp_ns for scan in rows], np.int64),
            np.array([scan.area for scan in rows], np.int64),
            np.array([scan.group for scan in rows], np.int64),
        )

    @classmethod
    def join(cls, parts: Sequence[RawScans], areas: Sequence[int]) -> RawScans:
        """Return the scans of all parts; `areas` is the area of each part. No points are copied."""
        return cls(
            Patches.chain(part.points for part in parts),
            np.concatenate([np.empty((0, 4, 4)), *(part.T_grid_base for part in parts)]),
            np.concatenate([np.empty((0, 4, 4)), *(part.T_base_lidar for part in parts)]),
            np.concatenate([np.empty((0, 3)), *(part.up_base for part in parts)]),
            np.concatenate([np.empty(0, np.int64), *(part.stamp_ns for part in parts)]),
            np.concatenate(
                [np.empty(0, np.int64), *(np.full(len(p), a, np.int64) for p, a in zip(parts, areas, strict=True))]
            ),
            np.concatenate([np.empty(0, np.int64), *(part.group for part in parts)]),
        )

    def __len__(self) -> int:
        return len(self.T_grid_base)

    @overload
    def __getitem__(self, index: int) -> RawScan: ...

    @overload
    def __getitem__(self, index: slice) -> list[RawScan]: ...

    def __getitem__(self, index: int | slice) -> RawScan | list[RawScan]:
        """Return one scan, or the list of several."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        up = self.up_base[index]
        return RawScan(
            self.points[index],
            self.T_grid_base[index],
            self.T_base_lidar[index],
            up if np.isfinite(up).all() else None,
            int(self.stamp_ns[index]),
            int(self.area[index]),
            int(self.group[index]),
        )


def save_scans(folder: Path, scans: RawScans) -> None:
    """Write scans into a folder."""
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(scans.points.lengths)])
    with (folder / POINTS).open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f4", "fortran_order": False, "shape": (int(starts[-1]), 3)}
        )
        for block in scans.points.blocks():
            file.write(block.data)
    np.savez(
        folder / COLUMNS,
        starts=starts,
        T_grid_base=scans.T_grid_base,
        T_base_lidar=scans.T_base_lidar,
        up_base=scans.up_base,
        stamp_ns=scans.stamp_ns,
        area=scans.area,
        group=scans.group,
    )


def load_scans(folder: Path) -> RawScans:
    """Read scans that `save_scans` wrote, their points mapped from the disk; EvaluationError where they are damaged."""
    try:
        with np.load(folder / COLUMNS, allow_pickle=False) as file:
            columns: dict[str, Any] = dict(file)
        starts = columns.pop("starts")
        points = np.load(folder / POINTS, mmap_mode="r" if starts[-1] > 0 else None, allow_pickle=False)
        if points.dtype != np.float32 or points.shape != (starts[-1], 3) or (np.diff(starts) < 0).any():
            raise EvaluationError(f"{folder} is damaged: its points are not those of its scans; make it anew")
        count = len(starts) - 1
        if any(len(column) != count for column in columns.values()):
            raise EvaluationError(f"{folder} is damaged: its columns differ in length; make it anew")
        return RawScans(Patches(points, starts), **columns)
    except FileNotFoundError as error:
        raise EvaluationError(
            f"{folder} is incomplete: {Path(error.filename).name} is missing; make it anew"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise EvaluationError(f"{folder} is damaged ({error}); make it anew") from error
