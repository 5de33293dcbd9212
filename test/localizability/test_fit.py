"""The offset of a map's belief: the most probable one, and never one that believes strangers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.localizability.fit import MOST_OFF_MAP, PRIOR_STD, ScanOdds, fit_offset, odds_of
from crossloc3d_ros.types import AlignedPoses, no_aligned_poses


def scans_of(on_map: list[tuple[float, bool]], off_map: list[float]) -> list[ScanOdds]:
    return [ScanOdds(odds, right, on_map=True) for odds, right in on_map] + [
        ScanOdds(odds, has_right=False, on_map=False) for odds in off_map
    ]


ODDS = st.floats(-15.0, 15.0)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(ODDS, st.booleans()), min_size=1, max_size=12), st.lists(ODDS, max_size=12))
def test_the_offset_is_the_most_probable_one(on_map: list[tuple[float, bool]], off_map: list[float]) -> None:
    """Beside a search of all offsets in small steps, scan by scan: the logit's own words, and the prior's."""
    every = np.arange(-25.0, 25.0, 0.01)
    log_posterior = -0.5 * (every / PRIOR_STD) ** 2
    of_a_side = (len(on_map) + len(off_map)) / (2 if off_map else 1)
    for odds, has_right in on_map:
        all_poses = np.exp(odds + every)
        # Which share of the odds is the right pose's does not depend on the offset.
        outcome = all_poses / (1.0 + all_poses) if has_right else 1.0 / (1.0 + all_poses)
        log_posterior += of_a_side / len(on_map) * np.log(outcome)
    for odds in off_map:
        log_posterior -= of_a_side / len(off_map) * np.log1p(np.exp(odds + every))
    assert fit_offset(scans_of(on_map, off_map)).unlimited == pytest.approx(every[log_posterior.argmax()], abs=0.011)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(ODDS, st.booleans()), min_size=1, max_size=12), st.lists(ODDS, min_size=1, max_size=12))
def test_no_stranger_is_believed_and_nothing_else_lowers_belief(
    on_map: list[tuple[float, bool]], off_map: list[float]
) -> None:
    fitted = fit_offset(scans_of(on_map, off_map))
    assert fitted.off_map_belief <= MOST_OFF_MAP + 1e-9
    assert fitted.offset <= min(fitted.unlimited, 0.0)
    assert fitted.offset == min(fitted.unlimited, 0.0) or fitted.off_map_belief == pytest.approx(MOST_OFF_MAP)
    before = 1.0 / (1.0 + math.exp(-max(off_map)))
    assert fitted.off_map_belief <= before + 1e-12


def test_strangers_that_are_believed_lower_the_offset() -> None:
    known = [(4.0, True)] * 30
    trusting, wary = fit_offset(scans_of(known, [-9.0] * 30)), fit_offset(scans_of(known, [3.0] * 30))
    assert wary.offset < -1.0 and trusting.offset == 0.0 < trusting.unlimited
    before, after = (1.0 / (1.0 + math.exp(-(3.0 + offset))) for offset in (0.0, wary.offset))
    assert before > 0.9 and after < 0.6


def test_without_evidence_the_prior_decides() -> None:
    fitted = fit_offset(scans_of([(-math.inf, False)] * 5, [-math.inf] * 5))
    assert fitted.offset == pytest.approx(0.0, abs=1e-5)
    assert fitted.off_map_belief == 0.0


def test_many_scans_off_the_map_weigh_no_more_than_the_few_on_it() -> None:
    few = fit_offset(scans_of([(0.0, True)] * 20, [0.0] * 20))
    many = fit_offset(scans_of([(0.0, True)] * 20, [0.0] * 2000))
    assert few.unlimited == pytest.approx(0.0, abs=1e-4)
    assert many.unlimited == pytest.approx(0.0, abs=1e-4)


def test_a_pose_that_is_there_twice_counts_once() -> None:
    zeros = np.zeros(3)
    aligned = AlignedPoses(
        np.zeros((3, 3)), zeros, np.zeros((3, 3, 3)), np.array([4.0, 4.0, 1.0]), np.array([0.5, 0.0, 0.1]), zeros,
        np.ones(3, np.bool_), np.full(3, -1), log_prior=-3.0,
    )  # fmt: skip
    assert odds_of(aligned) == pytest.approx(math.log(math.exp(1.0) + math.exp(-2.0)))
    assert odds_of(no_aligned_poses()) == -math.inf
