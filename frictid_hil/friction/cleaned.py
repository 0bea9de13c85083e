"""A recording brought to one instant and freed of what is no friction of its joint, before any curve is drawn.

First, torque that a missed set-point shook is taken from beside it: a drive that misses one brakes to a stand, and
jumps after the path with all the torque it has (three samples of that in one window bent a curve by 6 %). Then timing,
declared or measured; then what other joints took that moved along, or the link of a soft joint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from frictid_hil.errors import IdentificationError
from frictid_hil.friction import intervals
from frictid_hil.friction.coupling import Pull, pull
from frictid_hil.friction.identify import IdentifiedPairs
from frictid_hil.friction.link import Link, soft_link
from frictid_hil.friction.recording import CycleRecording, Motion, synchronised
from frictid_hil.friction.skew import Delay, TimeSkew, measured_skew, seen_delay

_GAP_STEPS = 3.0  # between two samples, in sample periods: a longer one has jerked the joint
SHAKES_S = 0.02  # how long a position loop may take to catch up with its path: that of one with a bandwidth of 20 Hz
SPIKE = 6.0  # standard deviations of the torque's own noise that a sample must lie beside its neighbours to be no noise
_BESIDE = 3  # samples on either side whose median is taken

Found = TypeVar("Found")


@dataclass(frozen=True, slots=True, eq=False)
class Cleaned:
    """A recording brought to one instant, freed of what is no friction of this joint."""

    recording: CycleRecording  # with the time skew that is used, and what remains open of it
    motion: Motion  # synchronised columns, torque of link or other joints taken off
    windows: IdentifiedPairs
    level_nm: float  # typical friction torque
    link: Link | None
    others: Pull | None
    time_skew: TimeSkew | None  # where it was measured
    seen: Delay | None  # what delay the cycles would ask for

    @property
    def taken(self) -> Link | Pull | None:
        """What was taken off the torque; a link and other joints never are at once."""
        return self.link or self.others


def cleaned(recording: CycleRecording, notes: list[str]) -> Cleaned:
    """The recording ready for an estimator, with notes for a person; ``IdentificationError`` for an empty window."""
    recording, shakes = without_shakes(recording)
    if shakes:
        notes.append(f"{shakes} missed set-points shook the joint; its torque was taken from beside them")
    motion = synchronised(recording)
    others = pull(recording, motion)
    if others is not None:
        motion = replace(motion, torque_nm=motion.torque_nm - others.torque_nm)
    elif recording.coupled:
        notes.append("how much the joints that moved along drove this one is not known; nothing was taken off")
    windows = intervals.aligned_pairs(recording, motion)
    level = float(np.mean(windows.torque_nm))
    link = _link(recording, motion, level, notes)
    time_skew = None
    if (shaken := recording.shaken) is not None:
        untold = "the torque's delay was not measured, the declared one is used"
        measured = or_noted(lambda: measured_skew(shaken, link), untold, notes)
        if measured is not None:
            time_skew = TimeSkew.of(recording.skew, measured)
            recording = replace(recording, skew=time_skew.corrected(recording.skew))
            motion = synchronised(recording)
    if link is not None:
        motion = replace(motion, torque_nm=motion.torque_nm - link.torque_nm)
    if link is not None or time_skew is not None:
        windows = intervals.aligned_pairs(recording, motion)
    seen = None
    if others is not None or not recording.coupled:  # what an unknown pull leaves looks like a delay
        untested = "the declared timing could not be tested"
        seen = or_noted(lambda: seen_delay(recording, motion, level), untested, notes)
    if seen is not None:
        open_s = seen.open_s(recording.skew.uncertainty_s)
        recording = replace(recording, skew=replace(recording.skew, uncertainty_s=open_s))
    return Cleaned(recording, motion, windows, level, link, others, time_skew, seen)


def _link(recording: CycleRecording, motion: Motion, level: float, notes: list[str]) -> Link | None:
    if recording.coupled:
        return None
    steps_s = np.diff(recording.time_s)
    step_s = float(np.median(steps_s))
    longest_s = max(float(steps_s.max()), step_s + float(recording.stopped_s.max(initial=0.0)))
    if longest_s > _GAP_STEPS * step_s:
        notes.append(
            f"whether the link swings is not known: {1e3 * longest_s:.1f} ms passed between two samples, and a "
            "joint that jumps after its missing set-points looks like a swinging link"
        )
        return None
    link = or_noted(lambda: soft_link(recording, motion, level), "whether the link swings is not known", notes)
    if link is not None:
        notes.append(
            f"a soft joint: the link swings at {link.resonance_hz.value:.1f} Hz; its torque was computed from the "
            "position and taken off"
        )
    return link


def or_noted(find: Callable[[], Found], otherwise: str, notes: list[str]) -> Found | None:
    """What is found; None where it cannot be formed, which the notes then tell with the reason."""
    try:
        return find()
    except IdentificationError as problem:
        notes.append(f"{otherwise}: {problem.what}")
        return None


def without_shakes(recording: CycleRecording) -> tuple[CycleRecording, int]:
    """The recording with the torque that missed set-points shook replaced, and after how many of them there was any.

    Where the joint turns round in that time nothing is touched: friction itself jumps there.
    """
    time_s, torque = recording.time_s, recording.torque_nm.copy()
    steps_s = np.diff(time_s)
    gaps_s = time_s[:-1][steps_s > 1.5 * float(np.median(steps_s))]
    # One-sigma of the torque's noise, from how far samples lie beside the mean of their neighbours.
    off = np.abs(torque[1:-1] - 0.5 * (torque[:-2] + torque[2:]))
    noise = float(1.4826 * np.median(off) / np.sqrt(1.5))
    shaken = 0
    for missed_s in np.union1d(gaps_s, recording.stops_s):
        first = int(np.searchsorted(time_s, missed_s, side="right"))
        last = int(np.searchsorted(time_s, missed_s + 2.0 * float(np.median(steps_s)) + SHAKES_S))
        begin, end = first - _BESIDE, last + _BESIDE
        if begin < 0 or end > time_s.size:
            continue
        ways = np.sign(np.diff(recording.position_rad[begin:end][::_BESIDE]))
        if np.any(ways != ways[0]):
            continue
        ends = np.median(torque[begin:first]), np.median(torque[last:end])
        line = np.interp(time_s[first:last], time_s[[first - 1, last]], ends)
        beside = np.abs(torque[first:last] - line) > SPIKE * noise
        if beside.any():
            torque[first:last] = line
            shaken += 1
    return (replace(recording, torque_nm=torque), shaken) if shaken else (recording, 0)
