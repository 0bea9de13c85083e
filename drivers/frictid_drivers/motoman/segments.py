"""From a joint's motions to the segments of a job, and back to the command that the controller makes of them.

=================  ==============================================================================================
segment            command at tick k = 1..n, from p, where the segment before it ended; rounded to whole pulses
=================  ==============================================================================================
``H:n``            p
``G:n``            none: the position loop is open, a person guides the axis; it is held again where it then stands
``L:n:q``          p + (q - p) k/n
``M:n:q``          p + (q - p) (10 u^3 - 15 u^4 + 6 u^5), u = k/n
``C:a:n1:n2...``   per cycle of n_i ticks: p + a/2 (1 - cos(2 pi k / n_i)); ends at p
=================  ==============================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictid_drivers.motoman.joint_units import AxisUnits
from frictid_hil.errors import PlanRefused
from frictid_hil.plan.plan import Corners, Cycles, Hold, Motion, Move, Sine, WarmUp

GUIDED = "guided"  # name of a ``Hold`` during which a person guides the joint by hand, the friction table in force

_WHOLE_TICK = 1e-3  # how far a cycle may be from whole ticks, in ticks


@dataclass(frozen=True, slots=True)
class JobMotion:
    """A whole plan of one joint in the controller's terms."""

    start: int  # pulses
    segments: tuple[str, ...]  # texts of the job
    command: NDArray[np.int64]  # pulses at every tick from the start, shape (n,)
    motion_ticks: tuple[int, ...]  # tick at which each motion begins, and the end: shape (motions + 1,)


def motion_segments(motions: Sequence[Motion], units: AxisUnits, tick_s: float) -> JobMotion:
    """Segments of the motions, in order; ``PlanRefused`` where there is none, or cycles are no whole ticks."""
    start = units.pulses(float(motions[0].position_rad(np.zeros(1))[0]))
    texts: list[str] = []
    command: list[int] = [start]
    motion_ticks = [0]
    for motion in motions:
        for text in _segments_of(motion, units, tick_s):
            texts.append(text)
            command += _command(text, command[-1])
        motion_ticks.append(len(command) - 1)
    return JobMotion(start, tuple(texts), np.array(command, dtype=np.int64), tuple(motion_ticks))


def _segments_of(motion: Motion, units: AxisUnits, tick_s: float) -> list[str]:
    ticks = max(1, math.ceil(motion.duration_s / tick_s - _WHOLE_TICK))
    match motion:
        case Hold():
            return [f"{'G' if motion.name == GUIDED else 'H'}:{ticks}"]
        case Move():
            return [f"M:{ticks}:{units.pulses(motion.to_rad)}"]
        case Sine():
            each = max(4, round(motion.duration_s / motion.repeats / tick_s))
            return [_cycles(motion.amplitude_rad, [each] * motion.repeats, units)]
        case WarmUp():
            # A job cannot end early: friction that has settled before is warmed on to the end.
            each = max(4, round(motion.cycle_s / tick_s))
            return [_cycles(motion.amplitude_rad, [each] * round(motion.duration_s / motion.cycle_s), units)]
        case Cycles():
            boundaries = motion.procedure.cycle_starts_s / tick_s
            whole = np.round(boundaries).astype(np.int64)
            if np.abs(boundaries - whole).max() > _WHOLE_TICK:
                raise PlanRefused(
                    f"the cycles are no whole number of {tick_s * 1e3:g} ms ticks",
                    next_step="round their durations to the controller's tick (capability cycle_quantum_s)",
                )
            return [_cycles(motion.procedure.amplitude_rad, np.diff(whole).tolist(), units)]
        case Corners():
            corners = np.round(np.asarray(motion.times_s) / tick_s).astype(np.int64)
            return [
                f"L:{count}:{units.pulses(position_rad)}"
                for count, position_rad in zip(np.diff(corners).tolist(), motion.positions_rad[1:], strict=True)
                if count > 0
            ]
    raise PlanRefused(f"a serial controller in batch has no segment for the motion {motion.name!r}")


def _cycles(amplitude_rad: float, ticks: Sequence[int], units: AxisUnits) -> str:
    return ":".join(map(str, ["C", units.pulses(amplitude_rad), *ticks]))


def _command(text: str, here: int) -> list[int]:
    """The command of one segment, tick by tick, as the table above says."""
    kind, first, *rest = text.split(":")
    if kind in ("H", "G"):
        return [here] * int(first)
    if kind == "C":
        angles = np.concatenate([2 * np.pi * np.arange(1, int(n) + 1) / int(n) for n in rest])
        path = here + int(first) / 2 * (1 - np.cos(angles))
    else:
        u = np.arange(1, int(first) + 1) / int(first)
        path = here + (int(rest[0]) - here) * (u if kind == "L" else 10 * u**3 - 15 * u**4 + 6 * u**5)
    return [int(pulses) for pulses in np.rint(path)]
