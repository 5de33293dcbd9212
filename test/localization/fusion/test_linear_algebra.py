"""The closed forms against NumPy's solvers."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.localization.fusion.linear_algebra import (
    at_least,
    determinant,
    diagonal,
    log_sum,
    mahalanobis_squared,
    square_root,
)


def covariances(count: int) -> np.ndarray:
    roots = np.random.default_rng(0).normal(size=(count, 3, 3))
    return np.asarray(roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3))


def test_closed_forms_are_those_of_the_solvers() -> None:
    covariance, offsets = covariances(50), np.random.default_rng(1).normal(size=(50, 3))
    expected = np.einsum("ni,nij,nj->n", offsets, np.linalg.inv(covariance), offsets)
    np.testing.assert_allclose(mahalanobis_squared(offsets, covariance), expected, rtol=1e-9)
    np.testing.assert_allclose(determinant(covariance), np.linalg.det(covariance), rtol=1e-9)
    roots = square_root(covariance)
    np.testing.assert_allclose(roots @ roots, covariance, atol=1e-9)
    np.testing.assert_allclose(roots, roots.transpose(0, 2, 1), atol=1e-12)


def test_a_covariance_keeps_what_is_larger_than_the_floor() -> None:
    np.testing.assert_allclose(at_least(np.diag([4.0, 1e-9, 1.0])[None], 0.5, 3.0)[0], np.diag([4.0, 0.25, 1.0]))
    large = 10.0 * covariances(5)
    np.testing.assert_allclose(at_least(large, 0.1, 0.5), large, rtol=1e-9)


def test_a_diagonal_can_be_written_to() -> None:
    matrices = covariances(3)
    diagonal(matrices)[:, :2] = 7.0
    assert (matrices[:, [0, 1], [0, 1]] == 7.0).all() and (matrices[:, 2, 2] != 7.0).all()


def test_sums_of_logarithms() -> None:
    assert log_sum(np.log([[1.0, 2.0], [3.0, 4.0]])) == pytest.approx(np.log(10.0))
    np.testing.assert_allclose(log_sum(np.log([[1.0, 2.0], [3.0, 4.0]]), axis=1), np.log([3.0, 7.0]))
    assert log_sum(np.empty(0)) == -np.inf
