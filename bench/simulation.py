"""How fast places are made: towns, surveys flown over them, scans, and submaps cut as the map's builder cuts them."""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench.figure import Figure
from crossloc3d_ros.config import PlacesConfig, PreprocessingConfig
from crossloc3d_ros.training.places import make_places

SCANS, SUBMAPS = 6_000, 27_000
"""What the published dataset holds, about."""
_TOWN_M = 600.0
_SCANS_A_TOWN = 167
"""So that towns of this size come to both numbers at the same time."""
_FAMILIES = ("old_town", "suburb", "canal_town", "campus")


def bench_simulation(workers: tuple[int, ...] = (1, 2)) -> list[Figure]:
    """Make four towns with each number of processes; starting the processes is not counted."""
    config = PlacesConfig(families=_FAMILIES, town_size_m=_TOWN_M, validation_scans=_SCANS_A_TOWN)
    figures = []
    for count in workers:
        with tempfile.TemporaryDirectory() as folder:
            made = make_places(
                Path(folder), towns=0, validation_towns=len(_FAMILIES), seed=9, config=config,
                preprocessing=PreprocessingConfig(), workers=count,
            )  # fmt: skip
        seconds = sum(town.seconds for town in made.towns) / count
        scans, submaps = sum(town.scans for town in made.towns), sum(town.submaps for town in made.towns)
        minutes = seconds * max(SCANS / scans, SUBMAPS / submaps) / 60
        name = f"simulation, {count} process{'es' if count > 1 else ''}"
        note = f"{SCANS:,} scans and {SUBMAPS:,} submaps, from {scans:,} and {submaps:,}"
        figures += [
            Figure(f"{name}: scans, towns and submaps included", scans / seconds, "scans/s"),
            Figure(f"{name}: submaps, towns and scans included", submaps / seconds, "submaps/s"),
            Figure(f"{name}: the published size", minutes, "min", "10" if count == 2 else "", note=note),
        ]
    return figures
