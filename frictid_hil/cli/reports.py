"""``report``, ``dashboard`` and ``replay``: what was recorded, on a page, in a browser, or played back."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import typer

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import argument, option
from frictid_hil.cli.output import READING, Output, Result, takes, verb
from frictid_hil.units import degrees

app = typer.Typer()


def _show_pages(output: Output, result: Result) -> None:
    for key in ("report", "recalibration_report"):
        if key in result:
            output.say(result[key])


@verb(app, "report", _show_pages)
@takes(
    run=argument("[RUN]", "Run folder."),
    robot=option(
        "--robot -r",
        "ROBOT",
        "The page of a robot with its history: its name in the store, or its file.",
        complete=opt.robots,
    ),
)
def report(output: Output, run: Path | None = None, robot: str | None = None, store: Path | None = None) -> Result:
    """Write the self-contained HTML page of a run, or the index page of a robot."""
    from frictid_hil.jobs.report import report as job

    return job(run, robot=robot, store=store, told=output.counting(READING))


@verb(app, "dashboard")
@takes(
    runs=option("--runs", "DIR", "Folder under which runs are looked for.", file_okay=False),
    port=typer.Option("--port", min=1, max=65535, help="Port of 127.0.0.1 to listen on."),
)
def dashboard(output: Output, runs: Path = Path("runs"), store: Path | None = None, port: int = 8642) -> NoReturn:
    """Show robots, runs and a run as it moves, in a browser on this computer; it reads only. Runs until Ctrl-C."""
    from frictid_hil.jobs.dashboard import serve
    from frictid_hil.profiles.store import ProfileStore

    serve(runs, ProfileStore(store), port, output.announce("dashboard", "address", "dashboard"))
    raise typer.Exit(0)


def _show_replay(output: Output, result: Result) -> None:
    rows = []
    for name, joint in result["joints"].items():
        position, torque = joint.get("position_rms_rad"), joint.get("torque_rms_nm")
        rows.append(
            (
                name,
                joint["outcome"],
                _verdict(joint),
                str(joint.get("lost_rows") or 0),
                "" if position is None else f"{degrees(position):.3g} deg",
                "" if torque is None else f"{torque:.3g} N m",
                "; ".join(joint["remarks"]),
            )
        )
    headings = ("joint", "outcome", "profile", "rows missing", "position rms", "torque rms", "remarks")
    output.table(headings, rows, ("joint", "position rms", "torque rms"), f"Replay of {result['source']}")
    if log := result.get("log"):
        output.out.print(f"{log['frames']} frames, {log['rows']} cycles")
        for name, count in log["unknown"].items():
            output.out.print(f"unknown: {count} x {name}")
        for key in ("repeated", "backwards", "skipped"):
            if log[key]:
                output.out.print(f"{key}: {log[key]} frames")
        if log["damage"]:
            output.out.print(f"damaged: {log['damage']}")


def _verdict(joint: Result) -> str:
    if joint["identical"] is None:
        return "nothing to compare with"
    if joint["identical"]:
        return "identical"
    percent = joint["difference_percent"]
    return f"curve differs by {percent:.3g} %" if percent else "same curve, other figures or words"


@verb(app, "replay", _show_replay)
@takes(
    source=argument("RUN_OR_LOG", "Run folder, bus log (BLF, ASC, candump, TRC), MCAP or CSV."),
    frames=option("--frames", "FILE", "Mapping file of a foreign log: which frame is what."),
    eds=option("--eds", "FILE", "EDS or DCF file of the drives of a foreign log."),
    profile=option("--profile", "PROFILE", "Profile to compare with; default: the run's own."),
    amplitude=opt.SHARED["amplitude_rad"],
    velocity=opt.SHARED["velocity_rad_s"],
    paced=typer.Option("--realtime", help="Play at recorded speed."),
    echo=option("--echo", "BUS", "interface:channel of a bus on which every frame is sent again."),
    simulation=typer.Option("--simulate/--no-simulate", help="Stream the set-points to the simulated joints, too."),
)
def replay(
    output: Output,
    source: Path,
    robot: str,
    joints: list[str] | None = None,
    frames: Path | None = None,
    eds: Path | None = None,
    profile: Path | None = None,
    amplitude: float | None = None,
    velocity: float | None = None,
    cycles: int | None = None,
    ratio: float | None = None,
    method: str | None = None,
    paced: bool = False,
    echo: str | None = None,
    simulation: bool = True,
    out: Path | None = None,
    force: bool = False,
) -> Result:
    """Play a recording back: the same profile to the last bit, and measured beside simulated motion."""
    from frictid_hil.jobs.plans import given_procedure
    from frictid_hil.jobs.replay import ReplayOptions
    from frictid_hil.jobs.replay import replay as job

    procedure = given_procedure(amplitude, velocity, cycles, ratio)
    return job(output.options(ReplayOptions, procedure=procedure), output.err.print)
