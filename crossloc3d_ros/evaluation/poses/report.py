"""The files of scored poses: CSV, JSON, Markdown and the page."""

from __future__ import annotations

from pathlib import Path

from crossloc3d_ros.evaluation import set_words
from crossloc3d_ros.evaluation.poses.page import write_pose_page
from crossloc3d_ros.evaluation.poses.results import as_csv, as_json, as_markdown
from crossloc3d_ros.evaluation.poses.scores import PoseScores
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages.wording import written_by

PAGE, CSV, JSON, MARKDOWN = "index.html", "results.csv", "results.json", "table.md"


def write_report(folder: Path, scores: PoseScores, scans: int) -> None:
    """Write the files of the scores of so many scans into a folder; CrossLocError where one cannot be written."""
    write_atomically(folder / CSV, as_csv(scores))
    write_atomically(folder / JSON, as_json(scores))
    write_atomically(folder / MARKDOWN, as_markdown(scores))
    about = scores.about
    facts = {
        "map": f"{about.map_km2:.2f} km², {about.submaps:,} submaps",
        "scans": f"{scans:,} in {len(about.area_names)} areas",
        "weights": f"{about.weights} ({about.encoder[:12]})",
        "odometry": about.odometry,
        "data": about.data,
    }
    if about.every > 1:
        facts["a quick look"] = f"one scan and one journey of {about.every}"
    words = set_words.AMSTERDAM if about.pose_set == "amsterdam" else set_words.SIMULATED
    title = f"Poses, {about.pose_set}: {about.weights}"
    write_pose_page(folder / PAGE, scores, title, facts, (words,), written_by())
