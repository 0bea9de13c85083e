"""What physics says of a recording's units: velocity against position, torque against work, times and travel.

A contradiction with a known factor (57.3: degrees) is an error; what only looks odd is a doubt, which travels with the
samples.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.recording.samples import Samples

_DEG, _RPM = 180 / math.pi, 30 / math.pi
FACTORS: tuple[tuple[float, str], ...] = (  # velocity over differenced position, and what it tells
    (_DEG, "the velocity is in degrees per second, or the position in turns of 360"),
    (1 / _DEG, "the position is in degrees"),
    (_RPM, "the velocity is in rpm"),
    (_RPM / _DEG, "the velocity is in rpm and the position in degrees"),
    (2 * math.pi, "the position is in turns"),
    (1 / (2 * math.pi), "the velocity is in turns per second"),
    (1e3, "the time is in milliseconds (or the velocity in mrad/s, mm/s)"),
    (1e3 / _DEG, "the time is in milliseconds and the position in degrees"),
    (1e3 * _DEG, "the time is in milliseconds and the velocity in degrees per second"),
    (1e3 * _RPM, "the time is in milliseconds and the velocity in rpm"),
    (1e3 * _RPM / _DEG, "the time is in milliseconds, the velocity in rpm and the position in degrees"),
    (1e6, "the time is in microseconds"),
    (1e6 / _DEG, "the time is in microseconds and the position in degrees"),
    (1e9, "the time is in nanoseconds"),
    (1e-3, "the time is said to be milliseconds and is in seconds (or the position is in mrad, mm)"),
)

_BLOCK, _BLOCKS = 2000, 10


def doubts_of(samples: Samples, *, where: str = "") -> tuple[str, ...]:
    """What looks odd; ``InputFileError`` where velocity and position contradict each other by the factor of a unit."""
    parts = _parts(samples)
    return (*_of_velocity(samples, parts, where), *_of_motion(samples), *_of_torque(samples, parts))


def _parts(samples: Samples) -> list[slice]:
    """The whole recording, or ten stretches of a long one."""
    n = len(samples)
    if n <= _BLOCK * _BLOCKS:
        return [slice(0, n)]
    return [slice(at, at + _BLOCK) for at in np.linspace(0, n - _BLOCK, _BLOCKS).astype(int).tolist()]


def velocity_factor(samples: Samples, parts: list[slice]) -> tuple[float, float] | None:
    """Velocity over differenced position in stretches, and their correlation; None where nothing moves or is there."""
    if samples.velocity_rad_s is None:
        return None
    columns = samples.time_s, samples.position_rad, samples.velocity_rad_s
    if not all(np.isfinite(samples.velocity_rad_s[part]).all() for part in parts):
        return None
    moved, summed = np.hstack([travelled(*(column[part] for column in columns)) for part in parts])
    square, other = float(moved @ moved), float(summed @ summed)
    if square <= 0.0 or other <= 0.0 or moved.size < 20:
        return None
    both = float(moved @ summed)
    return both / square, both / math.sqrt(square * other)


def travelled(time_s: Array, position_rad: Array, velocity_rad_s: Array) -> tuple[Array, Array]:
    """Travel over short stretches: as differenced, and as the integral of the velocity, shape (n - width,) each."""
    width = max(2, min(50, time_s.size // 20))
    area = np.concatenate([[0.0], np.cumsum(0.5 * (velocity_rad_s[1:] + velocity_rad_s[:-1]) * np.diff(time_s))])
    return position_rad[width:] - position_rad[:-width], area[width:] - area[:-width]


def _of_velocity(samples: Samples, parts: list[slice], where: str) -> list[str]:
    found = velocity_factor(samples, parts)
    if found is None:
        return []
    factor, correlation = found
    if abs(correlation) < 0.9 or 0.8 < factor < 1.25:
        return []
    size, why = min(FACTORS, key=lambda known: abs(math.log(abs(factor) / known[0])))
    explained = abs(math.log(abs(factor) / size)) < 0.1
    if factor < 0 and 0.8 < -factor < 1.25:
        explained, why = True, "one of them has the opposite sign"
    said = f"the velocity is {factor:.4g} times the differenced position"
    if not explained:
        return [f"{said}: another gear side or scale?"]
    raise InputFileError(
        said,
        where=where,
        cause=why,
        next_step="say the units (or `scale: -1`) in a column map; `frictid-hil columns` drafts one",
    )


def _of_motion(samples: Samples) -> list[str]:
    doubts = []
    step_s = samples.step_s
    if len(samples) >= 100 and step_s >= 0.5:
        doubts.append(f"the time steps by {step_s:.4g} s: milliseconds taken for seconds (factor 1000)?")
    elif 0.0 < step_s < 2e-6:
        doubts.append(f"the time steps by {step_s:.2g} s: seconds taken for milliseconds (factor 1000)?")
    travel = float(np.ptp(samples.position_rad))
    if not samples.prismatic and travel > 4 * math.pi:
        doubts.append(f"the joint travels {travel:.4g} rad, {travel / (2 * math.pi):.2g} turns: degrees (factor 57.3)?")
    return doubts


def _of_torque(samples: Samples, parts: list[slice]) -> list[str]:
    """Friction takes energy: a torque that is fed by it, or one that has no sign, is not what it is taken for."""
    if samples.torque_nm is None or len(samples) < 200:
        return []
    rows, torques = [], []
    times, step_s = samples.time_s, samples.step_s
    for part in parts:
        time, q, torque = times[part], samples.position_rad[part], samples.torque_nm[part]
        stride = max(1, time.size // 2000)
        span = max(2, stride, round(0.01 / max(step_s, 1e-9)))
        at = np.arange(2 * span, time.size - 2 * span, stride)
        if at.size < 20:
            return []
        velocity = _slope(q, time, at, span)
        acceleration = (_slope(q, time, at + span, span) - _slope(q, time, at - span, span)) / (
            time[at + span] - time[at - span]
        )
        rows.append(np.stack([velocity, acceleration, q[at]], axis=1))
        torques.append(torque[at])
    (velocity, acceleration, q), torque = np.concatenate(rows).T, np.concatenate(torques)
    fastest = float(np.quantile(np.abs(velocity), 0.98))
    if fastest <= 0.0 or not np.isfinite(torque).all() or not np.isfinite(acceleration).all():
        return []
    both_ways = float(np.mean(velocity > 0.1 * fastest)) > 0.1 and float(np.mean(velocity < -0.1 * fastest)) > 0.1
    if not both_ways:
        return []
    direction = np.tanh(velocity / (0.03 * fastest))
    body = [acceleration / max(float(np.abs(acceleration).max()), 1e-12), np.ones_like(q)]
    body += [np.cos(q), np.sin(q)] if not samples.prismatic else []
    matrix = np.stack([direction, np.abs(direction), *body], axis=1)
    values, *_ = np.linalg.lstsq(matrix, torque, rcond=1e-8)
    sigma = float(np.std(torque - matrix @ values))
    error = sigma / math.sqrt(max(1.0, torque.size / 20))  # neighbours are not independent
    braking, unsigned, inertia = float(values[0]), float(values[1]), float(values[2])
    if float(torque.min()) >= 0.0 and unsigned > 3 * abs(braking) and unsigned > 3 * error:
        return ["the torque is never negative though the joint moves both ways: a magnitude without its sign"]
    if braking < -6 * error and braking < -0.03 * float(np.std(torque)) and inertia < 6 * error:
        unit = "N" if samples.prismatic else "N m"
        return [
            f"friction would drive the joint by {-braking:.3g} {unit}: the torque has the opposite sign (factor -1; "
            "`scale: -1` in a column map)"
        ]
    return []


def _slope(q: Array, time: Array, at: NDArray[np.intp], span: int) -> Array:
    return np.asarray((q[at + span] - q[at - span]) / (time[at + span] - time[at - span]))
