"""The torque that a simulator misses, drawn over what it may depend on: speed, position, way, time, frequency.

Each profile is the plant's residual of all logs, low-passed, in bins: mean and middle half. A person sees at a glance
whether it is a curve over speed, a wave over position, a loop after reversals or a drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.residuals import Recording, recordings
from frictid_hil.gap.sanity import completed

BINS = 48
LEAST_ROWS = 8  # rows in a bin below which it is left out


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One curve; arrays of shape (k,)."""

    name: str  # of the curve
    x: Array  # middle of each bin
    y: Array  # mean there
    low: Array | None = None  # lower quartile; None where only one value is known
    high: Array | None = None  # upper quartile


@dataclass(frozen=True, slots=True)
class Profile:
    """The missing torque over one quantity."""

    title: str  # what it shows
    x_title: str  # quantity and unit
    y_title: str  # quantity and unit
    curves: tuple[Curve, ...]  # one or several
    caption: str  # how to read it


def missing_torque(experiments: ExperimentSet) -> tuple[Profile, ...]:
    """All profiles of a set; empty where no log has a torque."""
    logs = [r for r in recordings(completed(experiments)[0]) if r.plant_nm is not None and r.view is not None]
    if not logs:
        return ()
    residual = np.concatenate([_smooth(r, r.plant_nm) for r in logs])
    views = [r.view for r in logs if r.view is not None]
    q = np.concatenate([view.position_rad for view in views])
    v = np.concatenate([_smooth(r, view.velocity_rad_s) for r, view in zip(logs, views, strict=True)])
    moving = np.abs(v) > 0.003 * float(np.quantile(np.abs(v), 0.995))
    forth, back = moving & (v > 0.0), moving & (v < 0.0)
    torque = "measured - modelled torque [N m]"
    profiles = [
        Profile(
            "Missing torque over speed",
            "speed [rad/s]",
            torque,
            tuple(_binned(n, v[m], residual[m]) for n, m in (("forward", forth), ("backward", back)) if np.any(m)),
            "Odd: friction level or curve. Even: bias or a difference between the directions. Zero: not the speed.",
        ),
        Profile(
            "Missing torque over position",
            "position [rad]",
            torque,
            tuple(_binned(n, q[m], residual[m]) for n, m in (("forward", forth), ("backward", back)) if np.any(m)),
            "Both directions alike: gravity, bias, ripple. Mirrored: friction.",
        ),
    ]
    way, turned = _since_reversal(logs)
    near = np.isfinite(way) & (way < 0.05) & (way > 0.0)
    if np.count_nonzero(near) > 4 * LEAST_ROWS:
        profiles.append(
            Profile(
                "Missing torque after reversals",
                "way since the reversal [mrad]",
                "the same, along the new direction [N m]",
                (_binned("mean", 1e3 * way[near], (residual * turned)[near]),),
                "A dip that fades over milliradians: presliding hysteresis or play. A peak: break-away.",
            )
        )
    times, each = _by_second(logs)
    profiles.append(
        Profile(
            "Missing torque over time",
            "time since the first recording began [s]",
            "RMS of one second [N m]",
            (Curve("RMS", times, each),),
            "A slow change: warming up. Steps: payload on and off.",
        )
    )
    profiles.append(_spectrum(logs))
    return tuple(p for p in profiles if all(c.x.size for c in p.curves))


def _smooth(recording: Recording, column: Array | None) -> Array:
    assert column is not None
    return recording.low_pass(column)


def _binned(name: str, x: Array, y: Array) -> Curve:
    """Mean and quartiles of y in bins of equal width of x."""
    edges = np.linspace(float(np.min(x)), float(np.max(x)) + 1e-12, BINS + 1)
    at = np.clip(np.digitize(x, edges) - 1, 0, BINS - 1)
    order = np.argsort(at, kind="stable")
    groups = np.split(y[order], np.cumsum(np.bincount(at, minlength=BINS))[:-1])
    kept = [k for k, group in enumerate(groups) if group.size >= LEAST_ROWS]
    middle = 0.5 * (edges[1:] + edges[:-1])
    quartiles = np.array([np.quantile(groups[k], (0.25, 0.75)) for k in kept]).reshape(-1, 2)
    mean = np.array([float(np.mean(groups[k])) for k in kept])
    return Curve(name, middle[kept], mean, quartiles[:, 0], quartiles[:, 1])


def _since_reversal(logs: Sequence[Recording]) -> tuple[Array, Array]:
    """(way since the direction last changed, inf before the first change; direction of motion), all rows."""
    ways, directions = [], []
    for recording in logs:
        assert recording.view is not None
        # Half an encoder step of jitter is no reversal: direction is that of the sliding, by the slip spring.
        slip, q = recording.view.slip, recording.view.position_rad
        direction = np.sign(slip)
        path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(q)))])
        turns = np.flatnonzero(np.diff(direction) != 0.0) + 1
        start = np.full(path.size, -np.inf)
        for k in turns:
            start[k:] = path[k]
        ways.append(path - start)
        directions.append(direction)
    return np.concatenate(ways), np.concatenate(directions)


def _by_second(logs: Sequence[Recording]) -> tuple[Array, Array]:
    times, values = [], []
    for recording in logs:
        assert recording.view is not None
        rows = max(1, round(1.0 / recording.step_s))
        residual = _smooth(recording, recording.plant_nm)
        for start in range(0, residual.size - rows + 1, rows):
            times.append(recording.view.start_s + recording.step_s * (start + 0.5 * rows))
            values.append(float(np.sqrt(np.mean(residual[start : start + rows] ** 2))))
    return np.array(times), np.array(values)


def _spectrum(logs: Sequence[Recording]) -> Profile:
    """Mean square by frequency, in bands of equal width, over all logs."""
    edges = np.linspace(0.0, logs[0].low_pass.cutoff_hz, 41)
    sums, rows = np.zeros(40), 0
    for recording in logs:
        residual = _smooth(recording, recording.plant_nm)
        squares = np.abs(np.fft.rfft(residual)) ** 2 * 2.0 / residual.size
        at = np.digitize(np.fft.rfftfreq(residual.size, recording.step_s), edges) - 1
        inside = (at >= 0) & (at < 40)
        sums += np.bincount(at[inside], weights=squares[inside], minlength=40)
        rows += residual.size
    return Profile(
        "Missing torque by frequency",
        "frequency [Hz]",
        "RMS in the band [N m]",
        (Curve("RMS", 0.5 * (edges[1:] + edges[:-1]), np.sqrt(sums / rows)),),
        "At the motion's own frequencies: curve, gravity, inertia. A peak beyond them: ripple, a resonance.",
    )
