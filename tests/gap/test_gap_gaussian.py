"""The compiled integrals against the same by dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.gaussian import each_alone, together


def problem(seed: int, scale: float) -> tuple[Array, Array, Array]:
    """Gram matrix and right side of ten columns, the last two alike, and means before anything is recorded."""
    random = np.random.default_rng(seed)
    x = scale * random.standard_normal((40, 10))
    x[:, 9] = x[:, 8]
    return x.T @ x, x.T @ random.standard_normal(40), random.standard_normal(10)


def dense(gram: Array, right: Array, centre: Array) -> tuple[float, Array, Array]:
    """(What columns add to the log chance, mean, covariance) for a unit prior about ``centre``."""
    inner = gram + np.eye(right.size)
    covariance = np.linalg.inv(inner)
    target = right + centre
    gain = 0.5 * target @ covariance @ target - 0.5 * centre @ centre - 0.5 * np.linalg.slogdet(inner)[1]
    return float(gain), covariance @ target, covariance


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_set_of_columns_is_integrated_at_every_point(scale: float) -> None:
    each = [problem(seed, scale) for seed in range(3)]
    at, firsts, centre = np.array([7, 0, 3, 8, 9]), np.array([0, 3]), each[0][2][:5]
    gain, mean, variance = together(
        np.array([g for g, _, _ in each]), np.array([r for _, r, _ in each]), centre, at, firsts
    )
    for k, (gram, right, _) in enumerate(each):
        told, middle, covariance = dense(gram[np.ix_(at, at)], right[at], centre)
        assert gain[k] == pytest.approx(told, rel=1e-6, abs=1e-9)
        assert mean[k] == pytest.approx(middle[firsts], rel=1e-5, abs=1e-9)
        assert variance[k] == pytest.approx(np.diag(covariance)[firsts], rel=1e-5)


@pytest.mark.parametrize("held", [(), (1, 4)])
def test_each_block_adds_what_it_adds_beside_those_that_are_held(held: tuple[int, ...]) -> None:
    gram, right, centre = problem(5, 1.0)
    at, starts, sizes = np.array(held, dtype=int), np.array([0, 2, 5]), np.array([1, 2, 4])
    bounded = np.isin(np.arange(10), [0, 2, 3, 6])
    solved = np.linalg.solve(gram[np.ix_(at, at)] + np.eye(at.size), gram[at])
    reduced = right - solved.T @ (right[at] + centre[at])
    gain, mean, variance = each_alone(gram, reduced, centre, starts, sizes, bounded, at, solved)
    alone = dense(gram[np.ix_(at, at)], right[at], centre[at])[0]
    for k, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        own = np.arange(start, start + size)
        both = np.concatenate([own, at])
        told, middle, covariance = dense(gram[np.ix_(both, both)], right[both], centre[both])
        assert gain[k] == pytest.approx(told - alone)
        assert mean[own] == pytest.approx(middle[:size])
        assert variance[own] == pytest.approx(np.where(bounded[own], np.diag(covariance)[:size], 0.0))
