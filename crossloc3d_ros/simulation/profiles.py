"""The lidars that `simulate` knows, from the public data sheets of their makers.

    lidar = Lidar(PROFILES["hdl-32e"])

What a data sheet does not give is the same for all: an echo that is lost below a limit, which is set such that nine of
ten echoes of a surface of 10 % reflectivity come back at the range that the data sheet gives for it. Left out are the
calibration of single units, multiple returns, and the width of the beams.
"""

from __future__ import annotations

import numpy as np

from crossloc3d_ros.simulation.lidar import LidarConfig, LidarProfile
from crossloc3d_ros.simulation.vlp16 import VLP16

_OUSTER_COLUMN_S = 0.1 / 1024
"""1024 columns a turn at 10 Hz and 512 at 20 Hz, the modes that Ouster's driver has by default."""


def _config(min_range_m: float, max_range_m: float, error_m: float, range_10_percent_m: float) -> LidarConfig:
    """Return the settings of a sensor that sees 10 % reflectivity as far as given, nine times of ten."""
    # An echo comes back above `echo_limit` times a factor drawn from 0.7 to 1.5: 1.42 is its ninth decile.
    limit = 0.1 / (1.42 * range_10_percent_m**2)
    return LidarConfig(min_range_m=min_range_m, max_range_m=max_range_m, range_error_m=error_m, echo_limit=limit)


def _even(lowest_deg: float, highest_deg: float, beams: int) -> tuple[float, ...]:
    """Return evenly spaced elevations; those of Ouster's and Hesai's units differ by fractions of a step."""
    return tuple(np.linspace(highest_deg, lowest_deg, beams).tolist())


def _ouster(model: str, half_field_deg: float, beams: int, config: LidarConfig) -> LidarProfile:
    elevations = _even(-half_field_deg, half_field_deg, beams)
    return LidarProfile(
        f"{model}-{beams}", elevations, _OUSTER_COLUMN_S, range_step_m=0.001, layout="ouster", stamped_at=0.0,
        config=config,
    )  # fmt: skip


# HDL-32E User Manual 63-9113: 32 lasers in steps of 4/3 degree from -30.67 to +10.67, which fire in two interleaved
# halves 1.152 us apart, all in 46.08 us; 2 cm, 100 m.
_HDL_32E = LidarProfile(
    "hdl-32e",
    tuple(np.round([[low, low + 64 / 3] for low in -92 / 3 + 4 / 3 * np.arange(16)], 2).ravel().tolist()),
    column_s=46.08e-6,
    firing_s=1.152e-6,
    config=LidarConfig(min_range_m=0.9),
)
# OS0 data sheet, Rev 7: 90 degrees; 35 m at 10 %, 75 m at 80 %; 0.5 m; precision 1 to 2.5 cm.
_OS0 = _config(0.5, 75.0, 0.015, 35.0)
# OS1 data sheet, Rev 7: 42.4 degrees; 90 m at 10 %, 170 m at 80 %; 0.5 m; precision 0.5 to 3 cm.
_OS1 = _config(0.5, 170.0, 0.015, 90.0)
# PandarXT-32 User Manual X02: 32 channels from -16 to +15 degrees, 0.18 degree at 10 Hz; 80 m at 10 %, 0.05 to 120 m;
# precision 0.5 cm; ranges in steps of 4 mm.
_XT32 = LidarProfile(
    "xt32", _even(-16.0, 15.0, 32), 0.1 / 2000, firing_s=1.512e-6, range_step_m=0.004, layout="hesai", stamped_at=0.0,
    config=_config(0.05, 120.0, 0.005, 80.0),
)  # fmt: skip
# PandarQT User Manual Q01: 64 channels from -52.1 to +52.1 degrees, 0.6 degree at 10 Hz; 20 m at 10 %, 0.1 to 60 m;
# typical precision 2 cm; ranges in steps of 4 mm. Its channels lie 1.3 to 2 degrees apart: here evenly.
_QT64 = LidarProfile(
    "qt64", _even(-52.1, 52.1, 64), 0.1 / 600, firing_s=1.5e-6, range_step_m=0.004, layout="hesai", stamped_at=0.0,
    config=_config(0.1, 60.0, 0.02, 20.0),
)  # fmt: skip
# Livox Avia User Manual v1.0: 70.4 by 77.2 degrees in the non-repetitive mode, 70.4 by 4.5 with the six beams side by
# side; 240,000 points a second; 190 m at 10 %, 450 m at most; 1 m; 2 cm.
_AVIA = LidarProfile(
    "avia", _even(-2.25, 2.25, 6), 25e-6, firing_s=25e-6 / 6, half_field_deg=(35.2, 38.6 - 2.25), range_step_m=0.001,
    layout="livox", stamped_at=0.0, config=_config(1.0, 450.0, 0.02, 190.0),
)  # fmt: skip

_ALL = (
    VLP16, _HDL_32E, *(_ouster("os0", 45.0, beams, _OS0) for beams in (32, 128)),
    *(_ouster("os1", 21.2, beams, _OS1) for beams in (32, 64, 128)), _XT32, _QT64, _AVIA,
)  # fmt: skip
PROFILES: dict[str, LidarProfile] = {profile.name: profile for profile in _ALL}
"""By their names; `avia` is the solid-state one."""
