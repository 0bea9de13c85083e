"""The stretch that shows by how much torque is late (``friction.skew``): its motions, and its samples."""

from __future__ import annotations

import math
from dataclasses import replace

from frictid_hil.errors import UsageError
from frictid_hil.friction.intervals import Terms
from frictid_hil.friction.recording import CycleRecording
from frictid_hil.friction.rigid_body import COVERAGE
from frictid_hil.friction.trajectory import Procedure, peak_acceleration
from frictid_hil.plan.plan import SKEW, Shake
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.recording.samples import Mark, Samples

_DURATION_S = 2.0  # of each of the four motions
_SLOW_HZ, _FAST_HZ = 4.0, 8.0
"""Of the shaking: in proportion to their squares delay shows; a link of 25 Hz must not resonate with them."""
_SWEEP = 0.5  # peak speed of the slow motion as a share of V: friction is then far from its rise towards standstill
_SHAKE = 0.7  # speed of the shaking as a share of the slow motion's, so that it never reverses it
_ACCELERATION = 0.75
"""Of the shaking at most, as a share of what the fastest cycle takes; a quarter of that is the slow motion's."""
_LEAST_RATE_HZ = 200.0
_WIDE = 0.01  # of the friction: an interval that is narrower needs nothing


def shaking(start_rad: float, procedure: Procedure) -> list[Shake]:
    """Two frequencies at the same speed, each once more in antiphase, within travel and acceleration of the cycles."""
    sweep_rad_s = _SWEEP * procedure.velocity_rad_s
    turns = max(1, round(sweep_rad_s * _DURATION_S / (math.pi * procedure.amplitude_rad)))
    amplitude = min(procedure.amplitude_rad, sweep_rad_s * _DURATION_S / (math.pi * turns))
    sweep_rad_s = math.pi * amplitude * turns / _DURATION_S
    slow, fast = (_beside(round(hz * _DURATION_S), turns) for hz in (_SLOW_HZ, _FAST_HZ))
    frequency_rad_s = 2 * math.pi * fast / _DURATION_S
    # The shaking swells and fades within every pass, which adds to its speed where passes are short.
    swelling = math.hypot(1.0, 2.0 * turns / slow)
    speed_rad_s = min(_SHAKE * sweep_rad_s / swelling, _ACCELERATION * peak_acceleration(procedure) / frequency_rad_s)
    motions: list[Shake] = []
    for periods in (slow, fast):
        shake_rad = speed_rad_s * _DURATION_S / (2 * math.pi * periods)
        for signed_rad in (shake_rad, -shake_rad):
            motions.append(Shake(start_rad, amplitude, _DURATION_S, periods, signed_rad, SKEW, turns))
    return motions


def _beside(periods: int, turns: int) -> int:
    """No multiple of the turns, so that no two passes shake at the same places."""
    return periods + 1 if turns > 1 and periods % turns == 0 else periods


def shaking_note() -> str:
    """Return the note that a plan carries whose joints shake."""
    return (
        f"every joint shakes at {_SLOW_HZ:g} and {_FAST_HZ:g} Hz for {4 * _DURATION_S:g} s, within travel, speed and "
        "acceleration of its cycles: that measures by how much its torque is late"
    )


def wanted_note(terms: Terms, level_nm: float) -> str:
    """What to tell where little but the declared timing keeps the curve from being known; else empty."""
    half_nm = float(terms.half_width_nm[-1])
    if half_nm < _WIDE * level_nm or 2.0 * (COVERAGE * float(terms.skew[-1])) ** 2 < half_nm**2:
        return ""
    return (
        f"of the interval at the highest speed, +-{100 * half_nm / level_nm:.1f} %, most is what the declared timing "
        "leaves open: `calibrate --measure-skew` measures it"
    )


def refuse_where_the_bus_is_too_slow(setup: RobotSetup, quantum_s: float, *, together: bool) -> None:
    """Judge, before anything is planned, whether the stretch can be made (``UsageError``: it cannot)."""
    if together:
        raise UsageError(
            "the torque's delay is measured on one joint at a time: others would shake it, too",
            next_step="leave --measure-skew or --together out",
        )
    if quantum_s:
        raise UsageError(
            f"this controller interpolates set-points on its own clock of {quantum_s * 1e3:g} ms and reports averages: "
            f"a shaking of {_FAST_HZ:g} Hz does not pass",
            where=setup.bus,
            next_step="leave --measure-skew out; declare the timing in the robot file's `options: timing`",
        )
    if setup.cycle_hz < _LEAST_RATE_HZ:
        raise UsageError(
            f"{setup.cycle_hz:g} set-points a second are too few to measure the torque's delay "
            f"({_LEAST_RATE_HZ:g} at least)",
            where=setup.bus,
            next_step="raise --rate, or leave --measure-skew out",
        )


def with_shaking(recording: CycleRecording, samples: Samples) -> CycleRecording:
    """The recording of a joint's cycles, knowing the stretch in which it shook, where there was one."""
    marks = samples.marked(SKEW)
    if not marks:
        return recording
    part = samples.during(Mark(SKEW, marks[0].start_ns, marks[-1].end_ns))
    assert part.torque_nm is not None  # the cycles have it
    return replace(
        recording,
        shaken=replace(
            recording,
            time_s=part.time_s - marks[0].start_ns * 1e-9,
            position_rad=part.position_rad,
            torque_nm=part.torque_nm,
            velocity_rad_s=None,
            command_rad=None,
            repeat=None,
            stops_s=recording.stops_s + 1e-9 * (samples.marked("cycles")[0].start_ns - marks[0].start_ns),
        ),
    )
