"""One linear model of the whole recording: friction of both directions, inertia, gravity, bias and motor-angle ripple.

    torque = I a + g_c cos q + g_s sin q + bias + sgn(v) sum_k F_k h_k(|v|) + sum_k E_k h_k(|v|) + ripple(q, v)

h_k are hat functions over the speed: F_k is the odd part of the friction at knot k, E_k the even part (direction
asymmetry), zero at v = 0, where it cannot be told from the bias. All columns pass one zero-phase kernel, which changes
no coefficient. The first milliradians after each reversal are left out, where friction is still a spring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.clustered import Prior, solve
from frictid_hil.friction.recording import CycleRecording, Motion, around
from frictid_hil.friction.trajectory import Array

RIPPLE_ORDERS = (1.0, 2.0, 4.0)  # per motor revolution: an eccentric shaft, a wave generator's lobes, their overtone
GUARD_RAD = 0.005  # travel after each reversal, where friction is still a spring; at most a twelfth of the amplitude
EVEN_KNOTS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # shares of the highest speed: asymmetry changes slowly with it
BIAS_PRIOR = 0.15  # over a short travel constant and gravity look alike: a bias within this share of the friction
BEND_PRIOR = 0.005  # share of the friction by which a curve leaves its neighbours' line above the slow knots
FINE = 0.1
"""Width of the kernel in radians of the fastest cycle. Three widths after each reversal are lost with what is guarded:
at 0.2 a programme of two speeds saw nothing between the first and three quarters of the second, 0.3 % became 1.2 %."""

FAST_SHARE = 0.09  # knots from this share of the highest speed on are fast ones
_SPEED_BINS, _LEAST_IN_BIN = 20, 20
_REACH = 4.5  # half length of the kernel in widths


@dataclass(frozen=True, slots=True)
class Blocks:
    """Which columns of the model mean what."""

    inertia: int  # index of I
    gravity: int | None  # index of g_c; g_s follows (None on a prismatic axis)
    bias: int  # index
    odd: slice  # F_k at the knots
    even: slice  # E_k at EVEN_KNOTS but the first, times the highest knot
    ripple: slice  # cos of every order, sin of every order; plain, times direction, times velocity
    extra: slice  # further columns that the caller brought
    size: int  # number of columns


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The solved model."""

    blocks: Blocks  # meaning of the coefficients
    knots: Array  # speeds of the odd hats that were observed, shape (K,)
    values: Array  # coefficients, shape (size,)
    covariance: Array  # from the misfit of every quarter cycle, shape (size, size)
    freedom: Array  # degrees of freedom behind each variance, shape (size,)
    per_second_of_skew: Array  # change of the coefficients per second of undeclared torque delay, shape (size,)
    per_doubt: Array  # change of the coefficients for one of each doubtful column less in the torque, shape (size, m)
    unobserved: Array  # speeds of the hats that too few samples saw; they were left out
    residual_rms_nm: float  # of the filtered torque
    beats_nm: float  # standard deviation of what comes again at each speed and is no line between two knots

    @property
    def odd_nm(self) -> Array:
        """F_k, shape (K,)."""
        return self.values[self.blocks.odd]

    def even_nm(self, speed_rad_s: Array) -> Array:
        """Even part of the friction, 0 at rest, same shape as the speeds."""
        levels = np.concatenate([[0.0], self.values[self.blocks.even]])
        return np.asarray(np.interp(speed_rad_s, self.knots[-1] * EVEN_KNOTS, levels))

    def deviation(self, skew_uncertainty_s: float) -> Array:
        """One standard deviation of every coefficient, undeclared skew included, shape (size,)."""
        skew = self.per_second_of_skew * skew_uncertainty_s
        return np.asarray(np.sqrt(np.diag(self.covariance) + skew**2))


def fit(
    recording: CycleRecording,  # for its procedure, gear ratio, kind of axis and declared skew
    motion: Motion,  # its synchronised columns
    knots: Array,  # speeds of the odd hats, increasing, the first may be 0, shape (k,)
    level_nm: float,  # typical friction torque; scale of the prior on the bias
    *,
    width_rad: float = FINE,  # of the kernel, in radians of the fastest cycle
    extra: Array | None = None,  # further columns of the model, shape (n, m)
    # Within how much of zero each of their coefficients is expected; empty: nothing is.
    expected: tuple[float, ...] = (),
    doubtful: Array | None = None,  # columns of which the torque may hold more or less than was taken off, shape (n, m)
) -> Fit:
    """Solve the model on every sample that is not guarded; ``IdentificationError``: too few, or dependent columns."""
    chosen = _choose(recording, motion, width_rad)
    observed = chosen.observed(motion, knots)
    columns, blocks = _columns(recording, motion, knots[observed], extra)
    late = np.gradient(motion.torque_nm, motion.smoother.step_s)
    doubts = np.zeros((late.size, 0)) if doubtful is None else doubtful
    both = np.column_stack([columns, motion.torque_nm, late, doubts])
    both = _smoothed_rows(both, chosen.rows, chosen.width)
    wished = [Prior(np.eye(blocks.size)[blocks.extra.start + k], share, 0.0) for k, share in enumerate(expected)]
    solved = solve(
        both[:, : blocks.size],
        both[:, blocks.size :],
        chosen.quarter[chosen.rows],
        [*_priors(blocks, knots[observed], level_nm, chosen.rows_alike), *wished],
        recording.where,
    )
    return Fit(
        blocks,
        knots[observed],
        solved.values,
        solved.covariance,
        solved.freedom,
        per_second_of_skew=-solved.others[:, 0],
        per_doubt=-solved.others[:, 1:],
        unobserved=knots[~observed],
        residual_rms_nm=solved.residual_rms,
        beats_nm=_beats_nm(
            motion.velocity_rad_s[chosen.rows],
            both[:, blocks.size] - both[:, : blocks.size] @ solved.values,
            knots[observed],
        ),
    )


def _beats_nm(velocity: Array, rest: Array, knots: Array) -> float:
    """What is left at each fast knot's speed both ways, which the scatter of quarters that err alike does not tell."""
    speed = np.abs(velocity)
    number = np.floor(speed / knots[-1] * _SPEED_BINS).astype(np.int64)
    inside = (speed >= FAST_SHARE * knots[-1]) & (number < _SPEED_BINS)
    count = np.bincount(number[inside], minlength=_SPEED_BINS)
    sums = np.bincount(number[inside], (np.sign(velocity) * rest)[inside], _SPEED_BINS)
    seen = count >= _LEAST_IN_BIN
    return float(np.sqrt(np.mean((sums[seen] / count[seen]) ** 2))) if seen.any() else 0.0


class Unexplained:
    """What the model leaves of the torque, and how much less it would leave with one column more."""

    def __init__(
        self, recording: CycleRecording, motion: Motion, knots: Array, *, width_rad: float, extra: Array
    ) -> None:
        """Arguments and errors are those of ``fit``."""
        self._chosen = _choose(recording, motion, width_rad)
        observed = self._chosen.observed(motion, knots)
        columns, _ = _columns(recording, motion, knots[observed], extra)
        both = self._smoothed(np.column_stack([columns, motion.torque_nm]))
        scale = np.linalg.norm(both, axis=0)
        scale[scale < 1e-9 * scale.max()] = np.inf
        self._basis = np.linalg.qr(both[:, :-1] / scale[:-1])[0]
        self._rest = self._outside(both[:, -1:])[:, 0]

    def power_with(self, columns: Array) -> Array:
        """Mean square that remains with each column of (n, k) added alone, never with a negative amount, shape (k,)."""
        outside = self._outside(self._smoothed(columns))
        power = np.sum(outside**2, axis=0)
        gained = np.maximum(self._rest @ outside, 0.0) ** 2 / np.where(power > 0, power, np.inf)
        return np.asarray((self._rest @ self._rest - gained) / self._rest.size)

    @property
    def power(self) -> float:
        """Mean square that remains without."""
        return float(self._rest @ self._rest) / self._rest.size

    @property
    def free(self) -> float:
        """How many independent samples the model leaves to chance."""
        return float(max(self._rest.size / self._chosen.rows_alike - self._basis.shape[1], 1.0))

    def _smoothed(self, columns: Array) -> Array:
        return _smoothed_rows(columns, self._chosen.rows, self._chosen.width)

    def _outside(self, columns: Array) -> Array:
        return np.asarray(columns - self._basis @ (self._basis.T @ columns))


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """Which samples the model is solved on (``rows``, some of those that are not guarded), and by which kernel."""

    width: float
    quarter: NDArray[np.int64]
    kept: NDArray[np.bool_]
    rows: NDArray[np.int64]
    rows_alike: float

    def observed(self, motion: Motion, knots: Array) -> NDArray[np.bool_]:
        """Hats that enough samples saw."""
        seen = np.square(hat_functions(np.abs(motion.velocity_rad_s[self.kept]), knots)).sum(axis=0)
        return np.asarray(seen > 10)


def _choose(recording: CycleRecording, motion: Motion, width_rad: float) -> _Chosen:
    step_s = motion.smoother.step_s
    width_s = width_rad / float(recording.procedure.angular_frequencies_rad_s[-1])
    width = float(np.clip(width_s, 3 * step_s, max(0.02, 3 * step_s))) / step_s
    quarter, travel = _quarters(recording, motion)
    guard = min(np.inf if recording.prismatic else GUARD_RAD, recording.procedure.amplitude_rad / 12)
    spoiled = (quarter < 0) | (travel < guard)
    spoiled[around(motion.time_s, recording.stops_s)] = True
    # What lies beyond the ends of the recording is as unknown as what is guarded.
    kept = ~binary_dilation(spoiled, iterations=int(np.ceil(3 * width)), border_value=1)
    every = max(1, int(width))  # what the kernel leaves needs no more: it passes 0.7 % of half this rate
    thin = np.zeros_like(kept)
    thin[::every] = True
    rows = np.flatnonzero(kept & thin)
    if rows.size < 100:
        raise IdentificationError(
            f"only {rows.size} usable samples for the least-squares model",
            where=recording.where,
            cause="cycles too short for this sampling rate",
        )
    return _Chosen(width, quarter, kept, rows, 2 * np.sqrt(np.pi) * width / every)


def _smoothed_rows(columns: Array, rows: NDArray[np.int64], width: float) -> Array:
    """The given rows of the columns after a Gaussian of ``width`` samples; nothing else is computed."""
    reach = int(np.ceil(_REACH * width))
    taps = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (taps / width) ** 2)
    weights /= weights.sum()
    smoothed = np.zeros((rows.size, columns.shape[1]))
    for tap, weight in zip(taps, weights, strict=True):
        smoothed += weight * columns[np.clip(rows + tap, 0, columns.shape[0] - 1)]
    return smoothed


def hat_functions(speed: Array, knots: Array) -> Array:
    """Weights of the hats at each speed, shape (n, k): rows sum to 1; lines go on beyond the outer knots."""
    n = np.clip(np.searchsorted(knots, speed, side="right") - 1, 0, knots.size - 2)
    share = (speed - knots[n]) / (knots[n + 1] - knots[n])
    hats = np.zeros((speed.size, knots.size))
    row = np.arange(speed.size)
    hats[row, n] = 1 - share
    hats[row, n + 1] = share
    return hats


def ripple_waves(recording: CycleRecording, position_rad: Array, orders: tuple[float, ...] = RIPPLE_ORDERS) -> Array:
    """cos of every order of the motor angle, then sin, shape (n, 2 * orders); no columns without a gear ratio."""
    if recording.prismatic or not np.isfinite(recording.gear_ratio):
        return np.zeros((position_rad.size, 0))
    angle = recording.gear_ratio * position_rad[:, None] * np.array(orders)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _columns(recording: CycleRecording, motion: Motion, knots: Array, extra: Array | None) -> tuple[Array, Blocks]:
    q, v, a = motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2
    if knots.size < 3:
        raise IdentificationError("too few speeds were observed for a curve", where=recording.where)
    sign, speed = np.sign(v)[:, None], np.abs(v)
    waves = ripple_waves(recording, q)
    gravity: Array = np.zeros((q.size, 0)) if recording.prismatic else np.column_stack([np.cos(q), np.sin(q)])
    parts = (
        a[:, None],
        gravity,
        np.ones((q.size, 1)),
        sign * hat_functions(speed, knots),
        hat_functions(speed, knots[-1] * EVEN_KNOTS)[:, 1:],
        np.column_stack([waves, sign * waves, v[:, None] * waves]),
        np.zeros((q.size, 0)) if extra is None else extra,
    )
    ends = np.cumsum([part.shape[1] for part in parts]).tolist()
    blocks = Blocks(
        inertia=0,
        gravity=None if recording.prismatic else 1,
        bias=ends[2] - 1,
        odd=slice(ends[2], ends[3]),
        even=slice(ends[3], ends[4]),
        ripple=slice(ends[4], ends[5]),
        extra=slice(ends[5], ends[6]),
        size=ends[6],
    )
    return np.column_stack(parts), blocks


def _quarters(recording: CycleRecording, motion: Motion) -> tuple[NDArray[np.int64], Array]:
    """Quarter cycle of each sample (-1: outside the cycles) and the travel since the last reversal."""
    procedure, time = recording.procedure, motion.time_s
    starts = [(float(start), n) for n, start in enumerate(procedure.cycle_starts_s[:-1])]
    if recording.repeat is not None:
        starts.append((recording.repeat.start_s, recording.repeat.cycle - 1))
    quarter = np.full(time.size, -1, dtype=np.int64)
    travel = np.zeros(time.size)
    for k, (start, n) in enumerate(starts):
        length = 2 * np.pi / procedure.angular_frequencies_rad_s[n]
        edges = np.searchsorted(time, start + length * np.arange(5) / 4)
        for j in range(4):
            quarter[edges[j] : edges[j + 1]] = 4 * k + j
        for j, path in ((0, motion.position_rad), (2, -motion.position_rad)):
            begin, end = int(edges[j]), int(edges[j + 2])
            around = slice(max(0, 2 * begin - int(edges[j + 1])), int(edges[j + 1]))
            if end - begin < 4:
                continue
            turn = around.start + int(np.argmin(path[around]))  # the joint lags its command
            travel[max(begin, turn) : end] = path[max(begin, turn) : end] - path[turn]
    return quarter, travel


def _priors(blocks: Blocks, knots: Array, level_nm: float, rows_alike: float) -> list[Prior]:
    bias = np.zeros(blocks.size)
    bias[blocks.bias] = 1.0
    # Misfit that lasts a pass looks like a bias, however many samples the pass has.
    priors = [Prior(bias, BIAS_PRIOR * level_nm, 0.0)]
    fast = np.flatnonzero(knots >= 0.09 * knots[-1])
    for k in fast[1:-1]:
        before, after = knots[k] - knots[k - 1], knots[k + 1] - knots[k]
        nearest = min(before, after)
        bend = np.zeros(blocks.size)
        bend[blocks.odd.start + k - 1] = nearest / before
        bend[blocks.odd.start + k] = -nearest / before - nearest / after
        bend[blocks.odd.start + k + 1] = nearest / after
        priors.append(Prior(bend, BEND_PRIOR * level_nm, rows_alike))
    return priors
