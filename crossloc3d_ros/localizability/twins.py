"""Twin streets: pairs of places of which one is taken for the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from crossloc3d_ros.localizability.driving import DrivenPlace

SAME_PLACE_M = 25.0
"""Pairs whose ends lie so near to each other are one."""


@dataclass(frozen=True)
class Twin:
    """Two places, and the largest probability with which a single scan at one was taken for the other."""

    here: tuple[float, float]
    """Easting and northing of the place that was scanned."""
    there: tuple[float, float]
    """Of the pose that it was taken for."""
    probability: float
    scans: int
    """How many scans were taken so."""
    is_mutual: bool
    """Whether scans at either end are taken for the other."""

    @property
    def apart_m(self) -> float:
        """Metres between the two."""
        return _away(self.here, self.there)


def twins_of(places: Sequence[DrivenPlace]) -> list[Twin]:
    """Return the pairs of places that were taken for each other, the likeliest first."""
    taken = sorted(
        (
            (rival.probability, (place.easting, place.northing), (rival.easting, rival.northing))
            for place in places
            for rival in place.rivals
        ),
        reverse=True,
    )
    twins: list[Twin] = []
    for probability, here, there in taken:
        if _away(here, there) < SAME_PLACE_M:
            continue
        for i, twin in enumerate(twins):
            same, reverse = _is_near(twin, here, there), _is_near(twin, there, here)
            if same or reverse:
                twins[i] = Twin(twin.here, twin.there, twin.probability, twin.scans + 1, twin.is_mutual or not same)
                break
        else:
            twins.append(Twin(here, there, probability, 1, is_mutual=False))
    return twins


def _is_near(twin: Twin, here: tuple[float, float], there: tuple[float, float]) -> bool:
    return _away(twin.here, here) <= SAME_PLACE_M and _away(twin.there, there) <= SAME_PLACE_M


def _away(one: tuple[float, float], other: tuple[float, float]) -> float:
    return math.hypot(one[0] - other[0], one[1] - other[1])
