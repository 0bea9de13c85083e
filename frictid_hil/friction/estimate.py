"""One interface to all estimators: a recording in, a curve with intervals, rigid body, ripple and diagnostics out.

``function-a`` is the published algorithm on the drive's own velocity and torque, untouched, and always stands beside
the chosen one; ``aligned`` has the same windows on zero-phase velocity and torque brought to the instants of the
position; ``least-squares`` is one linear model of the whole recording. Where a link swings, the last two leave its
torque out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from frictid_hil.errors import UsageError
from frictid_hil.friction import intervals, least_squares
from frictid_hil.friction.beside import Beside, beside
from frictid_hil.friction.cleaned import Cleaned, cleaned, or_noted
from frictid_hil.friction.coupling import posture, without_gravity
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.identify import IdentifiedPairs, function_a
from frictid_hil.friction.least_squares import RippleTable
from frictid_hil.friction.recording import CycleRecording
from frictid_hil.friction.regression import Fit, fit
from frictid_hil.friction.rigid_body import COVERAGE, Measured, RigidBody, rigid_body
from frictid_hil.friction.skew import Delay, TimeSkew
from frictid_hil.friction.trajectory import Array

METHODS = ("function-a", "aligned", "least-squares")
DEFAULT_METHOD = "aligned"


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What one recording says of one joint."""

    method: str  # one of METHODS, or ``plateaus``
    curve: FrictionCurve
    half_width_nm: Array  # half of the 95 % interval at each knot of the curve, shape (K,)
    coulomb_nm: Measured  # F_0 with its interval
    # Half the difference of forward and backward friction at each knot, its constant part left to the bias, shape (K,).
    # phi + asymmetry forwards, phi - asymmetry backwards. Zero where other joints moved too: the velocity products of
    # the arm look the same.
    asymmetry_nm: Array
    pairs: IdentifiedPairs  # window averages: of the drive's columns for ``function-a``, else of the synchronised ones
    # Function A as published; None where its windows are empty or there is no drive velocity.
    published: IdentifiedPairs | None = None
    # Inertia, gravity, bias; None where they could not be separated, or are not of this joint alone.
    rigid_body: RigidBody | None = None
    ripple: RippleTable | None = None  # over one motor revolution; None where it is unknown or lost in its uncertainty
    link_resonance_hz: Measured | None = None
    time_skew: TimeSkew | None = None  # declared, measured and used; None where the joint did not shake
    drift: intervals.Drift | None = None
    terms: intervals.Terms | None = None
    notes: tuple[str, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)  # further numbers by name, units in the names


def estimate(recording: CycleRecording, method: str = DEFAULT_METHOD) -> Estimate:
    """Identify one joint by one of METHODS.

    Raises:
        UsageError: no such method, or ``function-a`` without a drive velocity.
        IdentificationError: an empty window, F_0 <= 0, or (``least-squares``) a model that cannot be solved.
    """
    _refuse(recording, method)
    notes: list[str] = []
    published = _published(recording, notes, required=method == "function-a")
    clean = cleaned(recording, notes)
    solved = _solved(clean, notes, required=method == "least-squares")
    drift = intervals.repeated(clean.recording, clean.motion, clean.windows, solved)
    others = None
    if solved is not None:
        others = beside(clean.recording, clean.motion, solved, clean.level_nm, _postures(clean))
    if method == "least-squares":
        assert solved is not None
        found = _by_least_squares(clean, solved, drift, others, notes)
    elif method == "function-a":
        assert published is not None
        found = _as_published(_by_windows(clean, solved, drift, others), published, recording.where)
    else:
        found = _by_windows(clean, solved, drift, others)
    body = None if solved is None else rigid_body(clean.recording, solved)
    speeds = np.asarray(found.curve.velocity_rad_s)
    even = asymmetry(found.pairs, speeds) if solved is None else solved.even_nm(speeds)
    if recording.coupled:
        even, body = np.zeros_like(even), None
        notes.append(
            "other joints moved with this one: inertia, gravity, asymmetry and a soft link cannot be told from theirs"
        )
    return Estimate(
        method=method,
        curve=found.curve,
        half_width_nm=found.half_width_nm,
        coulomb_nm=Measured(found.curve.coulomb_nm, intervals.coulomb_half_width_nm(found.curve, found.half_width_nm)),
        asymmetry_nm=even,
        pairs=found.pairs,
        published=published,
        rigid_body=body,
        ripple=or_noted(
            lambda: least_squares.ripple_table(clean.recording, clean.motion, clean.level_nm),
            "the torque ripple is not known",
            notes,
        ),
        link_resonance_hz=None if clean.link is None else clean.link.resonance_hz,
        time_skew=clean.time_skew,
        drift=drift,
        terms=found.terms,
        notes=tuple(notes),
        figures=_figures(solved, clean.seen),
    )


def _refuse(recording: CycleRecording, method: str) -> None:
    if method not in METHODS:
        raise UsageError(f"no estimator {method!r}; there are {', '.join(METHODS)}")
    if method == "function-a" and recording.velocity_rad_s is None:
        raise UsageError(
            "the published Function A needs the drive's own velocity",
            where=recording.where,
            next_step="use --method aligned, which takes the velocity from the position",
        )


def _solved(clean: Cleaned, notes: list[str], *, required: bool) -> Fit | None:
    """The least-squares model of the whole recording; None where it cannot be solved."""

    def solved() -> Fit:
        return fit(
            clean.recording,
            clean.motion,
            least_squares.curve_knots(clean.recording),
            clean.level_nm,
            extra=_postures(clean),
            doubtful=None if clean.taken is None else clean.taken.columns,
        )

    return solved() if required else or_noted(solved, "inertia, gravity and bias are not known", notes)


def _postures(clean: Cleaned) -> Array | None:
    return posture(clean.motion) if clean.recording.coupled else None


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """The curve by one method, and how well its knots are known."""

    curve: FrictionCurve
    half_width_nm: Array
    pairs: IdentifiedPairs
    terms: intervals.Terms


def _by_least_squares(
    clean: Cleaned, solved: Fit, drift: intervals.Drift | None, others: Beside | None, notes: list[str]
) -> _Found:
    recording = clean.recording
    if solved.unobserved.size:
        slow = ", ".join(f"{speed:.3g}" for speed in solved.unobserved)
        notes.append(f"too few samples at {slow} rad/s: the curve is extended to there from faster ones")
    kept = least_squares.trusted(recording, solved, clean.level_nm)
    terms = intervals.least_squares_terms(recording, clean.motion, solved, kept, drift, others, clean.taken)
    curve = FrictionCurve.through(solved.knots[kept], solved.odd_nm[kept], where=recording.where)
    return _Found(curve, terms.half_width_nm, clean.windows, terms)


def _by_windows(clean: Cleaned, solved: Fit | None, drift: intervals.Drift | None, others: Beside | None) -> _Found:
    recording, pairs, weighed = clean.recording, clean.windows, clean.taken
    if recording.coupled and solved is not None:
        freed, weighed = without_gravity(clean.motion, solved, clean.others)
        pairs = intervals.aligned_pairs(recording, freed)
    terms = intervals.window_terms(recording, clean.motion, pairs, solved, drift, others, weighed)
    rising = np.argsort(pairs.velocity_rad_s, kind="stable")
    return _Found(pairs.curve(where=recording.where), terms.half_width_nm[rising], pairs, terms)


def _as_published(aligned: _Found, published: IdentifiedPairs, where: str) -> _Found:
    """Function A's own pairs; how far they lie from the aligned ones is one more term."""
    off = published.torque_nm - aligned.curve.magnitude(published.velocity_rad_s)
    half = np.hypot(aligned.terms.half_width_nm, COVERAGE * off)
    rising = np.argsort(published.velocity_rad_s, kind="stable")
    return _Found(published.curve(where=where), half[rising], published, aligned.terms)


def asymmetry(pairs: IdentifiedPairs, speed_rad_s: Array) -> Array:
    """Half the difference of forward and backward friction, 0 at rest, from window averages alone, N m.

    The mean of F_n+ and F_n- is gravity at the middle of the travel, the bias, and the even part of the friction; all
    but the last do not depend on the speed, so a line through rest is what belongs to the friction.
    """
    middle = (pairs.torque_plus_nm + pairs.torque_minus_nm) / 2
    slope = np.polyfit(pairs.mean_speed_rad_s, middle, 1)[0]
    return np.asarray(slope * np.asarray(speed_rad_s, dtype=np.float64))


def _published(recording: CycleRecording, notes: list[str], *, required: bool) -> IdentifiedPairs | None:
    time_s, velocity, torque = recording.time_s, recording.velocity_rad_s, recording.torque_nm
    if velocity is None:
        notes.append("no drive velocity: the published Function A is not shown beside")
        return None

    def published() -> IdentifiedPairs:
        return function_a(time_s, velocity, torque, recording.procedure, where=recording.where)

    return published() if required else or_noted(published, "the published Function A fails", notes)


def _figures(solved: Fit | None, seen: Delay | None) -> dict[str, float]:
    figures = {} if solved is None else {"residual_rms_nm": solved.residual_rms_nm}
    if seen is not None:
        figures.update(seen_delay_s=seen.delay_s, seen_delay_deviation_s=seen.deviation_s)
    return figures
