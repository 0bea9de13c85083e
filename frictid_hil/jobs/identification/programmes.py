"""How much time a calibration may take: three programmes, and what accuracy each was measured to give.

The published procedure spends a cycle on each of N equally spaced speeds. Least squares reads every sample between
the reversals, so that two or three well-chosen speeds tell nearly the same curve in a fraction of the time; the limit
is the slowest speed, one cycle of which takes pi A / v.
"""

from __future__ import annotations

from dataclasses import dataclass

from frictid_hil.errors import UsageError
from frictid_hil.friction.trajectory import Procedure

_TOP = 115.0
"""Peak speed of the paper, deg/s, for which the speeds of the short programmes were chosen; they scale with V."""


@dataclass(frozen=True, slots=True)
class Programme:
    """One way to spend the time.

    Attributes:
        name: as typed.
        shares: peak speeds as shares of V; empty for the N equally spaced ones of the robot file.
        method: estimator unless one is asked for.
        error_percent: error over the curve's measured range, worst joint and seed of the simulated hp3j, rigid or
            flexible (A = 20 deg, V = 115 deg/s, 1 kHz), as ``benchmarks/programmes.py`` prints it.
    """

    name: str
    shares: tuple[float, ...]
    method: str
    error_percent: float

    def note(self, procedure: Procedure) -> str:
        """What a person should expect of it, in a sentence."""
        return (
            f"programme {self.name}: {procedure.cycles} speeds, {procedure.duration_s:.1f} s of cycles per joint, by "
            f"{self.method}; measured error at most {self.error_percent:g} % over the measured speeds (simulated hp3j, "
            "A = 20 deg, benchmarks/programmes.py)"
        )


PROGRAMMES = {
    programme.name: programme
    for programme in (
        Programme("thorough", (), "aligned", 0.25),
        Programme("standard", (12 / _TOP, 60 / _TOP, 1.0), "least-squares", 0.3),
        Programme("quick", (30 / _TOP, 1.0), "least-squares", 0.45),
    )
}
DEFAULT = PROGRAMMES["thorough"]


def programme(name: str) -> Programme:
    """The programme of that name.

    Raises:
        UsageError: there is none.
    """
    if name not in PROGRAMMES:
        raise UsageError(f"no programme {name!r}; there are {', '.join(PROGRAMMES)}")
    return PROGRAMMES[name]
