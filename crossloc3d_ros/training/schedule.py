"""How long a run learns, and how fast at which part of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.errors import TrainingError


@dataclass(frozen=True)
class Budget:
    """How long to learn: minutes on the clock, or a number of steps, which makes a run repeatable to the bit."""

    minutes: float | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.steps is None):
            raise TrainingError("give the training either minutes or steps")
        if (self.minutes or self.steps or 0) <= 0:
            raise TrainingError("the training's budget must be positive")

    def option(self) -> str:
        """Return the budget as it is written on the command line."""
        return f"--budget-steps {self.steps}" if self.steps is not None else f"--budget-minutes {self.minutes:g}"

    def share(self, elapsed_s: float, step: int) -> float:
        """Return how much of the budget is used, 1 at its end."""
        if self.steps is not None:
            return step / self.steps
        assert self.minutes is not None
        return elapsed_s / (60.0 * self.minutes)


def learning_rate(share: float, config: TrainConfig) -> float:
    """Return the learning rate at a share of the budget.

    It rises linearly in the first `warm_up`, stays, and falls by half a cosine in the last `cooldown`. Until the
    cooling begins the rate does not depend on where the budget ends, so that a run can be prolonged as if it had been
    meant to be longer from the start. With `milestones` it falls to a tenth at each of these shares instead.
    """
    if share < config.warm_up:
        return config.learning_rate * (0.01 + 0.99 * share / config.warm_up)
    if config.milestones:
        return config.learning_rate * 0.1 ** sum(share >= milestone for milestone in config.milestones)
    begin = max(config.warm_up, 1.0 - config.cooldown)
    progress = min(1.0, max(0.0, share - begin) / max(1e-9, 1.0 - begin))
    cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
    return config.learning_rate * (config.final_share + (1.0 - config.final_share) * cosine)
