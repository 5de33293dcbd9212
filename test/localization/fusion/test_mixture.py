"""The mixture: merged hypotheses have the moments of what was merged."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.mixture import POSE, Mixture, merge, new_hypotheses


def mixture(poses: list[list[float]], weights: list[float]) -> Mixture:
    values = np.array(poses)
    grid = np.column_stack([values[:, :2], np.zeros(len(values))])
    covariance = np.tile(np.diag([1.0, 1.0, 0.01]), (len(values), 1, 1))
    return new_hypotheses(grid, values[:, 2], covariance, np.log(weights), FusionConfig())


def test_hypotheses_of_one_pose_merge_into_their_moments() -> None:
    merged = merge(mixture([[0, 0, math.pi - 0.01], [90, 0, 0], [0.8, 0, 0.02 - math.pi]], [0.3, 0.5, 0.1]), 10)
    np.testing.assert_allclose(np.exp(merged.log_weight), [0.5, 0.4])
    np.testing.assert_allclose(merged.mean[1, POSE], [0.2, 0.0, math.pi - 0.01 + 0.03 / 4])
    assert merged.covariance[1, 0, 0] == pytest.approx(1.0 + 0.75 * 0.25 * 0.8**2)
    assert merged.covariance[1, 2, 2] == pytest.approx(0.01 + 0.75 * 0.25 * 0.03**2)


def test_the_likeliest_hypotheses_are_kept() -> None:
    merged = merge(mixture([[100.0 * k, 0, 0] for k in range(5)], [0.1, 0.3, 0.05, 0.2, 0.15]), 3)
    np.testing.assert_allclose(merged.mean[:, 0], [100, 300, 400])
    assert len(merge(merged.take(np.empty(0, np.int64)), 3)) == 0
