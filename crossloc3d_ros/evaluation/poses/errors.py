"""Errors of predicted poses: pure functions over `PosePredictions`."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.evaluation.poses.predictions import PosePredictions
from crossloc3d_ros.evaluation.statistics import squared_mahalanobis
from crossloc3d_ros.types import WHOLE_MAP, AlignedPoses, BoolArray, Float64Array, Int64Array

WITHIN_M, WITHIN_DEG = 2.0, 5.0
"""A pose that is at most so far from the truth is right."""
WRONG_M = 10.0
"""A fix farther from the truth is wrong."""
AMONG_M = 50.0
"""A scan's place is among the candidates where one of their centres is so near: the submap holds the robot."""


def error_m(predictions: PosePredictions) -> Float64Array:
    """Return the horizontal error (N,) of the localizer's pose, infinite where there is none."""
    return distance_m(predictions, predictions.pose[:, [0, 1, 3]])


def error_deg(predictions: PosePredictions) -> Float64Array:
    """Return the error (N,) of the localizer's heading, infinite where there is none."""
    return heading_error_deg(predictions, predictions.pose[:, [0, 1, 3]])


def distance_m(predictions: PosePredictions, pose: Float64Array) -> Float64Array:
    """Return the horizontal error (N,) of poses (N, 3), infinite where there is none."""
    metres = np.hypot(pose[:, 0] - predictions.truth[:, 0], pose[:, 1] - predictions.truth[:, 1])
    return np.where(np.isfinite(metres), metres, np.inf)


def heading_error_deg(predictions: PosePredictions, pose: Float64Array) -> Float64Array:
    """Return the error (N,) of the headings of poses (N, 3), infinite where there is none."""
    turn = pose[:, 2] - predictions.truth[:, 3]
    degrees = np.degrees(np.abs(np.arctan2(np.sin(turn), np.cos(turn))))
    return np.where(np.isfinite(degrees), degrees, np.inf)


def is_right(predictions: PosePredictions, pose: Float64Array) -> BoolArray:
    """Say (N,) of poses (N, 3) easting, northing, heading whether they are within 2 m and 5 degrees."""
    near = distance_m(predictions, pose) <= WITHIN_M
    return np.asarray(near & (heading_error_deg(predictions, pose) <= WITHIN_DEG), np.bool_)


def right_aligned(aligned: AlignedPoses, truth: Float64Array) -> BoolArray:
    """Return which aligned poses (p,) of a scan are within 2 m and 5 degrees of the true easting, northing, heading."""
    away = np.hypot(*(aligned.grid[:, :2] - truth[:2]).T)
    turned = np.abs(wrap(aligned.heading_rad - truth[2]))
    return np.asarray((away <= WITHIN_M) & (turned <= math.radians(WITHIN_DEG)))


def retrieved(predictions: PosePredictions) -> Float64Array:
    """Return the first candidate (N, 3); retrieval knows no heading."""
    place = predictions.candidates[:, 0]
    return np.column_stack([place, np.full(len(place), np.nan)])


def first_aligned(predictions: PosePredictions) -> Float64Array:
    """Return the best pose (N, 3) within 50 m of the foremost candidate that has one so near."""
    source = predictions.aligned_source
    own = np.isfinite(predictions.aligned[:, :, 0]) & ((source >= 0) | (source == WHOLE_MAP))
    pose = np.full((len(predictions), 3), np.nan)
    for place in np.moveaxis(predictions.candidates, 1, 0)[::-1]:  # the foremost last: it has the last word
        offsets = predictions.aligned[:, :, :2] - place[:, None, :]
        near = own & (np.hypot(offsets[:, :, 0], offsets[:, :, 1]) <= AMONG_M)
        has = near.any(axis=1)
        pose[has] = predictions.aligned[has, near[has].argmax(axis=1)]
    return pose


def best_aligned(predictions: PosePredictions) -> Float64Array:
    """Return the pose (N, 3) that fits best of all."""
    return predictions.aligned[:, 0]


STAGES: dict[str, Callable[[PosePredictions], Float64Array]] = {
    "retrieval alone": retrieved,
    "+ alignment": first_aligned,
    "+ re-ranking": best_aligned,
}


def localized_before(track: PosePredictions) -> BoolArray:
    """Say (N,) of the scans of journeys, in their order, whether a right fix was given in the same leg until then."""
    right = track.has_fix & (error_m(track) <= WRONG_M)
    known = np.zeros(len(track), np.bool_)
    for rows in legs_of(track):
        known[rows] = np.logical_or.accumulate(right[rows])
    return known


def legs_of(track: PosePredictions) -> list[Int64Array]:
    """Return the rows of each leg."""
    if not len(track):
        return []
    keys = np.column_stack([track.journey, track.leg])
    number = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
    return [np.flatnonzero(number == i) for i in range(number.max() + 1)]


def mahalanobis(fixes: PosePredictions) -> Float64Array:
    """Return the squared Mahalanobis length (N,) of the horizontal errors; infinite without a covariance."""
    return squared_mahalanobis(fixes.pose[:, :2] - fixes.truth[:, :2], fixes.covariance[:, :2, :2])
