"""What causes change on held-out recordings, channel by channel, with the standard error of the change.

A cause that closes the torque's gap while it opens the position's is not what is wrong with the joint: both come from
one motion. Squares are summed over stretches long enough to be independent; their scatter says what chance would do.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.forward import Replayed

STRETCHES = 40
"""Stretches that the judged rows are cut into; half a second or more each on a dozen seconds and more."""


@dataclass(frozen=True, slots=True)
class Change:
    """A change of held-out squares.

    Attributes:
        share: squares after minus squares before, over those before; negative is better.
        deviations: the change over its own standard error.
    """

    share: float
    deviations: float


def by_stretch(differences: Mapping[str, Replayed], channel: str) -> Array:
    """Mean squares of a channel (``torque_nm``, ``position_rad``) in each stretch of the settled rows, shape (m,)."""
    return in_stretches(np.concatenate([getattr(d, channel)[d.settled :] for d in differences.values()]))


def in_stretches(values: Array) -> Array:
    """Mean squares of each of ``STRETCHES`` stretches, shape (m,); m is smaller where there are fewer values."""
    edges = np.linspace(0, values.size, STRETCHES + 1).astype(int)
    return np.array([float(np.mean(values[a:b] ** 2)) for a, b in itertools.pairwise(edges) if b > a])


def change(before: Array, after: Array) -> Change:
    """From squares by stretch before and after."""
    total = float(np.sum(before))
    moved = after - before
    return Change(float(np.sum(moved)) / total if total > 0.0 else 0.0, deviations(moved))


def deviations(values: Array) -> float:
    """Sum over its standard error; values of shape (m,) are taken as independent."""
    total = float(np.sum(values))
    spread = float(np.std(values, ddof=1)) * math.sqrt(values.size) if values.size > 1 else 0.0
    return total / spread if spread > 0.0 else math.copysign(math.inf, total) if total else 0.0
