"""The local null hypothesis: the measures by hand, and what they must not depend on."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.localization.alignment.evidence import LAYERS, Evidence, evidence_of
from crossloc3d_ros.localization.alignment.likelihood import MapLikelihood
from crossloc3d_ros.localization.alignment.local_null import EXPLAINED_BOUNDS, SECTORS, measures, with_behind_best
from crossloc3d_ros.localization.alignment.observation_model import MEASURES, UNKNOWN, ObservationModel
from crossloc3d_ros.localization.alignment.pose_search import scores_at
from crossloc3d_ros.localization.alignment.surroundings import SHIFTED, SPUN, TURNED
from crossloc3d_ros.localization.alignment.thread_pool import ThreadPool
from crossloc3d_ros.types import Float64Array

PLACE = (140.0, 120.0, 0.7)
CORNER_M = 112.0  # of the map's south-west corner in the likelihood's metres


@pytest.fixture(scope="module")
def likelihood(box_map: AerialMap) -> MapLikelihood:
    prepared = MapLikelihood(box_map, ObservationModel.load())
    prepared.prepare()
    return prepared


@pytest.fixture(scope="module")
def evidence(box_town: Any) -> Evidence:
    found: Evidence = evidence_of(box_town.place(*PLACE), 1.3)
    return found


def poses_near_and_far(seed: int = 0, count: int = 6) -> Float64Array:
    rng = np.random.default_rng(seed)
    true = np.array([CORNER_M + PLACE[0], CORNER_M + PLACE[1], PLACE[2]])
    others = np.column_stack([rng.uniform(CORNER_M + 60, CORNER_M + 220, (count, 2)), rng.uniform(-3, 3, count)])
    return np.concatenate([true[None], others])


def measured(evidence: Evidence, sample: Evidence, likelihood: MapLikelihood, poses: Float64Array) -> Float64Array:
    scores = scores_at(evidence, likelihood, poses)
    return with_behind_best(measures(evidence, sample, scores, likelihood, poses), scores, len(evidence))


def cells_at(evidence: Evidence, likelihood: MapLikelihood, pose: Float64Array) -> list[tuple[int, int, int]]:
    """Return channel, class and sector of each cell of the evidence at a pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    found = []
    for channel, (u, v) in zip(evidence.channel.tolist(), evidence.xy_m.tolist(), strict=True):
        x, y = pose[0] + c * u - s * v, pose[1] + s * u + c * v
        inside = 0 <= x < likelihood.classes.shape[1] and 0 <= y < likelihood.classes.shape[0]
        sector = math.floor((math.degrees(math.atan2(v, u)) % 360.0) / (360.0 / SECTORS))
        found.append((channel, int(likelihood.classes[int(y), int(x)]) if inside else UNKNOWN, sector))
    return found


def explained_by_hand(evidence: Evidence, likelihood: MapLikelihood, pose: Float64Array) -> float:
    model = likelihood.model
    here, elsewhere = model.expectations
    cells = cells_at(evidence, likelihood, pose)
    score = sum(float(model.log_ratios[channel, k]) for channel, k, _ in cells)
    own, null = (sum(float(table[channel % LAYERS, k]) for channel, k, _ in cells) for table in (here, elsewhere))
    return float(np.clip((score - null) / max(own - null, 1.0), *EXPLAINED_BOUNDS))


def above_by_hand(evidence: Evidence, likelihood: MapLikelihood, pose: Float64Array, offsets: Float64Array) -> float:
    def by_sector(at: Float64Array) -> dict[int, float]:
        sums: dict[int, float] = {}
        for channel, k, sector in cells_at(evidence, likelihood, at):
            sums[sector] = sums.get(sector, 0.0) + float(likelihood.model.log_ratios[channel, k])
        return sums

    own, around = by_sector(pose), [by_sector(pose + offset) for offset in offsets]
    deviations = {sector: float(np.std([sums[sector] for sums in around])) for sector in own}
    least = max(0.5 * float(np.mean(list(deviations.values()))), 1.0)
    above = [
        (score - np.mean([sums[sector] for sums in around])) / max(deviations[sector], least)
        for sector, score in own.items()
    ]
    return math.log(min(max(float(np.mean(above)), 0.1), math.e))


def test_measures_are_those_by_hand(likelihood: MapLikelihood, evidence: Evidence) -> None:
    sample = evidence.sample(60, 90)
    poses = poses_near_and_far(count=3)
    found = measured(evidence, sample, likelihood, poses)
    assert found.shape == (len(poses), len(MEASURES))
    scores = scores_at(evidence, likelihood, poses)
    for row, pose, score in zip(found, poses, scores.tolist(), strict=True):
        by_hand = [
            explained_by_hand(evidence, likelihood, pose),
            above_by_hand(sample, likelihood, pose, SHIFTED),
            above_by_hand(sample, likelihood, pose, SPUN),
            math.log(min(len(evidence) / 3000, 1.0)),
            -math.sqrt(min((max(scores) - score) / (0.25 * len(evidence)), 0.6)),
        ]
        np.testing.assert_allclose(row, by_hand, atol=2e-3)


def test_the_true_pose_is_above_all_others_in_every_measure(likelihood: MapLikelihood, evidence: Evidence) -> None:
    found = measured(evidence, evidence.sample(600, 700), likelihood, poses_near_and_far(count=40))
    of_its_own = np.arange(len(MEASURES)) != MEASURES.index("amount")
    assert (found[0] > found[1:].max(axis=0))[of_its_own].all()
    assert likelihood.model.log_likelihood(found)[0] > 8.0
    assert likelihood.model.log_likelihood(found)[1:].max() < 0.0


def test_surroundings_are_no_pose_of_the_peak() -> None:
    assert np.hypot(*SHIFTED[:, :2].T).min() >= 8.0 and (SHIFTED[:, 2] == 0.0).all()
    assert (np.abs(np.remainder(SPUN[:, 2] + np.pi, 2 * np.pi) - np.pi) >= 0.34).all() and not SPUN[:, :2].any()
    assert np.hypot(*TURNED[:, :2].T).min() >= 8.0
    for offsets in (SHIFTED, TURNED):
        np.testing.assert_allclose(offsets[:, :2].sum(axis=0), 0.0, atol=1e-9)


def test_few_cells_count_less_and_more_than_enough_count_no_more(likelihood: MapLikelihood, evidence: Evidence) -> None:
    poses = poses_near_and_far(count=2)
    some = evidence.sample(100, 150)
    amounts = [measured(cells, some, likelihood, poses)[:, 3] for cells in (some, evidence.sample(200, 300))]
    np.testing.assert_allclose(amounts[1] - amounts[0], math.log(2.0))
    many = Evidence(np.tile(evidence.xy_m, (20, 1)), np.tile(evidence.channel, 20))
    assert len(many) > 3000
    assert not measured(many, some, likelihood, poses)[:, 3].any()


def test_what_every_place_explains_is_no_evidence(likelihood: MapLikelihood, evidence: Evidence) -> None:
    """A map of one class: a scan fits it anywhere, however well."""
    class_ = int(np.argmax(likelihood.model.log_ratios.sum(axis=0)))
    uniform = MapLikelihood(likelihood.aerial_map, likelihood.model)
    uniform.classes = np.full_like(likelihood.classes, class_)
    poses = poses_near_and_far()
    found = measured(evidence, evidence.sample(600, 700), uniform, poses)
    np.testing.assert_allclose(found[:, 1:3], math.log(0.1), err_msg="nothing stands out")
    assert (likelihood.model.log_likelihood(found) < -10.0).all()


def test_a_level_that_all_scores_have_in_common_changes_nothing(likelihood: MapLikelihood, evidence: Evidence) -> None:
    """A survey of another kind shifts the scores of every cell alike."""
    model = likelihood.model
    shifted = MapLikelihood(
        likelihood.aerial_map, dataclasses.replace(model, log_ratios=model.log_ratios - np.float32(0.3))
    )
    shifted.classes = likelihood.classes
    sample, poses = evidence.sample(600, 700), poses_near_and_far()
    np.testing.assert_allclose(
        measured(evidence, sample, likelihood, poses), measured(evidence, sample, shifted, poses), atol=1e-3
    )


def test_poses_off_the_map_and_none_at_all_have_nothing_for_them(likelihood: MapLikelihood, evidence: Evidence) -> None:
    far = np.array([[-1e6, 0.0, 0.0], [1e9, 1e9, 1.0], [math.nan, 5.0, 0.0]])
    found = measured(evidence, evidence.sample(100, 100), likelihood, far)
    assert (likelihood.model.log_likelihood(found) < -10.0).all()
    assert measured(evidence, evidence, likelihood, np.empty((0, 3))).shape == (0, len(MEASURES))


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_change_no_bit(likelihood: MapLikelihood, evidence: Evidence, threads: int) -> None:
    sample, poses = evidence.sample(200, 200), poses_near_and_far(count=11)
    scores = scores_at(evidence, likelihood, poses)
    one, many = (measures(evidence, sample, scores, likelihood, poses, ThreadPool(count)) for count in (1, threads))
    np.testing.assert_array_equal(one, many)


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_a_turned_world_gives_the_same_evidence_its_measures(
    likelihood: MapLikelihood, box_map: AerialMap, evidence: Evidence, map_of: Any, tmp_path: Path, quarter: int
) -> None:
    terrain, surface, lowest = (
        np.rot90(raster.values, quarter).copy() for raster in (box_map.terrain(), box_map.surface(), box_map.lowest())
    )
    turned = MapLikelihood(map_of(tmp_path, terrain, surface, lowest=lowest), likelihood.model)
    turned.prepare()
    middle = CORNER_M + 140.0
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
    poses = poses_near_and_far()
    offsets = (poses[:, :2] - middle) @ np.array([[c, s], [-s, c]])
    its_poses = np.column_stack([middle + offsets, poses[:, 2] + quarter * math.pi / 2])
    sample = evidence.sample(600, 700)
    np.testing.assert_allclose(
        measured(evidence, sample, likelihood, poses), measured(evidence, sample, turned, its_poses), atol=0.05
    )
