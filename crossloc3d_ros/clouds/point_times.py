"""When each point of a cloud was measured: the unit and the origin of its times, which no message names.

    clock = PointClock(period_s=0.1, stamped_at=1.0)
    times = clock.read(scan)             # Times: seconds from the scan's stamp, or why there are none

Drivers send `time` in seconds from the stamp (Velodyne), `t` or `offset_time` in nanoseconds from it (Ouster, Livox),
`timestamp` in seconds or nanoseconds since 1970 (Hesai, Livox). Units are a factor of a thousand apart: at most one
makes the span of the times a turn of the lidar. It is chosen once, and every cloud is held to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.types import Float32Array, Float64Array, PointTimes, Scan

_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_LEAST_TURN, _MOST_TURN = 0.25, 1.5
"""The span of a turn's times in turns: a lidar that looks ahead only sends a part, jitter makes it a little longer."""
_SINCE_1970_S = 1e6
"""Ten days: no turn lasts as long, and all clocks that count from 1970 show more."""
_OTHER_MOMENT = 0.25
"""Of a turn: as far from `stamped_at`, the times contradict it."""

_SAME = "field '{}' gives all points the same time"


@dataclass(frozen=True, eq=False)
class Times:
    """The times of a scan's points."""

    seconds: Float32Array | None
    """(N,) from the scan's stamp; NaN where a point has none; None where they cannot be told."""
    reason: str = ""
    """Why they cannot be told."""
    words: str = ""
    """For people: field, unit, and what contradicts the settings."""


@dataclass(frozen=True)
class _Kind:
    """What the times of a field are."""

    field: str
    dtype: str
    unit: str
    is_absolute: bool
    """Since 1970, not from the stamp."""


class PointClock:
    """Tell what the times of a lidar's points mean."""

    def __init__(self, period_s: float, stamped_at: float) -> None:
        """Expect turns of `period_s`, stamped at that moment of the turn: 0 = its start, 1 = its end."""
        self._period_s = period_s
        self._stamped_at = stamped_at
        self._kind: _Kind | None = None

    def read(self, scan: Scan) -> Times:
        """Return when the points of a scan were measured."""
        times = scan.times
        if times is None:
            return Times(None, "the cloud carries no time per point")
        if self._period_s <= 0.0:
            return Times(None, "scan.period_s is 0: no turn to hold the times of the points against")
        kind = self._kind
        if kind is None or (kind.field, kind.dtype) != (times.field, times.values.dtype.str):
            judged = self._judge(times)
            if isinstance(judged, str):
                return Times(None, judged)
            kind = judged
        seconds = _since_stamp(times, kind, scan.stamp_ns)
        finite = seconds[np.isfinite(seconds)]
        if len(finite) == 0:
            return Times(None, f"field '{kind.field}' holds no number")
        first, last = float(finite.min()), float(finite.max())
        if first == last and len(finite) > 1:
            return Times(None, _SAME.format(kind.field))
        if last - first > _MOST_TURN * self._period_s or max(-first, last) > _MOST_TURN * self._period_s:
            return Times(
                None,
                f"by field '{kind.field}', taken for {kind.unit}, the points lie {first:.4g} to {last:.4g} s from the "
                f"stamp, which is no turn of {self._period_s:g} s: check the clock of the lidar and scan.period_s",
            )
        self._kind = kind
        return Times(seconds.astype(np.float32), "", self._words(kind, first, last))

    def _judge(self, times: PointTimes) -> _Kind | str:
        """Return what the times are, or why that cannot be told."""
        known = times.values[np.isfinite(times.values)] if times.values.dtype.kind == "f" else times.values
        if len(known) == 0:
            return f"field '{times.field}' holds no number"
        low, high = known.min(), known.max()
        span = float(high) - float(low) if times.values.dtype.kind == "f" else float(int(high) - int(low))
        if span == 0.0:
            return _SAME.format(times.field)
        turns = {unit: span * scale / self._period_s for unit, scale in _UNITS_S.items()}
        units = [unit for unit, share in turns.items() if _LEAST_TURN <= share <= _MOST_TURN]
        if not units:
            return (
                f"the times of field '{times.field}' span {span:.4g}, which is no turn of {self._period_s:g} s in s, "
                "ms, us or ns: check scan.period_s"
            )
        is_absolute = abs(float(low)) * _UNITS_S[units[0]] > _SINCE_1970_S
        return _Kind(times.field, times.values.dtype.str, units[0], is_absolute)

    def _words(self, kind: _Kind, first: float, last: float) -> str:
        words = f"field '{kind.field}' in {kind.unit} {'since 1970' if kind.is_absolute else 'from the stamp'}"
        moment = min(1.0, max(0.0, -first / (last - first))) if last > first else self._stamped_at
        if abs(moment - self._stamped_at) > _OTHER_MOMENT and last - first >= _LEAST_TURN * self._period_s:
            words += (
                f"; by it the stamp is that of moment {moment:.1f} of the turn, and not {self._stamped_at:g}, as "
                "scan.stamped_at says"
            )
        return words


def _since_stamp(times: PointTimes, kind: _Kind, stamp_ns: int) -> Float64Array:
    """Return the times in seconds from the stamp; integers are subtracted as such, for they may exceed 53 bits."""
    values, scale = times.values, _UNITS_S[kind.unit]
    if not kind.is_absolute:
        return np.asarray(values.astype(np.float64) * scale)
    per_unit_ns = round(scale * 1e9)
    whole, rest_ns = divmod(stamp_ns, per_unit_ns)
    if values.dtype.kind == "f":
        since = values.astype(np.float64) - float(whole)
    else:
        since = (values.astype(np.int64) - whole).astype(np.float64)
    return np.asarray(since * scale - rest_ns * 1e-9)
