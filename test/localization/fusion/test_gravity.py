"""Up, from accelerations."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.localization.fusion.gravity import GravityFilter

SECOND = 1_000_000_000
TILTED = np.array([np.sin(0.2), 0.0, np.cos(0.2)]) * 9.81


def test_without_a_sample_nothing_is_known() -> None:
    assert GravityFilter(1.0).up(0) is None


def test_a_steady_tilt_is_found_through_vibration() -> None:
    gravity = GravityFilter(1.0)
    rng = np.random.default_rng(0)
    for i in range(1000):
        gravity.update(i * SECOND // 100, TILTED + rng.normal(0, 1.5, 3))
    up = gravity.up(10 * SECOND)
    assert up is not None
    assert np.linalg.norm(up) == pytest.approx(1.0)
    assert np.degrees(np.arccos(up @ TILTED / 9.81)) < 2.0


def test_the_time_constant_is_the_time_to_one_minus_one_over_e() -> None:
    gravity = GravityFilter(0.5)
    gravity.update(0, np.array([0.0, 0.0, 10.0]))
    for i in range(1, 51):
        gravity.update(i * SECOND // 100, np.array([10.0, 0.0, 0.0]))
    up = gravity.up(SECOND // 2)
    assert up is not None
    assert up[0] / up[2] == pytest.approx((1 - 1 / np.e) / (1 / np.e), rel=0.02)


@pytest.mark.parametrize("sample", [[0, 0, 1.0], [0, 0, 98.1], [np.nan, 0, 9.8], [0.0, 0.0, 0.0]])
def test_what_is_no_gravity_is_left_out(sample: list[float]) -> None:
    gravity = GravityFilter(1.0)
    gravity.update(0, np.array([0.0, 0.0, 9.8]))
    assert not gravity.update(SECOND // 100, np.array(sample))
    np.testing.assert_allclose(gravity.up(SECOND // 100), [0, 0, 1])


def test_an_old_average_says_nothing_about_now() -> None:
    gravity = GravityFilter(1.0)
    gravity.update(0, TILTED)
    assert gravity.up(SECOND // 2) is not None
    assert gravity.up(2 * SECOND) is None


def test_time_that_goes_backwards_starts_anew() -> None:
    gravity = GravityFilter(10.0)
    for i in range(100):
        gravity.update(100 * SECOND + i * SECOND // 100, TILTED)
    gravity.update(3 * SECOND, np.array([0.0, 0.0, 9.8]))
    np.testing.assert_allclose(gravity.up(3 * SECOND), [0, 0, 1])
