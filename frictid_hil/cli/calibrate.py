"""``check``, ``reset``, ``calibrate``, ``identify``, ``compare``, ``compensate``: friction found, and given back."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import typer
from rich.text import Text

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import argument, option
from frictid_hil.cli.output import Output, Result, Told, takes, verb
from frictid_hil.errors import UsageError
from frictid_hil.plan.linear_axis import rotary_names
from frictid_hil.plan.mode import Mode
from frictid_hil.units import degrees, format_duration

app = typer.Typer()


def _show_findings(output: Output, result: Result) -> None:
    colors = {"ok": "green", "warning": "yellow", "error": "red"}
    rows = [
        (Text(one["severity"], colors[one["severity"]]), one["subject"], one["message"], one.get("next_step", ""))
        for one in result["findings"]
    ]
    output.table(("", "subject", "finding", "next step"), rows, ("", "subject"))
    ready = "ready for a check of the drives, without --dry" if result["dry"] else "ready"
    output.out.print(ready if result["ok"] else "not ready: see the errors above")


@verb(app, "check", _show_findings)
@takes(
    dry=typer.Option("--dry", help="Check the robot file and its plan alone; open no bus."),
    latency=option(
        "--latency",
        "TIME",
        "Also measure for so long, e.g. 60s, which rate this computer can hold.",
        parser=opt.quantity("duration"),
    ),
)
def check(
    output: Output,
    robot: str,
    bus: str | None = None,
    dry: bool = False,
    latency: float = "0s",  # type: ignore[assignment]  # typer parses it
) -> Result:
    """Look at bus, drives, modes, limits and bus load. Reads only; nothing moves, nothing is written."""
    from frictid_hil.jobs.check import check as job

    return job(robot, bus=bus, latency_s=latency, dry=dry)


def _show_reset(output: Output, result: Result) -> None:
    for one in result["reset"]:
        output.out.print(f"{one['subject']}: {one['message']}: reset")
    output.out.print("ready for `frictid-hil check`" if result["reset"] else "no drive is in fault")


@verb(app, "reset", _show_reset)
@takes(yes=typer.Option("--yes", "-y", help="Skip the question before the reset."))
def reset(output: Output, robot: str, bus: str | None = None, yes: bool = False) -> Result:
    """Bring drives back that a fault or a cut-off run left standing: shows what it was, asks, resets. No power."""
    from frictid_hil.cli.progress import answer
    from frictid_hil.jobs.reset import reset as job
    from frictid_hil.protocol.driver import Finding

    def ask(faults: list[Finding]) -> bool:
        for fault in faults:
            output.err.print(f"{fault.subject}: {fault.message}")
        if not yes and not sys.stdin.isatty():
            raise UsageError("a reset needs a yes, and there is no terminal to ask on", next_step="add --yes")
        return yes or answer("These will be reset; nothing moves. Is the cause cleared, the arm safe without power?")

    return job(robot, bus=bus, ask=ask)


def _show_joints(output: Output, result: Result) -> None:
    """The table a technician reads after a calibration or an identification."""
    headings = ("joint", "outcome", "F_0", "F at V", "speeds", "inertia", "time", "remarks")
    rows = [(name, *_row(joint)) for name, joint in result["joints"].items()]
    shown = [k for k, heading in enumerate(headings) if heading not in ("time", "remarks") or any(r[k] for r in rows)]
    if rows:
        title = f"Friction of {result.get('robot') or 'the recording'}"
        whole = ("joint", "F_0", "F at V")
        output.table([headings[k] for k in shown], [[row[k] for k in shown] for row in rows], whole, title)
    output.tell(result, "profile", "run", "report")


def _row(joint: dict[str, Any]) -> tuple[str | Text, ...]:
    joint = rotary_names(joint)
    outcome = joint["outcome"]
    shown = Text(outcome, "green" if outcome == "ok" else "red")
    prismatic = bool(joint.get("prismatic"))
    force = "N" if prismatic else "N m"
    speeds = joint.get("velocity_rad_s") or []
    torques = joint.get("torque_nm") or []
    measured = ""
    if speeds:
        low, high = (speeds[0], speeds[-1]) if prismatic else (degrees(speeds[0]), degrees(speeds[-1]))
        measured = f"{low:.3g} .. {high:.3g} {'m/s' if prismatic else 'deg/s'}"
    inertia = joint.get("inertia_kg_m2")
    return (
        shown,
        f"{joint['coulomb_nm']:.3f} {force}" if joint.get("coulomb_nm") is not None else "",
        f"{torques[-1]:.3f} {force}" if torques else "",
        measured,
        f"{inertia:.3f} {'kg' if prismatic else 'kg m2'}" if isinstance(inertia, (int, float)) else "",
        format_duration(joint["duration_s"]) if joint.get("duration_s") else "",
        "; ".join(joint.get("remarks") or []),
    )


@verb(app, "calibrate", _show_joints)
@takes(
    program=option(
        "--program",
        "PROGRAM",
        "thorough (N speeds, aligned; unless told), standard (3 speeds), quick (2): least squares.",
        complete=opt.one_of("thorough", "standard", "quick"),
    ),
    together=typer.Option("--together", help="All joints at once, in phase; the cell must allow it."),
    measure_skew=typer.Option(
        "--measure-skew/--declared-skew",
        help="Each joint also shakes for 8 s, which measures how late its torque is. Default: the robot file's "
        "`procedure: measure_skew`, else the declared timing.",
        show_default=False,
    ),
    rate_hz=typer.Option(
        "--rate", min=1.0, help="Set-points per second instead of the robot file's cycle_hz, e.g. 250."
    ),
)
def calibrate(
    output: Output,
    robot: str = "",
    joints: list[str] | None = None,
    amplitude_rad: float | None = None,
    velocity_rad_s: float | None = None,
    cycles: int | None = None,
    ratio: float | None = None,
    method: str | None = None,
    program: str | None = None,
    together: bool | None = None,
    measure_skew: bool | None = None,
    rate_hz: float | None = None,
    bus: str | None = None,
    dry_run: bool = False,
    realtime: bool | None = None,
    seed: int = 0,
    resume: Path | None = None,
    live: bool = False,
    live_at: str | None = None,
    out: Path | None = None,
    notify: str | None = None,
    yes: bool = False,
) -> Result | Told:
    """Identify the friction of every joint, one at a time or all --together, and write a friction profile."""
    from frictid_hil.cli.progress import shown_plan, watching
    from frictid_hil.jobs.calibrate import CalibrateOptions, plan_calibration
    from frictid_hil.jobs.calibrate import calibrate as job

    options = output.options(CalibrateOptions, seed=seed or None)
    if dry_run:
        planned = plan_calibration(options)
        return shown_plan(output, planned.plan, planned.order.setup)
    with watching(output, yes=yes, live=live, live_at=live_at) as watcher:
        return job(options, watcher)


@verb(app, "identify", _show_joints)
@takes(
    logs=argument("LOG...", "Run folders, MCAP, CSV, .mat or bus logs; folders and globs of them."),
    robot=option("--robot -r", "FILE", "Robot file (limits, gear, timing).", complete=opt.robot_files),
    columns=option("--columns", "FILE", "Column map of a foreign file (emps.yaml)."),
    executor=option("--executor", "WHERE", "processes:N, or dask://host:port, for many recordings."),
)
def identify(
    output: Output,
    logs: list[Path],
    robot: str | None = None,
    joints: list[str] | None = None,
    amplitude_rad: float | None = None,
    velocity_rad_s: float | None = None,
    cycles: int | None = None,
    ratio: float | None = None,
    method: str | None = "aligned",
    columns: str | None = None,
    executor: str | None = None,
    out: Path | None = None,
    force: bool = False,
) -> Result:
    """Identify friction from recorded data, by the same mathematics as a live run."""
    from frictid_hil.jobs.identify import IdentifyOptions
    from frictid_hil.jobs.identify import identify as job

    return job(output.options(IdentifyOptions), note=output.err.print)


def _show_distances(output: Output, result: Result) -> None:
    figures = ("e_nm", ".4f"), ("e_percent", ".2f"), ("e_percent_measured_range", ".2f")
    joints = rotary_names(result["joints"]).items()
    output.table(
        ("joint", "E [N m]", "percent of mean, [0, V]", "percent, measured range"),
        [(name, *(format(joint[key], digits) for key, digits in figures)) for name, joint in joints],
        ("joint", "E [N m]"),
    )
    for warning in result["warnings"]:
        output.say(f"note: {warning}")


@verb(app, "compare", _show_distances)
@takes(
    other=argument("[OTHER]", "Reference profile."),
    truth=option("--truth", "FILE", "Robot file whose simulated joints are the reference.", complete=opt.robot_files),
)
def compare(output: Output, profile: Path, other: Path | None = None, truth: str | None = None) -> Result:
    """Distance between two profiles, equation (15), or between a profile and the simulated joints' own curves."""
    from frictid_hil.jobs.compare import compare as job

    return job(profile, other, truth)


_DRIVE_MODES = {"torque": Mode.TORQUE, "position": Mode.POSITION, "velocity": Mode.VELOCITY}


def _drive_mode(name: str) -> Mode:
    if name not in _DRIVE_MODES:
        raise UsageError(f"no drive mode {name!r}; there are {', '.join(_DRIVE_MODES)}")
    return _DRIVE_MODES[name]


def _duration(text: str) -> float:
    return 0.0 if text.strip() == "0" else opt.quantity("duration")(text)


_HAND: dict[str, tuple[str, str, float]] = {
    "V_s": ("velocity_rms_rad_s", "deg/s", degrees(1.0)),
    "F_s": ("torque_rms_nm", "N m", 1.0),
    "reduced by": ("reduction_percent", "%", 1.0),
    "ceiling": ("ceiling_percent", "%", 1.0),
    "inertia removed": ("torque_rms_inertia_removed_nm", "N m", 1.0),
    "reduced by, inertia removed": ("reduction_inertia_removed_percent", "%", 1.0),
}
_TRACK: dict[str, tuple[str, str, float]] = {
    "E_s": ("tracking_rms_rad", "deg", degrees(1.0)),
    "reduced by": ("reduction_percent", "%", 1.0),
    "ceiling": ("ceiling_percent", "%", 1.0),
    "V_s": ("velocity_rms_rad_s", "deg/s", degrees(1.0)),
}
"""By heading of the table: key of the JSON, unit, factor."""


def _show_modes(output: Output, result: Result) -> None:
    columns = _HAND if result["task"] == "hand" else _TRACK
    title = f"Joint {result['joint']} of {result['robot']}: {result['task']}, setting {result['setting']}"
    if modes := result["modes"]:
        rows = [(name, *(_number(figures, *one) for one in columns.values())) for name, figures in modes.items()]
        output.table(("mode", *columns), rows, ("mode",), title)
    for told in (*result["warnings"], *result["remarks"]):
        output.say(f"note: {told}")
    output.tell(result, "run", "report")


def _number(figures: dict[str, Any], key: str, unit: str, scale: float) -> str:
    value = figures.get(key)
    return "" if value is None else f"{value * scale:.4g} {unit}"


@verb(app, "compensate", _show_modes)
@takes(
    task=option(
        "--task",
        "TASK",
        "hand (a person guides the joint), track (a triangle under a weak PD).",
        complete=opt.one_of("hand", "track"),
    ),
    profile=option(
        "--profile -p",
        "PROFILE",
        "Profile, run folder, or id of the store. Default: the robot's active profile.",
        complete=opt.profiles,
    ),
    mode=option("--mode", "MODES", "nc, mo, mol, mop, mop-reference, joined by commas. Default: all of the task."),
    setting=option(
        "--setting", "SETTING", "ours, or paper (R = 0.9, K = 10000 N m/rad).", complete=opt.one_of("ours", "paper")
    ),
    ratio=option("--compensation-ratio", "R", "R, below 1."),
    stiffness_nm_per_rad=option("--stiffness", "K", "K, e.g. 8000Nm/rad.", parser=opt.quantity("stiffness")),
    viscous_nm_s_per_rad=option(
        "--viscosity", "B_C", "B_c of mol in N m s/rad, instead of the least-squares one.", min=0.0
    ),
    speed_rad_s=option("--speed", "SPEED", "Peak speed of the task.", parser=opt.quantity("angular velocity")),
    duration_s=option(
        "--duration", "TIME", "Of each mode, 10s unless told; 0 runs until interrupted.", parser=_duration
    ),
    centre_rad=option("--centre", "ANGLE", "Middle of the travel.", parser=opt.quantity("angle")),
    drive_mode=option(
        "--drive-mode",
        "MODE",
        "torque; position or velocity with the torque as offset (60B2).",
        complete=opt.one_of("torque", "position", "velocity"),
    ),
    force=typer.Option("--force", help="Use a profile that does not fit, under supervision."),
)
def compensate(
    output: Output,
    robot: str,
    joint: str,
    task: str,
    profile: str = "active",
    mode: str | None = None,
    setting: str = "ours",
    ratio: float | None = None,
    stiffness_nm_per_rad: float | None = None,
    viscous_nm_s_per_rad: float | None = None,
    speed_rad_s: float | None = None,
    duration_s: float | None = None,
    centre_rad: float | None = None,
    drive_mode: str = "torque",
    force: bool = False,
    dry_run: bool = False,
    bus: str | None = None,
    realtime: bool | None = None,
    seed: int = 0,
    live: bool = False,
    live_at: str | None = None,
    out: Path | None = None,
    store: Path | None = None,
    yes: bool = False,
) -> Result | Told:
    """Compensate a joint's friction with an identified profile, in one mode or several, and compare them."""
    from frictid_hil.cli.progress import shown_plan, watching
    from frictid_hil.jobs.compensate import CompensateOptions, plan_compensation
    from frictid_hil.jobs.compensate import compensate as job
    from frictid_hil.jobs.compensation.wanted import Wanted

    modes = tuple(part.strip() for part in mode.split(",")) if mode else ()
    wanted = output.options(Wanted, modes=modes, drive_mode=_drive_mode(drive_mode))
    options = output.options(CompensateOptions, wanted=wanted)
    if dry_run:
        planned = plan_compensation(options)
        return shown_plan(output, planned.plan, planned.setup)
    with watching(output, yes=yes, live=live, live_at=live_at) as watcher:
        return job(options, watcher, live=watcher.note)
