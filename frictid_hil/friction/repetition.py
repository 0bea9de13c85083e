"""The same motion twice within one run: what the torque reads differently then is no friction of the joint.

A torque whose scale or offset changes in mid-run bends the curve only as far as it struck, and widens its interval by
what it did. Two moments of the run with the same speed, or the same place in the same cycle, tell it as it is.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.trajectory import Array

PARTS = 8
"""Of a cycle. The first one is left out: one of the two runs may begin from rest."""
_LEAST = 4
"""Samples of a part."""
_ALIKE = 4.0
"""Samples that err together, after smoothing."""
_BAND = 0.15
"""Speeds that count as one, as a share."""
_CLEAR = 0.2
"""A speed of this share of its peak is clear of a cycle's turning points, where friction is still a spring."""


def changed_between(recording: CycleRecording, motion: Motion) -> tuple[Array, float] | None:
    """Torque of the repeated cycle less that of its first run, part by part.

    Returns:
        Mean differences, shape (PARTS - 1,), and the standard deviation that chance gives one of them, N m; None where
        no cycle was repeated completely, or it has too few samples.
    """
    repeat, time = recording.repeat, motion.time_s
    if repeat is None:
        return None
    first_s, last_s = recording.procedure.cycle_starts_s[repeat.cycle - 1 : repeat.cycle + 1]
    length_s = float(last_s - first_s)
    if time[-1] < repeat.start_s + length_s - 2.0 * motion.smoother.step_s:
        return None
    since_s = np.arange(length_s / PARTS, length_s, motion.smoother.step_s)
    once, again = (np.interp(since_s + begin, time, motion.torque_nm) for begin in (first_s, repeat.start_s))
    parts = np.array_split(again - once, PARTS - 1)
    if min(part.size for part in parts) < _LEAST:
        return None
    # A part in which something changed would excuse itself by its own spread.
    spread_nm = float(np.median([part.std() for part in parts]))
    return np.array([part.mean() for part in parts]), spread_nm / max(1.0, parts[-1].size / _ALIKE) ** 0.5


def friction_at(recording: CycleRecording, motion: Motion, speed_rad_s: float, least_samples: int) -> Array:
    """Half of forward minus backward torque of every cycle, the repeated one too, as it passes through a speed, N m.

    A cycle passes it as often faster and faster as slower and slower, and at the same places both ways: neither inertia
    nor gravity is in it. Cycles that pass it too close to a turning point, or have too few samples of it, are left out.
    """
    peaks = recording.procedure.peak_velocities_rad_s
    spans = list(pairwise(recording.procedure.cycle_starts_s.tolist()))
    repeat = recording.repeat
    if repeat is not None:
        begin_s, end_s = spans[repeat.cycle - 1]
        spans.append((repeat.start_s, repeat.start_s + end_s - begin_s))
        peaks = np.append(peaks, peaks[repeat.cycle - 1])
    time, velocity, found = motion.time_s, motion.velocity_rad_s, []
    near = np.abs(np.abs(velocity) - speed_rad_s) < _BAND * speed_rad_s
    for (begin_s, end_s), peak in zip(spans, peaks, strict=True):
        if speed_rad_s < _CLEAR * peak:
            continue
        here = near & (time >= begin_s) & (time < end_s)
        ways = [here & (velocity > 0.0), here & (velocity < 0.0)]
        if min(int(way.sum()) for way in ways) >= least_samples:
            there, back = (float(np.mean(motion.torque_nm[way])) for way in ways)
            found.append((there - back) / 2)
    return np.array(found)
