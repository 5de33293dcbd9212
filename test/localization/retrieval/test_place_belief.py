"""Belief: what distances and spread of the candidates lead to."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from crossloc3d_ros.config import CalibrationConfig, RetrievalConfig, from_dict, to_dict
from crossloc3d_ros.localization.retrieval.place_belief import calibrate, candidate_probabilities, decide
from crossloc3d_ros.types import Candidates, FixStatus

CALIBRATION = CalibrationConfig(temperature=0.1, null_distance=1.0, null_scale=0.05)
CONFIG = RetrievalConfig()
Array = npt.NDArray[np.float64]


def candidates_of(distances: Array, grid: Array, calibration: CalibrationConfig = CALIBRATION) -> Candidates:
    near = distances.astype(np.float32)
    return Candidates(np.arange(len(near)), near, candidate_probabilities(near, calibration), grid)


def places(*xy: tuple[float, float]) -> Array:
    return np.array([(x, y, 0.0) for x, y in xy])


@given(
    hnp.arrays(np.float32, st.integers(1, 60), elements=st.floats(0, 1e4, width=32)),
    st.floats(1e-3, 1e3),
    st.floats(1e-3, 1e3),
    st.floats(1e-3, 1e3),
)
def test_probabilities_are_probabilities_whatever_the_distances(
    distances: npt.NDArray[np.float32], temperature: float, null_distance: float, null_scale: float
) -> None:
    shares = candidate_probabilities(distances, CalibrationConfig(temperature, null_distance, null_scale))
    assert (shares >= 0).all()
    assert shares.sum() <= 1 + 1e-9
    assert (np.diff(shares[np.argsort(distances, kind="stable")]) <= 1e-12).all(), "the nearer, the likelier"


def test_half_of_the_belief_is_in_none_at_the_calibrated_distance() -> None:
    shares = candidate_probabilities(np.array([1.0, 1.2, 1.5], np.float32), CALIBRATION)
    assert shares.sum() == pytest.approx(0.5)
    # By the definition of the temperature, one temperature farther is 1/e as likely.
    assert candidate_probabilities(np.array([0.2, 0.3], np.float32), CALIBRATION)[1] * np.e == pytest.approx(
        candidate_probabilities(np.array([0.2, 0.3], np.float32), CALIBRATION)[0], rel=1e-5
    )


def test_candidates_around_one_place_give_a_fix_at_their_weighted_mean() -> None:
    enu = places((0, 0), (19, 0), (0, 19), (700, 0))
    candidates = candidates_of(np.array([0.30, 0.30, 0.30, 0.55]), enu)
    belief = decide(candidates, enu, CONFIG)
    assert belief.status is FixStatus.FIX
    assert belief.members.tolist() == [True, True, True, False]
    np.testing.assert_allclose(belief.enu[:2], [19 / 3, 19 / 3], atol=1e-9)
    assert belief.probability == pytest.approx(candidates.probabilities[:3].sum())


def test_many_that_agree_outweigh_one_that_is_a_little_nearer() -> None:
    enu = places((900, 0), (0, 0), (19, 0), (38, 0))
    belief = decide(candidates_of(np.array([0.30, 0.33, 0.33, 0.33]), enu), enu, CONFIG)
    assert belief.members.tolist() == [False, True, True, True]


def test_two_equal_places_give_no_fix_and_the_distance_between_them() -> None:
    enu = places((0, 0), (800, 0), (1600, 0))
    belief = decide(candidates_of(np.array([0.3, 0.301, 0.301]), enu), enu, CONFIG)
    assert belief.status is FixStatus.NO_FIX
    assert "best candidates lie 800 m apart" in belief.reason


def test_a_scan_from_nowhere_gives_no_fix_even_if_all_candidates_agree() -> None:
    enu = places((0, 0), (19, 0), (0, 19))
    belief = decide(candidates_of(np.array([1.4, 1.4, 1.4]), enu), enu, CONFIG)
    assert belief.status is FixStatus.NO_FIX
    assert "no submap resembles the scan" in belief.reason


@pytest.mark.parametrize("distance", [np.nan, np.inf, 1e30])
def test_a_distance_that_is_no_number_gives_no_fix(distance: float) -> None:
    enu = places((0, 0), (19, 0))
    belief = decide(candidates_of(np.array([distance, distance]), enu), enu, CONFIG)
    assert belief.status is FixStatus.NO_FIX


@given(hnp.arrays(np.float64, (12, 3), elements=st.floats(-500, 500)), st.integers(0, 2**31))
def test_the_covariance_is_never_below_the_floor_and_never_beyond_the_cluster(enu: Array, seed: int) -> None:
    distances = np.random.default_rng(seed).uniform(0.2, 0.8, 12)
    belief = decide(candidates_of(np.sort(distances), enu), enu, CONFIG)
    np.testing.assert_allclose(belief.covariance, belief.covariance.T, atol=1e-9)
    variances = np.linalg.eigvalsh(belief.covariance[:2, :2])
    assert variances.min() >= CONFIG.min_std_m**2 * (1 - 1e-9)
    assert variances.max() <= CONFIG.min_std_m**2 + CONFIG.cluster_radius_m**2 * (1 + 1e-9)
    assert belief.covariance[2, 2] >= CONFIG.min_height_std_m**2 * (1 - 1e-9)


def test_the_order_of_equal_rows_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    enu, distances = rng.uniform(-300, 300, (25, 3)), rng.uniform(0.2, 0.6, 25)
    order = np.argsort(distances)
    one = decide(candidates_of(distances[order], enu[order]), enu[order], CONFIG)
    turned = rng.permutation(25)
    two = decide(candidates_of(distances[turned], enu[turned]), enu[turned], CONFIG)
    np.testing.assert_allclose(one.enu, two.enu, atol=1e-9)
    assert one.probability == pytest.approx(two.probability)


def made_up_drive(rng: np.random.Generator, n: int, truth: CalibrationConfig) -> tuple[list[Array], list[Array]]:
    """Distances and separations whose laws are the model's own: the right answer is drawn from its probabilities."""
    distances, separations = [], []
    for _ in range(n):
        near = np.sort(rng.normal(1.0, 0.25, 10).clip(0.05))
        shares = candidate_probabilities(near.astype(np.float32), truth)
        choice = rng.choice(11, p=np.append(shares, 1 - shares.sum()))
        separation = np.full(10, 500.0)
        if choice < 10:
            separation[choice] = 10.0
        distances.append(near)
        separations.append(separation)
    return distances, separations


def test_calibration_finds_the_law_that_made_the_data() -> None:
    truth = CalibrationConfig(temperature=0.12, null_distance=0.7, null_scale=0.08)
    found = calibrate(*made_up_drive(np.random.default_rng(0), 4000, truth))
    assert found.null_distance == pytest.approx(truth.null_distance, abs=0.03)
    assert found.null_scale == pytest.approx(truth.null_scale, rel=0.25)
    assert found.temperature == pytest.approx(truth.temperature, rel=0.15)


def test_calibration_of_descriptors_that_tell_nothing_can_be_stored_and_read() -> None:
    rng = np.random.default_rng(4)
    # What is on the map looks a little less familiar than what is not, and hardly any scan is on it.
    inside = [np.sort(rng.uniform(0.5, 0.6, 5)) for _ in range(3)]
    outside = [np.sort(rng.uniform(0.4, 0.6, 5)) for _ in range(60)]
    separations = [np.array([5.0, 900, 900, 900, 900])] * 3 + [np.full(5, np.inf)] * 60
    found = calibrate(inside + outside, separations)
    assert from_dict(CalibrationConfig, to_dict(found)) == found
    assert candidate_probabilities(inside[0].astype(np.float32), found).sum() < 0.5


def test_calibration_learns_nowhere_from_scans_outside_of_the_map() -> None:
    rng = np.random.default_rng(1)
    inside = [np.sort(rng.uniform(0.2, 0.4, 5)) for _ in range(50)]
    outside = [np.sort(rng.uniform(0.9, 1.2, 5)) for _ in range(50)]
    separations = [np.array([5.0, 900, 900, 900, 900])] * 50 + [np.full(5, np.inf)] * 50
    found = calibrate(inside + outside, separations)
    assert 0.4 < found.null_distance < 0.9
    belief_inside = candidate_probabilities(inside[0].astype(np.float32), found).sum()
    belief_outside = candidate_probabilities(outside[0].astype(np.float32), found).sum()
    assert belief_inside > 0.9
    assert belief_outside < 0.1
