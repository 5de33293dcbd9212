"""The results of a drive in their folder: estimates, GeoJSON, summary, page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.evaluation.drives.evaluation import ESTIMATES, GEOJSON, SUMMARY, Evaluation, write_summary
from crossloc3d_ros.evaluation.drives.page import About, write_report
from crossloc3d_ros.pages.wording import written_by

PAGE = "index.html"


def remove_results(folder: Path) -> None:
    """Remove an earlier run's results, so that old figures never stand beside new ones."""
    for name in (ESTIMATES, GEOJSON, SUMMARY, PAGE):
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise CrossLocError(f"cannot write into {folder}: {error}") from error


def write_results(folder: Path, evaluation: Evaluation, aerial_map: AerialMap, about: About) -> None:
    """Write summary and page into the folder of the estimates."""
    write_summary(folder, evaluation, {**about.facts, "notes": list(about.notes)})
    if not about.footer:
        about = replace(about, footer=written_by())
    write_report(folder / PAGE, evaluation, aerial_map, about)


def has_rows(path: Path) -> bool:
    """Return whether a file of estimates holds any."""
    try:
        with path.open(encoding="utf-8") as file:
            return sum(1 for _, _ in zip(file, range(2), strict=False)) == 2
    except OSError:
        return False
