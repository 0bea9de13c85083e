"""A recording brought to one instant and freed of what is no friction of its joint, before any curve is drawn.

Timing comes first, for everything else is read through it: declared, or measured where the joint shook for it. Then
what other joints took that moved along, or what the link of a soft joint took; then how well the timing fits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.errors import IdentificationError
from frictid_hil.friction import intervals
from frictid_hil.friction.coupling import Pull, pull
from frictid_hil.friction.delay import SeenDelay, seen_delay
from frictid_hil.friction.identify import IdentifiedPairs
from frictid_hil.friction.link import Link, soft_link, without
from frictid_hil.friction.missed import without_shakes
from frictid_hil.friction.recording import CycleRecording, Motion, synchronised
from frictid_hil.friction.skew import TimeSkew, measured_skew

_GAP_STEPS = 3.0
"""Between two samples, in sample periods: a longer one has jerked the joint."""


@dataclass(frozen=True, slots=True, eq=False)
class Cleaned:
    """A recording brought to one instant, freed of what is no friction of this joint.

    Attributes:
        recording: with the time skew that is used, and what remains open of it.
        motion: synchronised columns, torque of link or other joints taken off.
        windows: window averages of the same.
        level_nm: typical friction torque.
        link: of a soft joint.
        others: what joints that moved along took.
        time_skew: where it was measured.
        seen: what delay the cycles would ask for.
    """

    recording: CycleRecording
    motion: Motion
    windows: IdentifiedPairs
    level_nm: float
    link: Link | None
    others: Pull | None
    time_skew: TimeSkew | None
    seen: SeenDelay | None

    @property
    def taken(self) -> Link | Pull | None:
        """What was taken off the torque; a link and other joints never are at once."""
        return self.link or self.others


def cleaned(recording: CycleRecording, notes: list[str]) -> Cleaned:
    """The recording, ready for an estimator.

    Args:
        recording: as it was made.
        notes: gets what a person should know.

    Raises:
        IdentificationError: a window is empty, or columns do not fit together.
    """
    recording, shaken = without_shakes(recording)
    if shaken:
        notes.append(f"{shaken} missed set-points shook the joint; its torque was taken from beside them")
    motion = synchronised(recording)
    others = pull(recording, motion)
    if others is not None:
        motion = replace(motion, torque_nm=motion.torque_nm - others.torque_nm)
    elif recording.coupled:
        notes.append("how much the joints that moved along drove this one is not known; nothing was taken off")
    windows = intervals.aligned_pairs(recording, motion)
    level = float(np.mean(windows.torque_nm))
    link = _link(recording, motion, level, notes)
    time_skew = _time_skew(recording, link, notes)
    if time_skew is not None:
        recording = replace(recording, skew=time_skew.corrected(recording.skew))
        motion = synchronised(recording)
    if link is not None:
        motion = without(motion, link)
    if link is not None or time_skew is not None:
        windows = intervals.aligned_pairs(recording, motion)
    unknown_pull = recording.coupled and others is None  # what it leaves looks like a delay
    seen = None if unknown_pull else _seen_delay(recording, motion, level, notes)
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
    try:
        link = soft_link(recording, motion, level)
    except IdentificationError as problem:
        notes.append(f"whether the link swings is not known: {problem.what}")
        return None
    if link is not None:
        notes.append(
            f"a soft joint: the link swings at {link.resonance_hz.value:.1f} Hz; its torque was computed from the "
            "position and taken off"
        )
    return link


def _time_skew(recording: CycleRecording, link: Link | None, notes: list[str]) -> TimeSkew | None:
    if recording.shaken is None:
        return None
    try:
        return TimeSkew.of(recording.skew, measured_skew(recording.shaken, link))
    except IdentificationError as problem:
        notes.append(f"the torque's delay was not measured, the declared one is used: {problem.what}")
        return None


def _seen_delay(recording: CycleRecording, motion: Motion, level: float, notes: list[str]) -> SeenDelay | None:
    try:
        return seen_delay(recording, motion, level)
    except IdentificationError as problem:
        notes.append(f"the declared timing could not be tested: {problem.what}")
        return None
