"""Least squares whose rows come in bunches that err together, with priors, and an honest covariance.

Samples of one quarter cycle share whatever the model lacks there, so a quarter counts as one observation of it, however
many samples it has. What a prior may have spoilt is counted, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.trajectory import Array


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """``weights @ coefficients`` is expected within ``deviation`` of zero."""

    weights: Array  # shape (size,)
    deviation: float  # N m
    rows_alike: float  # rows of data that count as one independent piece of evidence against it (0: a quarter cycle)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Coefficients and what is known of them."""

    values: Array  # of the first target, shape (size,)
    covariance: Array  # of the values, shape (size, size)
    freedom: Array  # degrees of freedom behind each variance, shape (size,)
    others: Array  # coefficients of the other targets, shape (size, m)
    residual_rms: float  # of what remains of the first target, in its unit


def solve(x: Array, targets: Array, bunch: NDArray[np.int64], priors: list[Prior], where: str) -> Solved:
    """Least squares of every target, shape (n, 1 + m), on the same columns x, shape (n, size).

    Rows of the same number in ``bunch`` err together. Priors are on the coefficients of the first target. Columns that
    are linearly dependent are an ``IdentificationError``.
    """
    scale = np.linalg.norm(x, axis=0)
    scale[scale < 1e-9 * scale.max()] = np.inf  # a column of nothing (ripple filtered away) gets coefficient 0
    x = x / scale
    order = np.argsort(bunch, kind="stable")
    x, targets, bunch = x[order], targets[order], bunch[order]
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(bunch)) + 1, [bunch.size]])
    gram = np.array([_product(x[a:b], x[a:b]) for a, b in pairwise(bounds)])
    moment = np.array([_product(x[a:b], targets[a:b]) for a, b in pairwise(bounds)])
    whole, right = gram.sum(axis=0), moment.sum(axis=0)

    left = whole + 1e-11 * np.eye(scale.size)
    noise = float(np.mean((targets[:, 0] - x @ np.linalg.solve(left, right[:, 0])) ** 2))
    weights = np.array([noise * (p.rows_alike or x.shape[0] / len(gram)) / p.deviation**2 for p in priors])
    wished = np.array([p.weights for p in priors]).reshape(-1, scale.size) / scale
    left = left + (wished.T * weights) @ wished
    alive = np.isfinite(scale)
    spectrum = np.linalg.eigvalsh(left[np.ix_(alive, alive)])
    if spectrum[0] < 1e-10 * spectrum[-1]:
        raise IdentificationError(
            "the recording cannot tell the parts of the least-squares model apart",
            where=where,
            cause="too few cycles or too little travel",
            next_step="use --method aligned, or more cycles or travel",
        )

    solution = np.linalg.solve(left, right)
    spread, freedom = _spread(left, gram, moment[:, :, 0] - gram @ solution[:, 0])
    pulled = _pulled(left, wished, weights, np.array([p.deviation for p in priors]), solution[:, 0], spread)
    rest = targets[:, 0] - x @ solution[:, 0]
    return Solved(
        solution[:, 0] / scale,
        (spread.T @ spread + pulled.T @ pulled) / np.outer(scale, scale),
        freedom,
        solution[:, 1:] / scale[:, None],
        float(np.sqrt(np.mean(rest**2))),
    )


def _spread(left: Array, gram: Array, scores: Array) -> tuple[Array, Array]:
    """(what each quarter cycle's misfit adds to the coefficients, shape (quarters, size); their freedom, (size,)).

    Cluster-robust CR2 of Bell and McCaffrey (2002): a quarter that decides a coefficient alone pulls the solution to
    itself, so that its misfit is divided by (1 - h)^(1/2), h being its share of what is known. By 1 - h instead, the
    slowest knots looked four times as uncertain as they are.
    """
    values, vectors = np.linalg.eigh(left)
    root = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))  # root @ root.T is the inverse
    shares, axes = np.linalg.eigh(root.T @ gram @ root)
    left_over = np.maximum(1.0 - shares, 1e-3)
    inner = np.einsum("qij,qi->qj", axes, scores @ root) / np.sqrt(left_over)
    spread: Array = np.einsum("qij,qj->qi", axes, inner) @ root.T
    turned = np.einsum("qij,ki->qkj", axes, root)
    own = np.sum(turned**2 * (shares / left_over)[:, None, :], axis=2)
    pulls = np.einsum("qij,qkj->kqi", axes, turned * (shares / np.sqrt(left_over))[:, None, :])
    between = own.T[:, :, None] * np.eye(len(gram)) - pulls @ np.swapaxes(pulls, 1, 2)
    trace = np.einsum("kqq->k", between)
    freedom: Array = trace**2 / np.maximum(np.sum(between**2, axis=(1, 2)), 1e-300)
    return spread, np.maximum(freedom, 1.0)


def _pulled(left: Array, wished: Array, weights: Array, deviations: Array, solution: Array, spread: Array) -> Array:
    """How far each prior may have pulled the coefficients off, one standard deviation, shape (priors, size).

    As far as the prior allows, or, where the data know better, as far as what they say without that prior.
    """
    towards = np.linalg.solve(left, wished.T).T
    alone = np.maximum(1.0 - weights * np.sum(towards * wished, axis=1), 1e-6)
    seen = np.hypot(wished @ solution, np.linalg.norm(spread @ wished.T, axis=0)) / alone
    return np.asarray((weights * np.minimum(deviations, seen))[:, None] * towards)


def _product(x: Array, y: Array) -> Array:
    """x.T @ y in pieces too small for the algebra library to start threads: they would fight other joints' threads."""
    total = np.zeros((x.shape[1], y.shape[1]))
    for row in range(0, x.shape[0], 48):
        total += x[row : row + 48].T @ y[row : row + 48]
    return total
