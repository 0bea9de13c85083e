"""``check``, ``calibrate``, ``identify``, ``compare``: from a robot on a bus, or a recording, to a friction profile."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from frictid_hil.cli.options import (
    AmplitudeOption,
    BusOption,
    CyclesOption,
    DryRunOption,
    ForceOption,
    JointOption,
    JsonOption,
    LiveAtOption,
    LiveOption,
    MethodOption,
    NotifyOption,
    OutOption,
    ProfileArgument,
    QuietOption,
    RatioOption,
    RealtimeOption,
    ResumeOption,
    RobotOption,
    SeedOption,
    VelocityOption,
    YesOption,
    one_of,
    quantity,
    robot_files,
)
from frictid_hil.cli.output import Output, Result, Told
from frictid_hil.cli.tables import folding
from frictid_hil.errors import UsageError
from frictid_hil.plan.linear_axis import rotary_names
from frictid_hil.units import degrees, format_duration


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("check")(check)
    app.command("reset")(reset)
    app.command("calibrate")(calibrate)
    app.command("identify")(identify)
    app.command("compare")(compare)


def check(
    robot: RobotOption,
    bus: BusOption = None,
    dry: Annotated[bool, typer.Option("--dry", help="Check the robot file and its plan alone; open no bus.")] = False,
    latency: Annotated[
        float,
        typer.Option(
            "--latency",
            metavar="TIME",
            parser=quantity("duration"),
            help="Also measure for so long, e.g. 60s, which rate this computer can hold.",
        ),
    ] = "0s",  # type: ignore[assignment]  # typer parses it
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Look at bus, drives, modes, limits and bus load. Reads only; nothing moves, nothing is written."""
    from frictid_hil.jobs.check import check as job

    output = Output(as_json, quiet)

    def show(result: Result) -> None:
        colors = {"ok": "green", "warning": "yellow", "error": "red"}
        table = folding("", "subject", "finding", "next step", whole=("", "subject"))
        for finding in result["findings"]:
            table.add_row(
                Text(finding["severity"], colors[finding["severity"]]),
                finding["subject"],
                finding["message"],
                finding.get("next_step", ""),
            )
        output.out.print(table)
        ready = "ready for a check of the drives, without --dry" if dry else "ready"
        output.out.print(ready if result["ok"] else "not ready: see the errors above")

    output.run("check", lambda: job(robot, bus=bus, latency_s=latency, dry=dry), show)


def reset(
    robot: RobotOption,
    bus: BusOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Skip the question before the reset.")] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Bring drives back that a fault or a cut-off run left standing: shows what it was, asks, resets. No power."""
    from frictid_hil.cli.progress import answer
    from frictid_hil.jobs.reset import reset as job
    from frictid_hil.protocol.driver import Finding

    output = Output(as_json, quiet)

    def ask(faults: list[Finding]) -> bool:
        for fault in faults:
            output.err.print(f"{fault.subject}: {fault.message}")
        if not yes and not sys.stdin.isatty():
            raise UsageError("a reset needs a yes, and there is no terminal to ask on", next_step="add --yes")
        return yes or answer("These will be reset; nothing moves. Is the cause cleared, the arm safe without power?")

    def show(result: Result) -> None:
        for one in result["reset"]:
            output.out.print(f"{one['subject']}: {one['message']}: reset")
        output.out.print("ready for `frictid-hil check`" if result["reset"] else "no drive is in fault")

    output.run("reset", lambda: job(robot, bus=bus, ask=ask), show)


ProgramOption = Annotated[
    str | None,
    typer.Option(
        "--program",
        metavar="PROGRAM",
        autocompletion=one_of("thorough", "standard", "quick"),
        help="thorough (N speeds, aligned; unless told), standard (3 speeds), quick (2): least squares.",
    ),
]
TogetherOption = Annotated[
    bool,
    typer.Option("--together", help="All joints at once, in phase; the cell must allow it."),
]
MeasureSkewOption = Annotated[
    bool | None,
    typer.Option(
        "--measure-skew/--declared-skew",
        help="Each joint also shakes for 8 s, which measures how late its torque is. Default: the robot file's "
        "`procedure: measure_skew`, else the declared timing.",
        show_default=False,
    ),
]
RateOption = Annotated[
    float | None,
    typer.Option("--rate", min=1.0, help="Set-points per second instead of the robot file's cycle_hz, e.g. 250."),
]


def calibrate(
    robot: RobotOption = "",
    joint: JointOption = None,
    amplitude: AmplitudeOption = None,
    velocity: VelocityOption = None,
    cycles: CyclesOption = None,
    ratio: RatioOption = None,
    method: MethodOption = None,
    program: ProgramOption = None,
    together: TogetherOption = False,
    measure_skew: MeasureSkewOption = None,
    rate: RateOption = None,
    bus: BusOption = None,
    dry_run: DryRunOption = False,
    realtime: RealtimeOption = False,
    seed: SeedOption = 0,
    resume: ResumeOption = None,
    live: LiveOption = False,
    live_at: LiveAtOption = None,
    out: OutOption = None,
    notify: NotifyOption = None,
    yes: YesOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Identify the friction of every joint, one at a time or all --together, and write a friction profile."""
    from frictid_hil.cli.progress import answer_dry_run, watching
    from frictid_hil.jobs.calibrate import CalibrateOptions, plan_calibration
    from frictid_hil.jobs.calibrate import calibrate as job

    output = Output(as_json, quiet, notify)
    options = CalibrateOptions(
        robot=robot,
        bus=bus,
        joints=tuple(joint or ()),
        amplitude_rad=amplitude,
        velocity_rad_s=velocity,
        cycles=cycles,
        ratio=ratio,
        method=method,
        program=program,
        together=together or None,
        measure_skew=measure_skew,
        rate_hz=rate,
        realtime=realtime or None,
        seed=seed or None,
        resume=resume,
        out=out,
    )
    if dry_run:
        answer_dry_run(output, "calibrate", lambda: plan_calibration(options))

    def run() -> Told:
        with watching(output, yes=yes, live=live, live_at=live_at) as watcher:
            return job(options, watcher)

    output.run("calibrate", run, lambda result: print_joints(output, result))


def identify(
    log: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Run folders, MCAP, CSV, .mat or bus logs; folders and globs of them."),
    ],
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot", "-r", metavar="FILE", help="Robot file (limits, gear, timing).", autocompletion=robot_files
        ),
    ] = None,
    joint: JointOption = None,
    amplitude: AmplitudeOption = None,
    velocity: VelocityOption = None,
    cycles: CyclesOption = None,
    ratio: RatioOption = None,
    method: MethodOption = "aligned",
    columns: Annotated[
        str | None, typer.Option("--columns", metavar="FILE", help="Column map of a foreign file (emps.yaml).")
    ] = None,
    executor: Annotated[
        str | None,
        typer.Option("--executor", metavar="WHERE", help="processes:N, or dask://host:port, for many recordings."),
    ] = None,
    out: OutOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Identify friction from recorded data, by the same mathematics as a live run."""
    from frictid_hil.jobs.identify import IdentifyOptions
    from frictid_hil.jobs.identify import identify as job

    output = Output(as_json, quiet)
    options = IdentifyOptions(
        logs=tuple(log),
        robot=robot,
        joints=tuple(joint or ()),
        amplitude_rad=amplitude,
        velocity_rad_s=velocity,
        cycles=cycles,
        ratio=ratio,
        method=method or "aligned",
        columns=columns,
        executor=executor,
        out=out,
        force=force,
    )
    output.run("identify", lambda: job(options, note=output.err.print), lambda result: print_joints(output, result))


def compare(
    profile: ProfileArgument,
    other: Annotated[Path | None, typer.Argument(metavar="[OTHER]", help="Reference profile.")] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            "--truth",
            metavar="FILE",
            autocompletion=robot_files,
            help="Robot file whose simulated joints are the reference.",
        ),
    ] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Distance between two profiles, equation (15), or between a profile and the simulated joints' own curves."""
    from frictid_hil.jobs.compare import compare as job

    output = Output(as_json, quiet)

    def show(result: Result) -> None:
        table = folding(
            "joint", "E [N m]", "percent of mean, [0, V]", "percent, measured range", whole=("joint", "E [N m]")
        )
        for name, figures in rotary_names(result["joints"]).items():
            table.add_row(
                name,
                f"{figures['e_nm']:.4f}",
                f"{figures['e_percent']:.2f}",
                f"{figures['e_percent_measured_range']:.2f}",
            )
        output.out.print(table)
        for warning in result["warnings"]:
            output.out.print(f"note: {warning}", soft_wrap=True)

    output.run("compare", lambda: job(profile, other, truth), show)


def print_joints(output: Output, result: Result) -> None:
    """The table a technician reads after a calibration or an identification."""
    headings = ("joint", "outcome", "F_0", "F at V", "speeds", "inertia", "time", "remarks")
    rows = [(name, *_row(joint)) for name, joint in result["joints"].items()]
    shown = [k for k, heading in enumerate(headings) if heading not in ("time", "remarks") or any(r[k] for r in rows)]
    table = folding(
        *(headings[k] for k in shown),
        whole=("joint", "F_0", "F at V"),
        title=f"Friction of {result.get('robot') or 'the recording'}",
    )
    for row in rows:
        table.add_row(*(row[k] for k in shown))
    if rows:
        output.out.print(table)
    for key in ("profile", "run", "report"):
        if result.get(key):
            output.out.print(f"{key}: {result[key]}", soft_wrap=True)


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
