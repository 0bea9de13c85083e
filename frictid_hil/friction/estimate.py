"""One interface to all estimators: a recording in, a curve with intervals, rigid body, ripple and diagnostics out.

================  =====================================================================================
``function-a``    the published algorithm on the drive's own velocity and torque, untouched
``aligned``       the same windows on zero-phase velocity and torque brought to the instants of the position
``least-squares`` one linear model of the whole recording
================  =====================================================================================

Where the recording shows a link swinging on a soft joint, the last two leave its torque out.

The published result always stands beside the chosen one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from frictid_hil.errors import IdentificationError, UsageError
from frictid_hil.friction import intervals, least_squares
from frictid_hil.friction.coupling import Pull, posture, pull, without_gravity
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.delay import SeenDelay, seen_delay
from frictid_hil.friction.identify import IdentifiedPairs, function_a
from frictid_hil.friction.least_squares import RippleTable
from frictid_hil.friction.link import Link, soft_link, without
from frictid_hil.friction.recording import CycleRecording, Motion, synchronised
from frictid_hil.friction.regression import Fit, fit
from frictid_hil.friction.rigid_body import COVERAGE, Measured, RigidBody, rigid_body
from frictid_hil.friction.trajectory import Array

METHODS = ("function-a", "aligned", "least-squares")
DEFAULT_METHOD = "aligned"


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What one recording says of one joint.

    Attributes:
        method: one of METHODS, or ``plateaus``.
        curve: phi of (8).
        half_width_nm: half of the 95 % interval at each knot of the curve, shape (K,).
        coulomb_nm: F_0 with its interval.
        asymmetry_nm: half the difference of forward and backward friction at each knot, its constant part left to
            the bias, shape (K,). phi + asymmetry forwards, phi - asymmetry backwards. Zero where other joints moved
            too: the velocity products of the arm look the same.
        pairs: window averages: of the drive's columns for ``function-a``, else of the synchronised ones.
        published: Function A as published; None where its windows are empty or there is no drive velocity.
        rigid_body: inertia, gravity, bias; None where they could not be separated, or are not of this joint alone.
        ripple: over one motor revolution; None where it is unknown or lost in its uncertainty.
        link_resonance_hz: of a soft joint; None where the joint looks rigid.
        drift: the repeated cycle against its first run; None without one.
        terms: what the intervals are made of.
        notes: what a person should know (unobserved speeds, what could not be formed and why).
        figures: further numbers by name, units in the names.
    """

    method: str
    curve: FrictionCurve
    half_width_nm: Array
    coulomb_nm: Measured
    asymmetry_nm: Array
    pairs: IdentifiedPairs
    published: IdentifiedPairs | None = None
    rigid_body: RigidBody | None = None
    ripple: RippleTable | None = None
    link_resonance_hz: Measured | None = None
    drift: intervals.Drift | None = None
    terms: intervals.Terms | None = None
    notes: tuple[str, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)

    def half_width_at(self, speed_rad_s: Array) -> Array:
        """Half of the 95 % interval of phi at any speed, same shape."""
        return intervals.curve_half_width_nm(self.curve, self.half_width_nm, speed_rad_s)


def estimate(recording: CycleRecording, method: str = DEFAULT_METHOD) -> Estimate:
    """Identify one joint.

    Args:
        recording: of the procedure; see ``CycleRecording``.
        method: one of METHODS.

    Raises:
        UsageError: no such method, or ``function-a`` without a drive velocity.
        IdentificationError: an empty window, F_0 <= 0, or (``least-squares``) a model that cannot be solved.
    """
    if method not in METHODS:
        raise UsageError(f"no estimator {method!r}; there are {', '.join(METHODS)}")
    if method == "function-a" and recording.velocity_rad_s is None:
        raise UsageError(
            "the published Function A needs the drive's own velocity",
            where=recording.where,
            next_step="use --method aligned, which takes the velocity from the position",
        )
    notes: list[str] = []
    motion = synchronised(recording)
    published = _published(recording, notes, required=method == "function-a")
    others = pull(recording, motion)
    if others is not None:
        motion = replace(motion, torque_nm=motion.torque_nm - others.torque_nm)
    elif recording.coupled:
        notes.append("how much the joints that moved along drove this one is not known; nothing was taken off")
    windows = intervals.aligned_pairs(recording, motion)
    level = float(np.mean(windows.torque_nm))
    link = _link(recording, motion, level, notes)
    if link is not None:
        motion = without(motion, link)
        windows = intervals.aligned_pairs(recording, motion)
    unknown_pull = recording.coupled and others is None  # what it leaves looks like a delay
    seen = None if unknown_pull else _seen_delay(recording, motion, level, notes)
    if seen is not None:
        open_s = seen.open_s(recording.skew.uncertainty_s)
        recording = replace(recording, skew=replace(recording.skew, uncertainty_s=open_s))
    drift = intervals.repeated(recording, motion, windows)
    solved: Fit | None = None
    taken: Link | Pull | None = link or others
    doubtful = None if taken is None else taken.columns
    try:
        knots = least_squares.curve_knots(recording)
        extra = posture(motion) if recording.coupled else None
        solved = fit(recording, motion, knots, level, extra=extra, doubtful=doubtful)
    except IdentificationError as problem:
        if method == "least-squares":
            raise
        notes.append(f"inertia, gravity and bias are not known: {problem.what}")
    if method == "least-squares" and solved is not None and solved.unobserved.size:
        slow = ", ".join(f"{speed:.3g}" for speed in solved.unobserved)
        notes.append(f"too few samples at {slow} rad/s: the curve is extended to there from faster ones")

    weighed = taken
    if recording.coupled and solved is not None and method != "least-squares":
        freed, weighed = without_gravity(motion, solved, others)
        windows = intervals.aligned_pairs(recording, freed)
    pairs = windows
    if method == "least-squares":
        assert solved is not None
        kept = least_squares.trusted(recording, solved, level)
        curve = least_squares.curve_of(solved, kept, recording.where)
        terms = intervals.least_squares_terms(recording, motion, solved, kept, drift, taken)
        half = terms.half_width_nm
    else:
        terms = intervals.window_terms(recording, motion, windows, solved, drift, weighed)
        half = terms.half_width_nm
        if method == "function-a":
            assert published is not None
            pairs = published
            off = published.torque_nm - windows.curve(where=recording.where).magnitude(published.velocity_rad_s)
            half = np.hypot(half, COVERAGE * off)
        curve = pairs.curve(where=recording.where)
        half = half[np.argsort(pairs.velocity_rad_s, kind="stable")]

    speeds = np.asarray(curve.velocity_rad_s)
    even = asymmetry(pairs, speeds) if solved is None else solved.even_nm(speeds)
    body = None if solved is None else rigid_body(recording, solved)
    if recording.coupled:
        even, body = np.zeros_like(even), None
        notes.append(
            "other joints moved with this one: inertia, gravity, asymmetry and a soft link cannot be told from theirs"
        )
    return Estimate(
        method=method,
        curve=curve,
        half_width_nm=half,
        coulomb_nm=Measured(curve.coulomb_nm, intervals.coulomb_half_width_nm(curve, half)),
        asymmetry_nm=even,
        pairs=pairs,
        published=published,
        rigid_body=body,
        ripple=_ripple(recording, motion, level, notes),
        link_resonance_hz=None if link is None else link.resonance_hz,
        drift=drift,
        terms=terms,
        notes=tuple(notes),
        figures=_figures(solved, seen),
    )


def asymmetry(pairs: IdentifiedPairs, speed_rad_s: Array) -> Array:
    """Half the difference of forward and backward friction, 0 at rest, from window averages alone, N m.

    The mean of F_n+ and F_n- is gravity at the middle of the travel, the bias, and the even part of the friction; all
    but the last do not depend on the speed, so a line through rest is what belongs to the friction.
    """
    middle = (pairs.torque_plus_nm + pairs.torque_minus_nm) / 2
    slope = np.polyfit(pairs.mean_speed_rad_s, middle, 1)[0]
    even: Array = slope * np.asarray(speed_rad_s, dtype=np.float64)
    return even


def _published(recording: CycleRecording, notes: list[str], *, required: bool) -> IdentifiedPairs | None:
    if recording.velocity_rad_s is None:
        notes.append("no drive velocity: the published Function A is not shown beside")
        return None
    try:
        return function_a(
            recording.time_s,
            recording.velocity_rad_s,
            recording.torque_nm,
            recording.procedure,
            where=recording.where,
        )
    except IdentificationError as problem:
        if required:
            raise
        notes.append(f"the published Function A fails: {problem.what}")
        return None


_GAP_STEPS = 3.0
"""Between two samples, in sample periods: a longer one has jerked the joint."""


def _link(recording: CycleRecording, motion: Motion, level: float, notes: list[str]) -> Link | None:
    if recording.coupled:
        return None
    steps_s = np.diff(recording.time_s)
    if steps_s.size and steps_s.max() > _GAP_STEPS * np.median(steps_s):
        notes.append(
            f"whether the link swings is not known: {1e3 * steps_s.max():.1f} ms passed between two samples, and a "
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


def _seen_delay(recording: CycleRecording, motion: Motion, level: float, notes: list[str]) -> SeenDelay | None:
    try:
        return seen_delay(recording, motion, level)
    except IdentificationError as problem:
        notes.append(f"the declared timing could not be tested: {problem.what}")
        return None


def _figures(solved: Fit | None, seen: SeenDelay | None) -> dict[str, float]:
    figures = {} if solved is None else {"residual_rms_nm": solved.residual_rms_nm}
    if seen is not None:
        figures.update(seen_delay_s=seen.delay_s, seen_delay_deviation_s=seen.deviation_s)
    return figures


def _ripple(recording: CycleRecording, motion: Motion, level: float, notes: list[str]) -> RippleTable | None:
    try:
        return least_squares.ripple_table(recording, motion, level)
    except IdentificationError as problem:
        notes.append(f"the torque ripple is not known: {problem.what}")
        return None
