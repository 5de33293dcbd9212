"""The maps of evaluation sets: built once for each encoder, kept beside the scans."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import EncoderLoader

Progress = Callable[[str, float, float, str], None]
"""Take what is being done, how much is done of how much, and the unit."""


def make_map(
    folder: Path,
    inputs: Sequence[Path],
    build: BuildConfig,
    loader: EncoderLoader,
    workers: int,
    report: Progress,
) -> Path:
    """Return the map's folder in `folder`, built where there is none yet for the weights that `loader` loads.

    A map of a format that this version does not read is built again.
    """
    encoder: DescriptorEncoder = loader()
    map_folder = folder / f"map-{encoder.fingerprint[:12]}"
    if not _is_readable(map_folder):
        build_map(
            inputs,
            map_folder,
            loader if workers > 1 else encoder,
            dataclasses.replace(build, workers=workers),
            overwrite=map_folder.exists(),
            progress=lambda p: report(p.stage, p.done, p.total, p.unit),
        )
    return map_folder


def _is_readable(map_folder: Path) -> bool:
    try:
        store.read_manifest(map_folder)
    except MapError:
        return False
    return True
