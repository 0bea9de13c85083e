"""From one joint's samples to its entry in a profile: estimator, rigid body, presliding, quality gates.

Live runs and recordings come through here alike, so that the same samples give the same profile to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Literal

import numpy as np

from frictid_hil.config.profile import (
    LOOP_STIFFNESS,
    DriveIdentity,
    JointProfile,
    JudgedGate,
    PairList,
    ProcedureUsed,
    Ripple,
    TimeSkew,
)
from frictid_hil.config.profile import Estimate as Figure
from frictid_hil.errors import IdentificationError, UsageError
from frictid_hil.friction import quality
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.estimate import Estimate as Estimated
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.free_motion import free_motion
from frictid_hil.friction.gate import Gate, GateLimits, beside_usual
from frictid_hil.friction.onset import cycles_start_s
from frictid_hil.friction.plateaus import plateaus
from frictid_hil.friction.presliding import least_stiffness, loop_stiffness, presliding
from frictid_hil.friction.recording import CycleRecording
from frictid_hil.friction.rigid_body import Measured, RigidBody
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.jobs.identification.cycles import cycle_recording, declared_skew, told_of
from frictid_hil.jobs.identification.skew_stretch import wanted_note
from frictid_hil.plan.linear_axis import linear_names
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import POSITION_GAIN
from frictid_hil.recording.samples import Mark, Samples

_BODY = ("inertia_kg_m2", "gravity_cos_nm", "gravity_sin_nm", "bias_nm")
_PROCEDURE_KEYS = ("amplitude_rad", "velocity_rad_s", "cycles", "ratio")


def identify_joint(
    samples: Samples,  # of the whole run of the joint, with marks; or of a foreign recording, without
    joint: JointSetup | None,  # limits and gear, where a robot file tells
    *,
    method: str,  # estimator
    procedure: Procedure | None = None,  # of a recording without marks; else plateaus are looked for, then any motion
    late_cycles: int = 0,  # that came late or were missed
    company: Sequence[Samples] = (),  # of joints that moved together, whole runs too; it may be among them
) -> JointProfile:
    """Identify one joint (``IdentificationError``: no curve can be formed; the reason names cycle or speed)."""
    if samples.torque_nm is None:
        raise IdentificationError("the recording has no torque", where=f"joint {samples.joint}")
    if samples.marks:
        samples = samples.during(Mark("whole run", samples.marks[0].start_ns, samples.marks[-1].end_ns))
    marks = samples.marked("cycles")
    if marks:
        used = procedure_of(marks[0])
        if procedure is not None and procedure != used:
            raise UsageError(
                "the recording was made with another procedure than the one asked for; leave the options out",
                where=f"joint {samples.joint}",
            )
        together = tuple(map(str, marks[0].details.get("together", ())))
        known = {other.joint: other for other in company if other.joint != samples.joint}
        others = [known[name] for name in together if name in known]
        found = cycle_recording(samples, used, marks[0].start_ns * 1e-9, joint, late_cycles, together, others)
        return _from_cycles(*found, joint, method, together)
    if procedure is not None:
        path = samples.position_rad if samples.position_command_rad is None else samples.position_command_rad
        start_s = cycles_start_s(samples.time_s, path, procedure, where=f"joint {samples.joint}")
        return _from_cycles(*cycle_recording(samples, procedure, start_s, joint, late_cycles), joint, method)
    if method == "least-squares":
        return _from_free_motion(samples, [])
    if samples.marks:
        raise IdentificationError(
            "the run holds no cycles of the procedure",
            where=f"joint {samples.joint}",
            cause=f"it ended before them: it holds {', '.join(dict.fromkeys(mark.name for mark in samples.marks))}",
            next_step="continue it by `calibrate --resume RUN`; `--method least-squares` identifies any motion",
        )
    try:
        return _from_plateaus(samples)
    except IdentificationError as error:
        return _from_free_motion(samples, [f"{error.what}: least squares over the whole motion instead"])


def procedure_of(mark: Mark) -> Procedure:
    """V, A, N, c and the shares of V that a recording carries."""
    amplitude, velocity, cycles, ratio = (mark.details[key] for key in _PROCEDURE_KEYS)
    shares = tuple(map(float, mark.details.get("shares", ())))
    return Procedure(float(amplitude), float(velocity), int(cycles), float(ratio), shares)


def joint_result(profile: JointProfile) -> dict[str, Any]:
    """A joint's entry in the JSON of ``calibrate`` and ``identify``, by the names of its kind of axis."""
    failed = [gate for gate in profile.gates if not gate.passed]
    result = {
        "outcome": "gate_failed" if failed else "ok",
        "method": profile.method,
        "velocity_rad_s": list(profile.velocity_rad_s),
        "torque_nm": list(profile.torque_nm),
        "torque_interval_nm": [list(pair) for pair in profile.torque_interval_nm or ()],
        "coulomb_nm": profile.coulomb_nm.value,
        "inertia_kg_m2": profile.inertia_kg_m2.value,
        "time_skew_s": profile.time_skew_s,
        "time_skew": None if profile.time_skew is None else profile.time_skew.model_dump(),
        "presliding_stiffness_nm_per_rad": profile.presliding_stiffness_nm_per_rad.value,
        "prismatic": profile.prismatic,
        "remarks": [gate.message for gate in failed],
        "notes": list(profile.quality.get("notes", ())),
    }
    return linear_names(result) if profile.prismatic else result


def failed_result(why: str) -> dict[str, Any]:
    """The entry of a joint without a curve."""
    return {"outcome": "gate_failed", "remarks": [why], "velocity_rad_s": [], "torque_nm": []}


def _from_cycles(
    samples: Samples,
    recording: CycleRecording,
    notes: list[str],
    joint: JointSetup | None,
    method: str,
    together: tuple[str, ...] = (),
) -> JointProfile:
    result = estimate(recording, method)
    limits = {} if joint is None else joint.gates
    if limits:
        notes.append(f"limits of quality gates of this robot: {beside_usual(limits, GateLimits())}")
    gates = quality.gates(recording, result, GateLimits(**limits))
    if recording.shaken is None and not recording.coupled and result.terms is not None:
        notes += filter(None, [wanted_note(result.terms, float(np.mean(result.curve.torque_nm)))])
    body, curve, skew, published = result.rigid_body, result.curve, recording.skew, result.published
    stiffness, level, yields = _presliding(samples, recording, body, curve.coulomb_nm)
    if yields == "unseen":
        notes.append(f"the encoder hides presliding; its stiffness is {stiffness.value:.3g} N m/rad at least")
    loop = _loop_stiffness(samples, recording)
    if loop is not None:
        notes.append(f"its own position loop is a spring of {loop:.3g} N m/rad at this gain")
    apart = "all joints moved together" if recording.coupled else "inertia and gravity could not be separated"
    warmth = samples.temperature_c
    rigid: dict[str, Any] = {name: _figure(getattr(body, name) if body else None, apart) for name in _BODY}
    return _entry(
        samples,
        result.method,
        curve,
        result.half_width_nm,
        result.coulomb_nm,
        presliding_stiffness_nm_per_rad=stiffness,
        presliding_level_nm=level,
        presliding_yields=yields,
        **rigid,
        forward=_pair_list(result.pairs.velocity_rad_s, result.pairs.torque_plus_nm),
        backward=_pair_list(-result.pairs.velocity_minus_rad_s, result.pairs.torque_minus_nm),
        published=_pair_list(published.velocity_rad_s, published.torque_nm) if published else None,
        ripple=Ripple.of_table(result.ripple.period_rad, result.ripple.torque_nm) if result.ripple else None,
        time_skew_s=result.time_skew.used_s if result.time_skew else skew.torque_delay_s - skew.position_delay_s,
        time_skew=None if result.time_skew is None else TimeSkew(**asdict(result.time_skew)),
        temperature_c=None if warmth is None else round(float(np.nanmean(warmth)), 2),
        procedure=ProcedureUsed(
            **{key: getattr(recording.procedure, key) for key in _PROCEDURE_KEYS},
            shares=recording.procedure.shares or None,
            together=together or None,
        ),
        drive=_drive(samples.meta),
        quality={**_quality(recording, result, notes), LOOP_STIFFNESS: loop},
        gates=_judged(gates),
    )


def _judged(gates: Sequence[Gate]) -> tuple[JudgedGate, ...]:
    return tuple(JudgedGate(name=gate.name, passed=gate.passed, message=gate.reason) for gate in gates)


def _quality(recording: CycleRecording, result: Estimated, notes: Sequence[str]) -> dict[str, Any]:
    return {
        **{name: float(value) for name, value in result.figures.items()},
        "asymmetry_nm": [float(value) for value in result.asymmetry_nm],
        "drift_percent": 100 * result.drift.change if result.drift else None,
        "link_resonance_hz": result.link_resonance_hz.value if result.link_resonance_hz else None,
        "coupling_kg_m2": {other.name: other.inertia_kg_m2 for other in recording.companions} or None,
        "notes": [*notes, *result.notes],
    }


def _from_plateaus(samples: Samples) -> JointProfile:
    assert samples.torque_nm is not None  # by the caller
    skew = declared_skew(samples)
    found = plateaus(
        samples.time_s,
        samples.position_rad,
        samples.torque_nm,
        command_rad=samples.position_command_rad,
        torque_delay_s=skew.torque_delay_s - skew.position_delay_s,
        where=f"joint {samples.joint}",
    )
    pairs, half = found.pairs, found.half_width_nm
    notes = [*told_of(samples), "no sine cycles: windows are stretches of constant speed, both ways"]
    known = bool(np.all(np.isfinite(half)))
    if not known:
        notes.append("no interval could be formed: every speed was held at one place only, and once")
    return _entry(
        samples,
        "plateaus",
        found.curve,
        half if known else None,
        found.coulomb_nm,
        forward=_pair_list(pairs.velocity_rad_s, pairs.torque_plus_nm),
        backward=_pair_list(-pairs.velocity_minus_rad_s, pairs.torque_minus_nm),
        time_skew_s=skew.torque_delay_s - skew.position_delay_s,
        quality={"notes": notes},
    )


def _from_free_motion(samples: Samples, notes: list[str]) -> JointProfile:
    assert samples.torque_nm is not None  # by the caller
    skew = declared_skew(samples)
    torque = samples.torque_nm
    if samples.rigid_body_torque_nm is not None:
        torque = torque - samples.rigid_body_torque_nm
        notes = [*notes, "inertia and gravity are what the rigid-body column leaves"]
    delay_s = skew.torque_delay_s - skew.position_delay_s
    found = free_motion(
        samples.time_s,
        samples.position_rad,
        torque,
        torque_delay_s=delay_s,
        prismatic=samples.prismatic,
        where=f"joint {samples.joint}",
    )
    body: dict[str, Any] = {
        name: _figure(getattr(found, name), found.untold.get(name, "a linear axis")) for name in _BODY
    }
    return _entry(
        samples,
        "least-squares",
        found.curve,
        found.half_width_nm,
        found.coulomb_nm,
        time_skew_s=delay_s,
        quality={
            "residual_rms_nm": found.residual_rms_nm,
            "torque_rms_nm": found.torque_rms_nm,
            "notes": [*told_of(samples), *notes],
        },
        gates=_judged(found.gates),
        **body,
    )


def _entry(
    samples: Samples, method: str, curve: FrictionCurve, half_nm: Array | None, coulomb: Measured, **more: Any
) -> JointProfile:
    """What every way of identifying finds, and more."""
    interval = None
    if half_nm is not None:
        interval = tuple((f - h, f + h) for f, h in zip(curve.torque_nm, half_nm.tolist(), strict=True))
    return JointProfile(
        method=method,
        prismatic=samples.prismatic,
        velocity_rad_s=curve.velocity_rad_s,
        torque_nm=curve.torque_nm,
        torque_interval_nm=interval,
        coulomb_nm=_figure(coulomb),
        torque_source=str(samples.meta.get("torque_source", "")),
        **more,
    )


def _drive(meta: Mapping[str, Any]) -> DriveIdentity:
    return DriveIdentity(
        **{key: str(meta.get(key) or "") for key in ("serial", "firmware", "product")},
        rated_torque_nm=meta.get("rated_torque_nm"),
        gear_ratio=meta.get("gear_ratio"),
        settings=dict(meta.get("settings") or {}),
    )


_Presliding = tuple[Figure, Figure, Literal["at once", "gradually", "unseen"]]  # stiffness, level, and how it yields


def _presliding(samples: Samples, recording: CycleRecording, body: RigidBody | None, coulomb_nm: float) -> _Presliding:
    """From the slow reversal; where an encoder hides it there, the least that the cycles allow."""
    reversals = samples.marked("reversal")
    if not reversals:
        nothing = Figure.none("the recording has no slow reversal")
        return nothing, nothing, "at once"
    part = samples.during(reversals[0])
    assert part.torque_nm is not None  # by the caller
    try:
        found = presliding(part.time_s, part.position_rad, part.torque_nm, where=recording.where)
    except IdentificationError as problem:
        least = None if body is None else least_stiffness(recording, body, coulomb_nm)
        if least is None:
            nothing = Figure.none(problem.what)
            return nothing, nothing, "at once"
        reason = f"at least, by the turning points of the cycles: {problem.what}"
        return Figure(value=least, reason=reason), Figure(value=coulomb_nm, reason="taken as F_0"), "unseen"
    return _figure(found.stiffness_nm_per_rad), _figure(found.level_nm), "gradually" if found.gradual else "at once"


def _loop_stiffness(samples: Samples, recording: CycleRecording) -> float | None:
    """Of a drive whose position loop is proportional alone, as it says itself."""
    if POSITION_GAIN not in (samples.meta.get("settings") or {}) or recording.command_rad is None:
        return None
    return loop_stiffness(recording.time_s, recording.command_rad, recording.position_rad, recording.torque_nm)


def _figure(measured: Measured | None, reason: str = "") -> Figure:
    if measured is None:
        return Figure.none(reason)
    if not math.isfinite(measured.half_width):
        return Figure(value=measured.value, reason="no interval could be formed")
    return Figure(value=measured.value, low=measured.low, high=measured.high)


def _pair_list(velocity: Any, torque: Any) -> PairList:
    return PairList(velocity_rad_s=tuple(map(float, velocity)), torque_nm=tuple(map(float, torque)))
