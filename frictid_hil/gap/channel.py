"""One channel of residuals as a linear problem: rows of all logs, and the columns by which each cause would show.

A channel is built once for a set: the plant (torque against what the believed joint asks for), the actuation (torque
against the controller's demand) and the tracking (position against command) differ in their columns alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.config.nominal import ReportFilter
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.residuals import LowPass, Recording, reported
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.inverse import Shape

FAMILY = "family "  # prefix of generic functions: they compete like a cause, and have no name that anybody could repair

STIFFNESS = "stiffness"  # shape of the term that is an error of a stated presliding stiffness


@dataclass(frozen=True, slots=True)
class Term:
    """A way in which one cause can show in a channel: columns, and what is believed of their coefficients."""

    effect: str  # the cause; empty for what has no name (timing, a rigid-body column that is off as a whole)
    shape: Shape  # the cause's nonlinear parameters
    columns: tuple[int, ...]  # numbers of its columns in the channel's table
    mean: Array  # of the coefficients before anything is recorded, shape (k,)
    deviation: Array  # one-sigma of the same, shape (k,)
    least: float = -math.inf  # of its bounded coefficients; below, it is another effect
    largest: float = math.inf  # of the same
    bounded: int = 1  # how many of its coefficients, from the first on, are bounded

    def allows(self, values: Array) -> bool:
        """Whether coefficients, shape (k,), lie within their bounds."""
        own = values[: self.bounded]
        return bool(np.all((own >= self.least) & (own <= self.largest)))


@dataclass(frozen=True, slots=True)
class Rows:
    """One log, low-passed and thinned."""

    name: str  # of the experiment
    validation: bool  # judged on, not fitted
    start_s: float  # time of its first row in the log
    y: Array  # the residual, shape (n,)
    x: Array  # every column of the channel, shape (n, m)
    known_noise: Array  # a sample of that part of y's noise which is known beforehand, shape (n,)
    told: np.ndarray  # rows that tell something of the joint; in the others that noise is too strong. Shape (n,).


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of one set."""

    name: str  # ``plant``, ``loop``, ``actuation`` or ``tracking``
    step_s: float  # of the rows
    logs: tuple[Rows, ...]  # in run order
    nuisances: tuple[Term, ...]  # what the belief may be wrong by within its tolerance; always in
    candidates: tuple[Term, ...]  # what may be there besides
    scale: float  # what a cause may well make of y, in its unit
    cutoff_hz: float  # of the low-pass that all columns have passed
    # RMS of the residual before the low-pass on the validation logs, and what noise leaves of it.
    raw: tuple[float, float] = (0.0, 0.0)
    known_floor: float = math.inf  # RMS behind the low-pass of what is known to be noise, whatever any model leaves
    # The controller was replayed between rows of the logs or on an uneven clock, so not exactly.
    between_rows: bool = False

    @property
    def of_the_joint(self) -> bool:
        """Its residual is a torque at the joint, which the inverse forms of effects describe."""
        return self.name in ("plant", "loop")

    @property
    def level_free(self) -> bool:
        """The level of a log is free, so that a constant there is no size."""
        return not self.of_the_joint

    @property
    def fitted(self) -> tuple[Rows, ...]:
        """The identification logs; all where there are none."""
        return tuple(log for log in self.logs if not log.validation) or self.logs

    @property
    def judged(self) -> tuple[Rows, ...]:
        """The validation logs; all where there are none."""
        return tuple(log for log in self.logs if log.validation) or self.logs


@dataclass
class Builder:
    """Collects columns log by log, and hands out their numbers."""

    parts: list[list[Array]]  # per log, blocks of columns of shape (n, k)
    width: int = 0  # columns so far

    def add(self, columns: Sequence[Array]) -> tuple[int, ...]:
        """Take in one block of columns per log; their numbers."""
        for part, block in zip(self.parts, columns, strict=True):
            part.append(block)
        first, self.width = self.width, self.width + columns[0].shape[1]
        return tuple(range(first, self.width))


def taken(blocks: Sequence[Array], numbers: Sequence[int], rows: int | None = None) -> Array:
    """Some columns of blocks that stand side by side, their first rows or all."""
    ends = np.cumsum([block.shape[1] for block in blocks])
    homes = [int(np.searchsorted(ends, number, side="right")) for number in numbers]
    first = ends - [block.shape[1] for block in blocks]
    return np.stack([blocks[h][:rows, n - first[h]] for n, h in zip(numbers, homes, strict=True)], axis=1)


def rows_of(
    recording: Recording,
    columns: Sequence[Array],
    residual: Array,
    low_pass: LowPass,
    *,
    first: int = 1,  # row that is told first, thinned
    known_noise: Array | None = None,
    report: ReportFilter | None = None,  # that columns and noise have still to pass
) -> Rows:
    """One log of a channel behind the low-pass."""
    noise = np.zeros(residual.size) if known_noise is None else known_noise
    blocks = [reported(block, report, recording.step_s) for block in (*columns, noise[:, None])]
    table = low_pass.thinned_blocks([*blocks, residual[:, None]])[first:-2]
    e, start_s = recording.experiment, first * low_pass.stride * recording.step_s
    told = np.ones(table.shape[0], dtype=bool)
    return Rows(e.name, e.validation, start_s, table[:, -1], table[:, :-2], table[:, -2], told)


def of_each_log(columns: Sequence[Array]) -> list[Array]:
    """Columns (n, k) of each log by itself, 0 in the others: shape (n, k * logs)."""
    return [np.kron(np.eye(len(columns))[k], own) for k, own in enumerate(columns)]


def effect_prior(
    effect: str, shape: Shape, columns: Sequence[Array], scale: float, bounds: tuple[float, float]
) -> tuple[Array, Array]:
    """(mean, one-sigma) of an effect's coefficients, shape (k,) each.

    A cause makes about the channel's scale: no more than the gap, since causes that cancel are no explanation, and no
    more than a third of the joint's friction, whatever the units of its numbers. No coefficient may carry a strength
    beyond its bound. Where the first coefficient has two finite bounds, it multiplies a whole model of the cause and
    is 1 where that is right.
    """
    low, high = bounds
    if math.isfinite(low) and math.isfinite(high):
        return np.array([1.0, *np.zeros(columns[0].shape[1] - 1)]), np.full(columns[0].shape[1], 0.25 * (high - low))
    squares = sum(np.sum(block**2, axis=0) for block in columns)
    size = np.sqrt(squares / sum(block.shape[0] for block in columns))
    count = size.size
    deviation = scale / (math.sqrt(count) * np.maximum(size, 1e-12 * scale + 1e-300))
    form = all_effects()[effect].inverse
    if form is not None:
        strengths = {p.name: max(abs(p.lower), abs(p.upper)) for p in all_effects()[effect].strengths}
        for k in range(count):
            told = form.parameters(shape, np.eye(count)[k])
            caps = [strengths[name] / abs(value) for name, value in told.items() if name in strengths and value]
            deviation[k] = min([deviation[k], *caps])
    return np.zeros(count), deviation
