"""How much time a calibration may take: three programmes, and what accuracy each was measured to give.

The published procedure spends a cycle on each of N equally spaced speeds. Least squares reads every sample between
the reversals, so that two or three well-chosen speeds tell nearly the same curve in a fraction of the time; the limit
is the slowest speed, one cycle of which takes pi A / v.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from frictid_hil.errors import UsageError
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.units import degrees, format_angle, format_velocity

_TOP = 115.0
"""Peak speed of the paper, deg/s, for which the speeds of the short programmes were chosen; they scale with V."""
_AMPLITUDE, _CYCLES, _RATE_HZ = 20.0, 10, 1000.0  # with which the errors below were measured; A in degrees


@dataclass(frozen=True, slots=True)
class Programme:
    """A choice of speeds and of the estimator that goes with them."""

    name: str
    shares: tuple[float, ...]  # peak speeds as shares of V; empty for the N equally spaced ones of the robot file
    method: str  # estimator unless one is asked for
    # Error over the curve's measured range, worst joint and seed of the simulated hp3j, rigid or flexible (A = 20 deg,
    # V = 115 deg/s, 1 kHz), as ``benchmarks/programmes.py`` prints it.
    error_percent: float

    def note(self, procedure: Procedure, rate_hz: float, quantum_s: float = 0.0) -> str:
        """What to expect, accuracy only where measured; ``quantum_s`` of a controller that cycles by itself, else 0."""
        cycles = len(self.shares) or _CYCLES
        compared = (
            (f"A = {format_angle(procedure.amplitude_rad)}", degrees(procedure.amplitude_rad), _AMPLITUDE),
            (f"V = {format_velocity(procedure.velocity_rad_s)}", degrees(procedure.velocity_rad_s), _TOP),
            (f"N = {procedure.cycles}", procedure.cycles, cycles),
            (f"{rate_hz:g} Hz", rate_hz, _RATE_HZ),
        )
        other = [said for said, here, measured in compared if not math.isclose(here, measured, rel_tol=0.02)]
        other += ["a controller that cycles by itself"] if quantum_s else []
        conditions = f"simulated hp3j, A = {_AMPLITUDE:g} deg, V = {_TOP:g} deg/s, N = {cycles}, {_RATE_HZ:g} Hz"
        promise = f"error at most {self.error_percent:g} % over the measured speeds ({conditions})"
        if other:
            promise = f"its error was not measured for {', '.join(other)}; where it was: {promise}"
        return (
            f"programme {self.name}: {procedure.cycles} speeds, {procedure.duration_s:.1f} s of cycles per joint, by "
            f"{self.method}; {promise}"
        )


PROGRAMMES = {
    programme.name: programme
    for programme in (
        Programme("thorough", (), "aligned", 0.25),
        Programme("standard", (12 / _TOP, 60 / _TOP, 1.0), "least-squares", 0.3),
        Programme("quick", (30 / _TOP, 1.0), "least-squares", 0.45),
    )
}


def programme(name: str) -> Programme:
    """The programme of that name (``UsageError``: there is none)."""
    if name not in PROGRAMMES:
        raise UsageError(f"no programme {name!r}; there are {', '.join(PROGRAMMES)}")
    return PROGRAMMES[name]
