"""``check``, ``calibrate``, ``identify``, ``compare``: from a robot on a bus, or a recording, to a friction profile."""

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
