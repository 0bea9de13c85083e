"""The page of a calibration: what was done, per joint the curve, the loops it was averaged from, tracking and gates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.config.profile import FrictionProfile, JointProfile, ProcedureUsed
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.recording.samples import Samples
from frictid_hil.report.figures import IDENTIFIED, MEASURED, PUBLISHED, REFERENCE, Figure, band, cloud, line, points
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.report.words import estimate, sentence, when, with_interval
from frictid_hil.units import degrees


def calibration_page(
    profile: FrictionProfile,
    samples: Mapping[str, Samples],  # of each joint's own motion, where at hand
    *,
    outcome: str,  # word of the run's JSON
    error: str = "",  # why it ended early, in a sentence
    previous: FrictionProfile | None = None,  # the profile that was active before, to compare with
) -> Page:
    """The page of one run."""
    joints = profile.joints
    good = sum(all(gate.passed for gate in joint.gates) for joint in joints.values())
    which = "" if not profile.provenance.driver else "SIMULATED: " if profile.provenance.seed is not None else "REAL: "
    headline = f"{which}{good} of {len(joints)} joints of {profile.robot} identified and passed every quality gate."
    if outcome != "ok":
        headline += f" The run ended as {outcome.replace('_', ' ')}{': ' + error if error else ''}."
    compared = "There is no earlier profile to compare with."
    if previous is not None:
        compared = f"Compared with the profile that was active then, of {when(previous.provenance.created_utc)}."
    done = (*_what_was_done(profile, samples), compared)
    overview = (_overview(joints, previous),) if len(joints) > 1 else ()
    sections = [Section("Summary", words=done, tables=(_summary(joints, previous),), figures=overview)]
    sections += [_joint(name, joint, samples.get(name), previous) for name, joint in joints.items()]
    pairs = tuple(_pairs(name, joint, len(joints)) for name, joint in joints.items())
    sections.append(Section("The pairs in numbers", tables=pairs))
    return Page(f"Friction of {profile.robot}", headline, sections, _facts(profile))


def _what_was_done(profile: FrictionProfile, samples: Mapping[str, Samples]) -> tuple[str, ...]:
    """A sentence for all joints that were moved alike."""
    told = profile.provenance
    alike: dict[str, list[str]] = {}
    for name, joint in profile.joints.items():
        alike.setdefault(_moved(joint.procedure, samples.get(name), prismatic=joint.prismatic), []).append(name)
    by = f", by the driver `{told.driver}` on `{told.bus}`" if told.driver else ""
    at = f"On {when(told.created_utc)}" if told.created_utc else "At an unknown time"
    return tuple(f"{at}, {_joints_were(names)} {how}{by}." for how, names in alike.items())


def _joints_were(names: Sequence[str]) -> str:
    return f"joints {', '.join(names)} were" if len(names) > 1 else f"joint {names[0]} was"


def _moved(procedure: ProcedureUsed | None, samples: Samples | None, *, prismatic: bool) -> str:
    if procedure is None:
        return "identified from a recording that followed no procedure"
    travel = f"{procedure.amplitude_rad * 1e3:.4g} mm" if prismatic else f"{degrees(procedure.amplitude_rad):.4g} deg"
    peak = f"{procedure.velocity_rad_s:.4g} m/s" if prismatic else f"{degrees(procedure.velocity_rad_s):.4g} deg/s"
    rate = "" if samples is None else f", sampled at {1.0 / samples.step_s:.4g} Hz"
    company = "in phase, all at once" if procedure.together else "one at a time with the others locked"
    return (
        f"moved {company}, through {procedure.cycles} sinusoidal cycles of {travel} peak to peak with speeds that rise "
        f"to {peak}{rate}"
    )


def _summary(joints: Mapping[str, JointProfile], previous: FrictionProfile | None) -> Table:
    rows = []
    for name, joint in joints.items():
        failed = [gate.name.replace("_", " ") for gate in joint.gates if not gate.passed]
        cells = (
            name,
            f"failed: {', '.join(failed)}" if failed else "passed",
            estimate(joint.coulomb_nm, "N" if joint.prismatic else "N m"),
            _highest(joint),
            estimate(joint.inertia_kg_m2, "kg" if joint.prismatic else "kg m\u00b2"),
            estimate(joint.presliding_stiffness_nm_per_rad, "N/m" if joint.prismatic else "N m/rad"),
        )
        rows.append(cells if previous is None else (*cells, _change(name, joint, previous)))
    headings = ("joint", "gates", "F_0", "at the highest speed", "inertia", "presliding stiffness")
    return Table(
        headings if previous is None else (*headings, "curve changed by"),
        tuple(rows),
        caption="With 95 % intervals. F_0 is the Coulomb level that the curve is extrapolated to, not the torque at "
        "which the joint breaks away.",
    )


def _joint(name: str, joint: JointProfile, samples: Samples | None, previous: FrictionProfile | None) -> Section:
    figures = [_curve_figure(name, joint, previous)]
    part = _cycles(samples)
    if part is not None and part.velocity_rad_s is not None and part.torque_nm is not None:
        figures.append(_loops_figure(name, joint, part, part.velocity_rad_s, part.torque_nm))
    if part is not None and part.position_command_rad is not None:
        figures.append(_tracking_figure(name, part, part.position_command_rad))
    notes = tuple(sentence(str(note)) for note in joint.quality.get("notes", ()))
    return Section(
        f"Joint {name}",
        words=notes,
        checks=tuple((gate.passed, sentence(gate.message)) for gate in joint.gates),
        figures=tuple(figures),
    )


def _cycles(samples: Samples | None) -> Samples | None:
    """The samples of the cycles; all of them where nothing in the recording is marked."""
    if samples is None or not samples.marks:
        return samples
    marks = samples.marked("cycles")
    return samples.during(marks[0]) if marks else None


def axes_of(joint: JointProfile) -> tuple[str, str, float]:
    """Units of speed and friction, and what turns a speed into the first."""
    return ("m/s", "N", 1.0) if joint.prismatic else ("deg/s", "N m", degrees(1.0))


def _overview(joints: Mapping[str, JointProfile], previous: FrictionProfile | None) -> Figure:
    """Every joint's curve with its interval, one small panel each, and whether its gates passed."""
    traces = [
        {**trace, "panel": number}
        for number, (name, joint) in enumerate(joints.items())
        for trace in _curves(name, joint, previous)
    ]
    caption = (
        "Solid where measured, dotted where extrapolated; the band is the 95 % interval, the dashed line the profile "
        "that was active before. A tick says that all gates passed."
    )
    panels = tuple(f"{_light(joint)} joint {name}" for name, joint in joints.items())
    return replace(over_speed("All joints", next(iter(joints.values())), traces, caption), panels=panels)


def _light(joint: JointProfile) -> str:
    color, sign = ("#2c8a4b", "\u2713") if all(gate.passed for gate in joint.gates) else ("#c0392b", "\u2717")
    return f'<span style="color:{color}">{sign}</span>'


def _curves(name: str, joint: JointProfile, previous: FrictionProfile | None) -> list[Mapping[str, Any]]:
    """The interval, the curve that was active before, and the curve: solid where measured, dotted elsewhere."""
    scale, curve, known = axes_of(joint)[2], joint.curve(), np.array(joint.velocity_rad_s)
    low, high = curve.measured_range_rad_s
    measured = np.linspace(low, high, 150)
    traces: list[Mapping[str, Any]] = []
    if joint.torque_interval_nm is not None:
        width, level = np.interp(measured, known, _half_width(joint)), curve.magnitude(measured)
        traces.append(band("95 % interval", measured * scale, level - width, level + width))
    if previous is not None and name in previous.joints:
        speeds = np.linspace(0.0, _top(joint), 200)[1:]
        before = previous.joints[name].curve().magnitude(speeds)
        traces.append(line("active before", speeds * scale, before, REFERENCE, dash="dash"))
    for begin, end in ((0.0, low), (high, _top(joint))):
        if end > begin:
            beyond = np.linspace(begin, end, 21)[(1 if begin == 0.0 else 0) :]
            extended = line("extrapolated", beyond * scale, curve.magnitude(beyond), IDENTIFIED, dash="dot")
            traces.append({**extended, "showlegend": begin == 0.0})
    traces.append(line("identified curve", measured * scale, curve.magnitude(measured), IDENTIFIED))
    return traces


def over_speed(title: str, joint: JointProfile, traces: Sequence[Mapping[str, Any]], caption: str) -> Figure:
    """Friction over speed, in the units of a joint."""
    unit, force, _ = axes_of(joint)
    return Figure(f"{title}: friction over speed", tuple(traces), f"speed [{unit}]", f"friction [{force}]", caption)


def pairs_of(joint: JointProfile) -> dict[str, Any]:
    """The pairs of a joint, with their intervals where known."""
    x, y = np.array(joint.velocity_rad_s) * axes_of(joint)[2], np.array(joint.torque_nm)
    half = None if joint.torque_interval_nm is None else _half_width(joint)
    return points("pairs V_n, F_n", x, y, IDENTIFIED, half_width=half)


def _half_width(joint: JointProfile) -> Array:
    return np.array([(high - low) / 2 for low, high in joint.torque_interval_nm or ()])


def _curve_figure(name: str, joint: JointProfile, previous: FrictionProfile | None) -> Figure:
    """The curve alone, close enough to see its intervals."""
    unit, _, scale = axes_of(joint)
    traces = _curves(name, joint, previous) + _one_way(joint, scale)
    if joint.published is not None:
        velocity, torque = np.array(joint.published.velocity_rad_s), np.array(joint.published.torque_nm)
        traces.append(points("as published (Function A)", velocity * scale, torque, PUBLISHED, symbol="x-thin-open"))
    traces.append(pairs_of(joint))
    low, high = joint.curve().measured_range_rad_s
    caption = (
        f"Measured from {low * scale:.3g} to {high * scale:.3g} {unit}, extrapolated where dotted. The curve is the "
        "mean of both directions."
    )
    return over_speed(f"Joint {name}", joint, traces, caption)


def _one_way(joint: JointProfile, scale: float) -> list[Mapping[str, Any]]:
    """Friction of either direction, where the estimator gives how far they lie apart."""
    apart = joint.quality.get("asymmetry_nm")
    if not isinstance(apart, list | tuple) or len(apart) != len(joint.torque_nm):
        return []
    velocity, level, half = np.array(joint.velocity_rad_s) * scale, np.array(joint.torque_nm), np.array(apart)
    return [
        points("forward", velocity, level + half, MEASURED, symbol="triangle-right-open"),
        points("backward", velocity, level - half, MEASURED, symbol="triangle-left-open"),
    ]


def _top(joint: JointProfile) -> float:
    return max(joint.procedure.velocity_rad_s if joint.procedure else 0.0, joint.velocity_rad_s[-1])


def _loops_figure(name: str, joint: JointProfile, part: Samples, velocity: Array, torque: Array) -> Figure:
    """Torque over velocity as measured, with what lies in the windows of (7) told apart, and the curve through it."""
    unit, force, scale = axes_of(joint)
    middle = float(np.mean([np.quantile(torque, q) for q in (0.05, 0.95)]))
    inside = _in_windows(joint.procedure, part.time_s - part.time_s[0], velocity)
    traces = [cloud("measured", velocity[~inside] * scale, torque[~inside] - middle, MEASURED)]
    caption = "Torque as measured with its constant part removed; what opens the loops is inertia" + (
        ", which cancels." if joint.procedure else " and gravity, which are fitted along."
    )
    if inside.any():
        traces.append(
            cloud("inside the windows", velocity[inside] * scale, torque[inside] - middle, PUBLISHED, opacity=0.8)
        )
        assert joint.procedure is not None  # or nothing were inside
        caption += (
            f" Each pair is averaged from the samples faster than {joint.procedure.ratio:g} of its cycle's peak speed,"
            " forward and backward: the windows."
        )
    speeds = np.linspace(0.0, _top(joint), 200)[1:]
    signed = np.concatenate([-speeds[::-1], speeds])
    traces.append(line("identified curve", signed * scale, joint.curve().torque(signed), IDENTIFIED))
    title = f"Joint {name}: torque over velocity"
    return Figure(title, tuple(traces), f"velocity [{unit}]", f"torque [{force}]", caption=caption)


def _in_windows(used: ProcedureUsed | None, time_s: Array, velocity: Array) -> NDArray[np.bool_]:
    """Which samples (7) averages: as fast as c times the peak speed of their cycle, shape (n,)."""
    if used is None:
        return np.zeros(velocity.shape, dtype=bool)
    procedure = Procedure(used.amplitude_rad, used.velocity_rad_s, used.cycles, used.ratio, used.shares or ())
    cycle = procedure.cycle_of(time_s)
    known = (cycle >= 0) & (cycle < procedure.cycles)
    peak = procedure.peak_velocities_rad_s[np.clip(cycle, 0, procedure.cycles - 1)]
    return np.asarray(known & (np.abs(velocity) >= procedure.ratio * peak))


def _tracking_figure(name: str, part: Samples, command: Array) -> Figure:
    error = (command - part.position_rad) * (1e3 if part.prismatic else degrees(1.0))
    return Figure(
        f"Joint {name}: tracking",
        (line("command - position", part.time_s - part.time_s[0], error, IDENTIFIED, width=1),),
        "time [s]",
        f"command - position [{'mm' if part.prismatic else 'deg'}]",
        caption="The joint need not follow closely, only reach the speeds: friction is identified from measured "
        "velocity and torque.",
    )


def _pairs(name: str, joint: JointProfile, of: int) -> Table:
    unit, force, scale = axes_of(joint)
    intervals: Sequence[tuple[float, float] | None] = joint.torque_interval_nm or [None] * len(joint.torque_nm)
    rows = tuple(
        (
            f"{velocity * scale:.4g}",
            f"{torque:.4g}",
            f"{interval[0]:.4g} .. {interval[1]:.4g}" if interval else "",
        )
        for velocity, torque, interval in zip(joint.velocity_rad_s, joint.torque_nm, intervals, strict=True)
    )
    caption = f"Joint {name}, estimator {joint.method}" if of > 1 else f"Estimator: {joint.method}"
    return Table((f"V_n [{unit}]", f"F_n [{force}]", f"95 % interval [{force}]"), rows, caption=caption)


def _change(name: str, joint: JointProfile, previous: FrictionProfile) -> str:
    if name not in previous.joints:
        return "not in it"
    before = previous.joints[name].curve()
    return f"{curve_distance(joint.curve(), before, joint.velocity_rad_s[-1]).e_percent:.1f} %"


def _highest(joint: JointProfile) -> str:
    unit, intervals = "N" if joint.prismatic else "N m", joint.torque_interval_nm
    low, high = intervals[-1] if intervals else (None, None)
    top = joint.velocity_rad_s[-1]
    speed = f"{top:.3g} m/s" if joint.prismatic else f"{degrees(top):.4g} deg/s"
    return f"{with_interval(joint.torque_nm[-1], low, high, unit)} at {speed}"


def _facts(profile: FrictionProfile) -> dict[str, str]:
    told = profile.provenance
    facts = {
        "made": when(told.created_utc),
        "frictid-hil": f"{told.tool_version} {told.git_revision}".strip(),
        "robot file": f"{told.robot_file} (sha256 {told.config_sha256[:12]})" if told.robot_file else "",
        "driver and bus": f"{told.driver} on {told.bus}" if told.driver else "",
        "clock": "wall clock" if told.realtime else "lock-step (simulated time)",
        "seed": "" if told.seed is None else str(told.seed),
        "run": told.run,
        "recordings": ", ".join(f"{name} {digest[:12]}" for name, digest in told.log_sha256.items()),
    }
    for name, joint in profile.joints.items():
        drive = joint.drive
        if drive.product or drive.serial:
            facts[f"drive of joint {name}"] = f"{drive.product}, serial {drive.serial}, firmware {drive.firmware}"
    return {name: value for name, value in facts.items() if value}
