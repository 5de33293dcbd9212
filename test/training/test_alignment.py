"""`train alignment` finds the weights that drew the data, and learns a model that finds its scans and doubts others."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.datasets.pose_sets import PoseSet
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.evaluation.poses.errors import WITHIN_DEG, WITHIN_M
from crossloc3d_ros.localization.alignment.aligner import Aligner
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS
from crossloc3d_ros.localization.alignment.observation_model import (
    CLASSES,
    MEASURES,
    OPEN_GROUND,
    UNKNOWN,
    ObservationModel,
    fit_log_ratios,
)
from crossloc3d_ros.training import alignment as training
from crossloc3d_ros.training.alignment import (
    NEAR_M,
    LearningSet,
    MeasuredPoses,
    fit_alignment,
    fit_weights,
    is_right,
)
from crossloc3d_ros.training.queries import Query, query_of
from crossloc3d_ros.types import AlignedPoses, Float64Array, no_aligned_poses, no_candidates

RIGHT_M, RIGHT_RAD = WITHIN_M, math.radians(WITHIN_DEG)
Learned = tuple[ObservationModel, list[MeasuredPoses]]
WEIGHTS = np.array([3.0, 1.0, 2.0, 0.8, 1.2, -1.5])
LOG_PRIOR = -2.0


@pytest.fixture(scope="module")
def pose_set(simulated_town: tuple[PoseSet, Any]) -> PoseSet:
    return simulated_town[0]


def queries(scans: Sequence[RawScan]) -> list[Query]:
    return [query_of(scan) for scan in scans]


@pytest.fixture(scope="module")
def sets(pose_set: PoseSet) -> list[LearningSet]:
    """Divide the town into a western and an eastern fold, each with the scans of the other town."""
    on_map = sorted((s for s in pose_set.scans if pose_set.on_map[s.area]), key=lambda s: float(s.T_grid_base[0, 3]))
    off_map = [scan for scan in pose_set.scans if not pose_set.on_map[scan.area]]
    return [
        LearningSet("the west", "west", pose_set.map_folder, queries(on_map[:4]), queries(off_map[:2])),
        LearningSet("the east", "east", pose_set.map_folder, queries(on_map[4:]), queries(off_map[2:])),
    ]


@pytest.fixture(scope="module")
def learned(sets: list[LearningSet]) -> Learned:
    return fit_alignment(sets)


def log_odds_of(poses: MeasuredPoses, weights: Float64Array) -> Float64Array:
    """Return the log odds (p + 1,) of each pose to the null hypothesis, which is the last."""
    return np.append(poses.measures @ weights[:-1] + weights[-1] + poses.log_prior, 0.0)


def drawn(weights: Float64Array, count: int, seed: int, name: str = "a set") -> list[MeasuredPoses]:
    """Draw poses from the very model that is fitted: which of them is right follows from their measures."""
    rng, some = np.random.default_rng(seed), []
    for _ in range(count):
        measures = rng.normal(0.0, [0.5, 1.0, 0.8, 0.7, 0.9], (rng.integers(1, 12), len(MEASURES)))
        poses = MeasuredPoses(name, measures, None, LOG_PRIOR)
        log_odds = log_odds_of(poses, weights)
        right = int(rng.choice(len(log_odds), p=np.exp(log_odds - np.logaddexp.reduce(log_odds))))
        some.append(dataclasses.replace(poses, right=right if right < len(measures) else None))
    return some


@pytest.mark.parametrize("weights", [WEIGHTS, np.array([0.0, 1.5, 0.7, 0.5, 0.9, 1.0])])
def test_the_weights_that_made_the_poses_are_found(weights: Float64Array) -> None:
    np.testing.assert_allclose(fit_weights(drawn(weights, 3000, 1)), weights, atol=0.25)


def test_probabilities_after_the_fit_are_shares_of_what_is_right() -> None:
    weights = fit_weights(drawn(WEIGHTS, 1500, 2))
    predicted, right = [], []
    for poses in drawn(WEIGHTS, 1500, 3):
        log_odds = log_odds_of(poses, weights)
        best = int(np.argmax(log_odds[:-1]))
        predicted.append(math.exp(log_odds[best] - np.logaddexp.reduce(log_odds)))
        right.append(poses.right == best)
    for low, high in ((0.05, 0.35), (0.35, 0.65), (0.65, 0.95)):
        here = (np.array(predicted) >= low) & (np.array(predicted) < high)
        assert here.sum() > 100
        assert np.mean(np.array(right)[here]) == pytest.approx(np.mean(np.array(predicted)[here]), abs=0.08)


def test_no_weight_but_the_constant_is_negative() -> None:
    weights = fit_weights(drawn(np.array([-2.0, 1.0, -0.5, 0.6, 0.8, -1.0]), 800, 4))
    assert (weights[:-1] >= 0.0).all()
    assert weights[0] == weights[2] == 0.0
    assert weights[-1] < 0.0


def test_a_set_counts_by_the_square_root_of_its_scans() -> None:
    """A set four times as large counts twice: as much as two of its size."""
    one, other = drawn(WEIGHTS, 300, 5, "one"), drawn(np.array([0.5, 2.0, 0.2, 0.3, 1.0, 0.0]), 300, 6, "other")
    twin = [dataclasses.replace(poses, set_name="twin") for poses in one]
    large = fit_weights([*one, *one, *one, *one, *other])
    np.testing.assert_allclose(large, fit_weights([*one, *twin, *other]), atol=0.02)
    assert np.abs(large - fit_weights([*one, *other])).max() > 0.1


def test_scans_without_any_pose_do_no_harm() -> None:
    some = drawn(WEIGHTS, 100, 7)
    nothing = MeasuredPoses("a set", np.empty((0, len(MEASURES))), None, LOG_PRIOR)
    np.testing.assert_array_equal(fit_weights([*some, nothing, nothing]), fit_weights(some))


def test_nothing_is_fitted_to_poses_of_which_none_is_right() -> None:
    wrong = [dataclasses.replace(poses, right=None) for poses in drawn(WEIGHTS, 20, 8)]
    for measured in (wrong, []):
        with pytest.raises(TrainingError, match="no scan was found on its map"):
            fit_weights(measured)


def poses_at(scan: Query, offsets: Sequence[Sequence[float]]) -> AlignedPoses:
    """Return poses so many metres east and north and radians from the truth."""
    offset = np.array(offsets, np.float64)
    count = len(offset)
    grid = scan.T_grid_base[:3, 3] + np.column_stack([offset[:, :2], np.full(count, 50.0)])
    numbers = np.zeros(count)
    return AlignedPoses(
        grid, scan.heading_rad + offset[:, 2], np.zeros((count, 3, 3)), numbers, numbers, numbers,
        np.ones(count, np.bool_), np.zeros(count, np.int64), LOG_PRIOR,
    )  # fmt: skip


def test_a_pose_is_right_within_two_metres_and_five_degrees(pose_set: PoseSet) -> None:
    scan = query_of(pose_set.scans[0])
    poses = poses_at(
        scan,
        [[0, 0, 0], [RIGHT_M - 0.01, 0, 0], [0, -RIGHT_M - 0.01, 0], [0, 0, RIGHT_RAD - 1e-3],
         [0, 0, -RIGHT_RAD - 1e-3], [0, 0, 2 * math.pi], [0, 0, math.pi]],
    )  # fmt: skip
    assert is_right(poses, scan).tolist() == [True, True, False, True, False, True, False]
    assert is_right(no_aligned_poses(), scan).shape == (0,)


class Found:
    """Stands in for an aligner that finds given poses; their measures are their numbers."""

    def __init__(self, poses: AlignedPoses) -> None:
        self.poses = poses

    def begin(self, *_: object) -> Found:
        return self

    def search_map(self) -> None:
        pass

    def measured(self) -> tuple[AlignedPoses, Float64Array]:
        return self.poses, np.tile(np.arange(len(self.poses), dtype=np.float64)[:, None], len(MEASURES))


def kept_of(poses: AlignedPoses, scan: Query, on_map: bool = True) -> tuple[list[int], int | None]:
    """Return the numbers of the poses that are learned from, and which of them is right."""
    measured = training._measured_poses("a set", Found(poses), scan, on_map)  # type: ignore[arg-type]
    assert measured is not None
    assert measured.log_prior == LOG_PRIOR
    return measured.measures[:, 0].astype(int).tolist(), measured.right


def test_a_pose_that_is_near_but_not_right_teaches_nothing(pose_set: PoseSet) -> None:
    scan = query_of(pose_set.scans[0])
    far, near, turned = [50.0, 0.0, 0.0], [NEAR_M - 0.1, 0.0, 0.0], [0.0, 0.0, math.pi]
    poses = poses_at(scan, [far, near, turned, [0.5, 0.0, 0.0], [NEAR_M + 0.1, 0.0, 0.0], [0.0, 0.5, 0.0]])
    assert kept_of(poses, scan) == ([0, 3, 4], 1)  # of two right ones the better
    assert kept_of(poses_at(scan, [near, turned]), scan) == ([], None)
    assert kept_of(poses, scan, on_map=False) == ([0, 1, 2, 3, 4, 5], None)


def test_the_right_pose_is_learned_from_however_many_are_better(pose_set: PoseSet) -> None:
    scan = query_of(pose_set.scans[0])
    poses = poses_at(scan, [*([100.0 + i, 0.0, 0.0] for i in range(30)), [0.0, 0.0, 0.0]])
    kept, right = kept_of(poses, scan)
    assert kept == [*range(15), 30]
    assert right == 15
    assert kept_of(poses, scan, on_map=False) == (list(range(16)), None)


def test_each_fold_is_aligned_with_ratios_learned_without_it(
    sets: list[LearningSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    seen = {fold: rng.uniform(0, 1e5, (2, CHANNELS, CLASSES)) for fold in ("west", "east", "north")}
    north = dataclasses.replace(sets[0], name="the north", fold="north")
    off = LearningSet("beyond", "beyond", sets[0].map_folder, (), sets[0].off_map)
    used: dict[str, Any] = {}

    def spy(name: str, aligner: Aligner, *_: object) -> None:
        used[name] = aligner.model.log_ratios

    monkeypatch.setattr(training, "_measured_poses", spy)
    monkeypatch.setattr(training, "_seen_by_fold", lambda *_: seen)
    monkeypatch.setattr(training, "fit_weights", lambda _: np.ones(len(MEASURES) + 1))
    model, _ = fit_alignment([*sets, north, off])
    everything = sum(seen.values())
    for name, without in (("the west", "west"), ("the east", "east"), ("the north", "north")):
        np.testing.assert_allclose(used[name], fit_log_ratios(*(everything - seen[without]))[0], atol=1e-5)
    for ratios in (used["beyond"], model.log_ratios):
        np.testing.assert_allclose(ratios, fit_log_ratios(*everything)[0], atol=1e-5)


def test_what_is_learned_is_whole_and_separates_walls_from_streets(learned: Learned, tmp_path: Path) -> None:
    model, measured = learned
    assert model.log_ratios.shape == model.search_ratios.shape == (CHANNELS, CLASSES)
    assert np.isfinite(model.log_ratios).all()
    assert (model.log_ratios[:, UNKNOWN] == 0.0).all()
    assert (model.log_ratios <= model.search_ratios + 1e-6).all(), "refutation only ever lowers"
    assert ((model.hit_share > 0.0) & (model.hit_share < 1.0)).all()
    assert (model.log_ratios[:LAYERS, OPEN_GROUND] < 0.0).all(), "no returns from an empty street"
    model.save(tmp_path / "learned.safetensors")
    loaded = ObservationModel.load(tmp_path / "learned.safetensors")
    for name, values in vars(loaded).items():
        np.testing.assert_array_equal(values, getattr(model, name))
    assert sum(poses.right is not None for poses in measured) >= 6


def test_poses_are_those_of_the_sets_and_nothing_is_right_off_the_map(
    sets: list[LearningSet], learned: Learned
) -> None:
    _, measured = learned
    assert [poses.set_name for poses in measured] == ["the west"] * 6 + ["the east"] * 4
    on_map = [on for each in sets for on in (*[True] * len(each.on_map), *[False] * len(each.off_map))]
    for poses, on in zip(measured, on_map, strict=True):
        assert on or poses.right is None
        assert poses.measures.shape[1] == len(MEASURES)
        assert np.isfinite(poses.measures).all()
        assert poses.log_prior < 0.0
    right = [poses.measures[poses.right] for poses in measured if poses.right is not None]
    wrong = np.concatenate([np.delete(p.measures, [] if p.right is None else p.right, axis=0) for p in measured])
    better = np.median(right, axis=0) > np.median(wrong, axis=0)
    assert better[np.arange(len(MEASURES)) != MEASURES.index("amount")].all(), (
        "all but what a scan has alike everywhere"
    )


def test_a_learned_model_finds_its_scans_and_doubts_strangers(pose_set: PoseSet, learned: Learned) -> None:
    aligner = Aligner(AerialMap.load(pose_set.map_folder), AlignmentConfig(), learned[0])
    for scan in pose_set.scans[::3]:
        query = query_of(scan)
        alignment = aligner.begin(query.evidence, no_candidates())
        assert alignment is not None
        alignment.search_map()
        found = alignment.result()
        if pose_set.on_map[scan.area]:
            assert is_right(found, query)[0]
            assert found.probabilities[0] > 0.5
        else:
            assert found.probabilities.sum() < 0.5


def test_progress_is_reported(sets: list[LearningSet], monkeypatch: pytest.MonkeyPatch) -> None:
    some = drawn(WEIGHTS, 1, 9)[0]
    monkeypatch.setattr(training, "_measured_poses", lambda *_: dataclasses.replace(some, right=0))
    reports: list[tuple[str, float, float, str]] = []
    fit_alignment(sets, progress=lambda *report: reports.append(report))
    assert [report[0] for report in reports] == ["learning"] * 7 + ["aligning"] * 10
    assert all(report[1] <= report[2] for report in reports)
    assert reports[-1] == ("aligning", 10, 10, "scans")


@pytest.mark.parametrize("without", ["on_map", "off_map"])
def test_scans_of_one_kind_teach_nothing(sets: list[LearningSet], without: str) -> None:
    with pytest.raises(TrainingError, match="scans on their maps, and scans off them"):
        fit_alignment([dataclasses.replace(each, **{without: ()}) for each in sets])


def test_one_fold_teaches_nothing(sets: list[LearningSet]) -> None:
    with pytest.raises(TrainingError, match="two folds"):
        fit_alignment([dataclasses.replace(each, fold="town") for each in sets])


def test_a_map_without_open_ground_teaches_what_beams_meet_there(
    sets: list[LearningSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "_places", lambda _: np.empty((0, 2)))
    here, elsewhere = training._seen_by_fold(sets[:1], lambda *_: None)["west"]
    assert here.sum() > 0.0
    assert elsewhere.sum() == 0.0
