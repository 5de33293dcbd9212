"""Room on the disk: how much a build needs, and what to do where it does not suffice."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.spool import POINT_DTYPE
from crossloc3d_ros.aerial_map.survey import Survey
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.files import DISK_FULL, size_of

_NEARLY_FULL_BYTES = 1_000_000


def bytes_needed(survey: Survey, config: BuildConfig, numbers_a_submap: int) -> int:
    """Return about how much disk a build takes while it runs: the spooled points, the tiles and the result.

    `numbers_a_submap`: of the descriptor, or of the patch.
    """
    rasters = 4 * 4 * survey.area_m2 / config.cell_m**2
    submaps = survey.area_m2 / config.spacing_m**2 * (4 * numbers_a_submap + store.SUBMAP_DTYPE.itemsize)
    return int(survey.points * POINT_DTYPE.itemsize + 2 * (rasters + submaps))


@contextmanager
def room_on_disk(work: Path, needed: int) -> Iterator[None]:
    """Raise MapError with advice where the disk of `work` lacks room for `needed` bytes, now or while work is done."""
    free = shutil.disk_usage(work).free + size_of(work)
    if free < needed:
        raise MapError(
            f"the disk of {work} has too little room: the build needs about {_size(needed)} there and "
            f"{_size(free)} is free; make room or give --output on another disk"
        )
    try:
        yield
    except OSError as error:
        free = shutil.disk_usage(work).free
        if error.errno in DISK_FULL or free < _NEARLY_FULL_BYTES:
            raise MapError(
                f"the disk of {work} is full: the build needs about {_size(needed)} there in all and {_size(free)} is "
                "free; what is done is kept, so make room and give the same command again"
            ) from error
        raise MapError(f"the build in {work} failed: {error}; what is done is kept") from error


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
