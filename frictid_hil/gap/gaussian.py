"""Integrals of Gaussians in closed form: coefficients of unit prior variance, alone, together, and between bounds."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy import special

from frictid_hil.friction.trajectory import Array

ROUNDING = 1e-12  # share of a matrix' largest entry that rounding may leave in the others


def log_between(low: Array, high: Array) -> Array:
    """Logarithm of a standard normal's chance between two bounds, however far in its tail they lie."""
    swap = low > 0.0
    low, high = np.where(swap, -high, low), np.where(swap, -low, high)
    top, rest = special.log_ndtr(high), special.log_ndtr(low)
    return np.asarray(top + np.log1p(-np.exp(np.minimum(rest - top, -1e-12))))


def put_inside(values: Array, root: Array, starts: np.ndarray, low: Array, high: Array) -> Array:
    """Values put on the bounds that they lie beyond; what is like them follows as their covariance has it."""
    for _ in starts:
        beyond = np.maximum(low - values[starts], 0.0) - np.maximum(values[starts] - high, 0.0)
        worst = int(np.argmax(np.abs(beyond)))
        if beyond[worst] == 0.0:
            break
        row = root[starts[worst]]
        values = values + root @ row * (beyond[worst] / float(row @ row))
    values[starts] = np.clip(values[starts], low, high)
    return values


def integrated(gram: Array, inside: np.ndarray, outside: np.ndarray) -> tuple[Array, float]:
    """(Gram matrix of ``outside`` with the ``inside`` columns integrated out, what that adds to the log chance).

    The last of ``outside`` is the residual itself; the inside coefficients have zero mean and unit variance.
    """
    left = gram[np.ix_(outside, outside)].copy()
    if inside.size == 0:
        return left, 0.0
    known = gram[np.ix_(inside, inside)] + np.eye(inside.size)
    try:
        lower = np.linalg.cholesky(known)
    except np.linalg.LinAlgError:
        # Columns that are alike and very well known leave rounding below zero.
        lower = np.linalg.cholesky(known + ROUNDING * float(np.max(np.diag(known))) * np.eye(inside.size))
    solved = np.linalg.solve(lower, gram[np.ix_(inside, outside)])
    left -= solved.T @ solved
    gain = 0.5 * float(solved[:, -1] @ solved[:, -1])
    return left, gain - float(np.sum(np.log(np.diag(lower))))


@njit(cache=True)
def each_alone(
    gram: Array,
    right: Array,
    centre: Array,
    starts: np.ndarray,
    sizes: np.ndarray,
    bounded: np.ndarray,
    held: np.ndarray,
    solved: Array,
) -> tuple[Array, Array, Array]:
    """What each block of columns adds to the log chance beside those ``held``, (b,); means and variances, (k,).

    ``gram`` (k, k) and ``right`` (k,) are of all columns, ``right`` less what the held ones say; ``centre`` (k,) holds
    the means before anything is recorded, ``solved`` (h, k) the Gram rows of the held columns over their own part.
    Variances are those of the ``bounded`` columns (k,), 0 elsewhere.
    """
    gain, mean, variance = np.empty(starts.size), np.zeros(right.size), np.zeros(right.size)
    most = np.max(sizes)
    inner, target, unit = np.empty((most, most)), np.empty(most), np.empty(most)
    for block in range(starts.size):
        first, size = starts[block], sizes[block]
        square = 0.0
        for i in range(size):
            for j in range(i + 1):
                entry = gram[first + i, first + j]
                for k in range(held.size):
                    entry -= gram[held[k], first + i] * solved[k, first + j]
                inner[i, j] = entry
            target[i] = right[first + i] + centre[first + i]
            square += centre[first + i] ** 2
        log_determinant = _factored(inner, size)
        gain[block] = 0.5 * (_forward(inner, target, size) - square - log_determinant)
        _backward(inner, target, size)
        for i in range(size):
            mean[first + i] = target[i]
            if bounded[first + i]:
                unit[:size] = 0.0
                unit[i] = 1.0
                variance[first + i] = _forward(inner, unit, size)
    return gain, mean, variance


@njit(cache=True)
def together(
    grams: Array, rights: Array, centre: Array, at: np.ndarray, chosen: np.ndarray
) -> tuple[Array, Array, Array]:
    """What some columns add to the log chance at every point of a grid, (g,), means and variances of some, (g, f).

    ``grams`` (g, k, k) and ``rights`` (g, k) are of all columns, ``at`` (c,) are these and ``centre`` (c,) their means
    before anything is recorded; ``chosen`` (f,) counts among them.
    """
    points, size = grams.shape[0], at.size
    gain, mean, variance = np.empty(points), np.empty((points, chosen.size)), np.empty((points, chosen.size))
    inner, target, unit = np.empty((size, size)), np.empty(size), np.empty(size)
    square = np.sum(centre**2)
    for g in range(points):
        for i in range(size):
            for j in range(i + 1):
                inner[i, j] = grams[g, at[i], at[j]]
            target[i] = rights[g, at[i]] + centre[i]
        log_determinant = _factored(inner, size)
        gain[g] = 0.5 * (_forward(inner, target, size) - square - log_determinant)
        _backward(inner, target, size)
        for f in range(chosen.size):
            mean[g, f] = target[chosen[f]]
            unit[:] = 0.0
            unit[chosen[f]] = 1.0
            variance[g, f] = _forward(inner, unit, size)
    return gain, mean, variance


@njit(cache=True)
def _factored(inner: Array, size: int) -> float:
    """Turn the lower half of a Gram matrix into the Cholesky factor of it and the unit prior; logarithm of its square.

    Beside a unit prior no pivot is below 1: what rounding leaves there is put to it.
    """
    log_determinant = 0.0
    for i in range(size):
        for j in range(i + 1):
            entry = inner[i, j]
            for k in range(j):
                entry -= inner[i, k] * inner[j, k]
            if i == j:
                pivot = max(entry + 1.0, 1.0)
                log_determinant += math.log(pivot)
                inner[i, i] = math.sqrt(pivot)
            else:
                inner[i, j] = entry / inner[j, j]
    return log_determinant


@njit(cache=True)
def _forward(lower: Array, values: Array, size: int) -> float:
    """Solve with a lower triangle in place; the sum of the squares."""
    square = 0.0
    for i in range(size):
        for k in range(i):
            values[i] -= lower[i, k] * values[k]
        values[i] /= lower[i, i]
        square += values[i] ** 2
    return square


@njit(cache=True)
def _backward(lower: Array, values: Array, size: int) -> None:
    """Solve with the transposed triangle in place."""
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            values[i] -= lower[k, i] * values[k]
        values[i] /= lower[i, i]
