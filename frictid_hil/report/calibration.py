"""The page of a calibration: per joint the loops with the identified curve, tracking, gates; where it comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.recording.samples import Samples
from frictid_hil.report.figures import (
    IDENTIFIED,
    MEASURED,
    PUBLISHED,
    REFERENCE,
    Figure,
    band,
    cloud,
    line,
    points,
)
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.units import degrees


def calibration_page(
    profile: FrictionProfile,
    samples: Mapping[str, Samples],
    *,
    outcome: str,
    error: str = "",
    previous: FrictionProfile | None = None,
) -> Page:
    """The page of one run.

    Args:
        profile: what was identified.
        samples: of each joint's own motion, where the recording is at hand.
        outcome: word of the run's JSON.
        error: why it ended early, in a sentence.
        previous: the profile that was active before, to compare with.
    """
    joints = profile.joints
    good = sum(all(gate.passed for gate in joint.gates) for joint in joints.values())
    headline = f"{good} of {len(joints)} joints of {profile.robot} identified and passed every quality gate."
    if outcome != "ok":
        headline += f" The run ended as {outcome}{': ' + error if error else ''}."
    sections = [Section("Summary", tables=(_summary(joints, previous),))]
    sections += [_joint(name, joint, samples.get(name), previous) for name, joint in joints.items()]
    return Page(f"Friction of {profile.robot}", headline, sections, _facts(profile))


def _summary(joints: Mapping[str, JointProfile], previous: FrictionProfile | None) -> Table:
    rows = []
    for name, joint in joints.items():
        failed = [gate.name for gate in joint.gates if not gate.passed]
        rows.append(
            (
                name,
                f"failed: {', '.join(failed)}" if failed else "passed",
                _figure_text(joint.coulomb_nm, "N" if joint.prismatic else "N m"),
                _highest(joint),
                _figure_text(joint.inertia_kg_m2, "kg" if joint.prismatic else "kg m2"),
                _figure_text(joint.presliding_stiffness_nm_per_rad, "N/m" if joint.prismatic else "N m/rad"),
                _change(name, joint, previous),
            )
        )
    return Table(
        ("joint", "gates", "F_0", "highest measured", "inertia", "presliding", "change"),
        tuple(rows),
        caption="Figures with their 95 % interval. F_0 is an extrapolated Coulomb level, not the break-away torque.",
    )


def _joint(name: str, joint: JointProfile, samples: Samples | None, previous: FrictionProfile | None) -> Section:
    figures = [_curve_figure(name, joint, samples, previous)]
    if samples is not None and samples.position_command_rad is not None and samples.marked("cycles"):
        figures.append(_tracking_figure(name, samples))
    notes = tuple(str(note) for note in joint.quality.get("notes", ()))
    return Section(
        f"Joint {name}",
        words=notes,
        checks=tuple((gate.passed, gate.message) for gate in joint.gates),
        tables=(_pairs(joint),),
        figures=tuple(figures),
    )


def _curve_figure(name: str, joint: JointProfile, samples: Samples | None, previous: FrictionProfile | None) -> Figure:
    unit, force, scale = ("m/s", "N", 1.0) if joint.prismatic else ("deg/s", "N m", degrees(1.0))
    curve = joint.curve()
    top = joint.procedure.velocity_rad_s if joint.procedure else joint.velocity_rad_s[-1]
    speeds = np.linspace(0.0, top, 200)[1:]
    traces = []
    if samples is not None and samples.marked("cycles"):
        part = samples.during(samples.marked("cycles")[0])
        if part.velocity_rad_s is not None and part.torque_nm is not None:
            middle = float(np.mean([np.quantile(part.torque_nm, q) for q in (0.05, 0.95)]))
            traces.append(
                cloud("measured, middle removed", part.velocity_rad_s * scale, part.torque_nm - middle, MEASURED)
            )
    if joint.torque_interval_nm is not None:
        half = np.array([(high - low) / 2 for low, high in joint.torque_interval_nm])
        width = np.interp(speeds, joint.velocity_rad_s, half)
        level = curve.magnitude(speeds)
        traces.append(band("95 % interval", speeds * scale, level - width, level + width))
    signed = np.concatenate([-speeds[::-1], speeds])
    traces.append(line("identified curve", signed * scale, curve.torque(signed), IDENTIFIED))
    traces.append(
        points("pairs V_n, F_n", np.array(joint.velocity_rad_s) * scale, np.array(joint.torque_nm), IDENTIFIED)
    )
    if joint.published is not None:
        traces.append(
            points(
                "as published (Function A)",
                np.array(joint.published.velocity_rad_s) * scale,
                np.array(joint.published.torque_nm),
                PUBLISHED,
                symbol="x-thin-open",
            )
        )
    if previous is not None and name in previous.joints:
        before = previous.joints[name].curve()
        traces.append(line("active before", speeds * scale, before.magnitude(speeds), REFERENCE, dash="dash"))
    low, high = curve.measured_range_rad_s
    return Figure(
        f"Joint {name}: torque over velocity",
        tuple(traces),
        f"velocity [{unit}]",
        f"torque [{force}]",
        caption=f"Measured from {low * scale:.3g} to {high * scale:.3g} {unit}; extrapolated outside.",
    )


def _tracking_figure(name: str, samples: Samples) -> Figure:
    part = samples.during(samples.marked("cycles")[0])
    assert part.position_command_rad is not None  # by the caller
    time_s = part.time_s - part.time_s[0]
    error = (part.position_command_rad - part.position_rad) * (1e3 if part.prismatic else degrees(1.0))
    return Figure(
        f"Joint {name}: tracking",
        (line("command - position", time_s, error, IDENTIFIED, width=1),),
        "time [s]",
        f"following error [{'mm' if part.prismatic else 'deg'}]",
        caption="Tracking needs only to reach the speeds; the identification uses measured velocity and torque.",
    )


def _pairs(joint: JointProfile) -> Table:
    unit, force = ("m/s", "N") if joint.prismatic else ("deg/s", "N m")
    intervals: Sequence[tuple[float, float] | None] = joint.torque_interval_nm or [None] * len(joint.torque_nm)
    rows = tuple(
        (
            f"{velocity if joint.prismatic else degrees(velocity):.4g}",
            f"{torque:.4g}",
            f"{interval[0]:.4g} .. {interval[1]:.4g}" if interval else "",
        )
        for velocity, torque, interval in zip(joint.velocity_rad_s, joint.torque_nm, intervals, strict=True)
    )
    return Table((f"V_n [{unit}]", f"F_n [{force}]", "95 % interval"), rows, caption=f"Estimator: {joint.method}")


def _change(name: str, joint: JointProfile, previous: FrictionProfile | None) -> str:
    if previous is None or name not in previous.joints:
        return "no earlier profile"
    before = previous.joints[name].curve()
    distance = curve_distance(joint.curve(), before, joint.velocity_rad_s[-1])
    return f"{distance.e_percent:.1f} % from the active profile"


def _figure_text(figure: Estimate, unit: str) -> str:
    if figure.value is None:
        return f"none: {figure.reason}"
    if figure.low is None or figure.high is None:
        return f"{figure.value:.4g} {unit}"
    return f"{figure.value:.4g} {unit} ({figure.low:.4g} .. {figure.high:.4g})"


def _highest(joint: JointProfile) -> str:
    unit = "N" if joint.prismatic else "N m"
    return f"{joint.torque_nm[-1]:.4g} {unit} at {_speed(joint, joint.velocity_rad_s[-1])}"


def _speed(joint: JointProfile, velocity: float) -> str:
    return f"{velocity:.3g} m/s" if joint.prismatic else f"{degrees(velocity):.4g} deg/s"


def _facts(profile: FrictionProfile) -> dict[str, str]:
    told = profile.provenance
    facts = {
        "made": told.created_utc,
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
