"""The playing of recordings."""

from __future__ import annotations

from dataclasses import dataclass

from crossloc3d_ros.config.settings import option


@dataclass(frozen=True)
class PlayerConfig:
    """How a recording is played."""

    rate: float = option(1.0, "speed: 2 = twice as fast as recorded", low=0.01, high=100.0)
    clock: bool = option(False, "publish /clock, for nodes with use_sim_time")
    clock_hz: float = option(100.0, "messages per second of /clock, in real time", low=40.0, high=1000.0)
    loop: bool = option(False, "start again at the end, until interrupted")
    wait_s: float = option(30.0, "time to wait for a subscriber of the clouds; 0 = do not wait", low=0.0, high=3600.0)
