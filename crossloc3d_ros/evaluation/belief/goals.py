"""What is wanted of belief: the floor and the goal of each measure, set by set."""

from __future__ import annotations

from crossloc3d_ros.datasets.pose_sets import POSE_SETS, SimulatedPoses
from crossloc3d_ros.evaluation.poses.measures import Goals

OFF_MAP_SCANS = (20_000, 100_000)
"""So many scans off the map say that there is no fix: for the floor, for the goal."""
ON_MAP_FIXES = (10_000, 100_000)
LEAST_PLACES = 200
"""And so many fixes, of so many places 25 m apart, that none is wrong."""

_SURE = {"8 points/m2": (0.95, 0.99), "2 points/m2": (0.90, 0.97), "0.5 points/m2": (0.70, 0.90)}
_CALIBRATED = ("8 points/m2", "0.5 points/m2", "as delivered", "64 beams", "aged")
"""As delivered, scans are those of 16 beams."""
_RIGHT = {"amsterdam": (0.92, 0.97), "every 20th point": (0.60, 0.85)}
_OTHER_REAL_RIGHT = (0.80, 0.90)


def goals_of(set_name: str, condition: str, *, is_learned: bool) -> Goals:
    """Return the goals of one set under one condition: none where something was learned on it."""
    if is_learned:
        return Goals({})
    wanted: dict[str, tuple[float | None, float, float | None, float | None, bool]] = {
        "lost": (0.005, 0.0, None, None, False),
        "inside_2_sigma": (0.93, 0.945, 0.97, 0.965, True),
    }
    if condition in _SURE:
        wanted["sure"] = (*_SURE[condition], None, None, True)
    if condition in _CALIBRATED:
        wanted["calibration"] = (0.03, 0.01, None, None, False)
    is_simulated = isinstance(POSE_SETS.get(set_name), SimulatedPoses)
    right = _RIGHT.get(condition if is_simulated else set_name, None if is_simulated else _OTHER_REAL_RIGHT)
    if right is not None:
        wanted["right"] = (*right, None, None, True)
    if set_name == "amsterdam":
        wanted["until_median"] = (25.0, 12.0, None, None, False)
        wanted["until_95"] = (60.0, 30.0, None, None, False)
        wanted["without_fix"] = (0.03, 0.01, None, None, False)
    return Goals(wanted)
