"""``replay``: a recording played back into the decoders, or into the simulated joint."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.cli.options import (
    AmplitudeOption,
    CyclesOption,
    ForceOption,
    JointOption,
    JsonOption,
    MethodOption,
    OutOption,
    QuietOption,
    RatioOption,
    RobotOption,
    VelocityOption,
)
from frictid_hil.cli.output import Output, Result
from frictid_hil.cli.tables import folding
from frictid_hil.units import degrees


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("replay")(replay)


SourceArgument = Annotated[
    Path, typer.Argument(metavar="RUN_OR_LOG", help="Run folder, bus log (BLF, ASC, candump, TRC), MCAP or CSV.")
]
FramesOption = Annotated[
    Path | None,
    typer.Option("--frames", metavar="FILE", help="Mapping file of a foreign log: which frame is what."),
]
EdsOption = Annotated[
    Path | None, typer.Option("--eds", metavar="FILE", help="EDS or DCF file of the drives of a foreign log.")
]
ProfileOption = Annotated[
    Path | None,
    typer.Option("--profile", metavar="PROFILE", help="Profile to compare with; default: the run's own."),
]
EchoOption = Annotated[
    str | None,
    typer.Option("--echo", metavar="BUS", help="interface:channel of a bus on which every frame is sent again."),
]
SimulateOption = Annotated[
    bool, typer.Option("--simulate/--no-simulate", help="Stream the set-points to the simulated joints, too.")
]


def replay(
    source: SourceArgument,
    robot: RobotOption,
    joint: JointOption = None,
    frames: FramesOption = None,
    eds: EdsOption = None,
    profile: ProfileOption = None,
    amplitude: AmplitudeOption = None,
    velocity: VelocityOption = None,
    cycles: CyclesOption = None,
    ratio: RatioOption = None,
    method: MethodOption = None,
    realtime: Annotated[bool, typer.Option("--realtime", help="Play at recorded speed.")] = False,
    echo: EchoOption = None,
    simulate: SimulateOption = True,
    out: OutOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Play a recording back: the same profile to the last bit, and measured beside simulated motion."""
    from frictid_hil.jobs.plans import given_procedure
    from frictid_hil.jobs.replay import ReplayOptions
    from frictid_hil.jobs.replay import replay as job

    output = Output(as_json, quiet)

    def run() -> Result:
        options = ReplayOptions(
            source=source,
            robot=robot,
            joints=tuple(joint or ()),
            frames=frames,
            eds=eds,
            profile=profile,
            procedure=given_procedure(amplitude, velocity, cycles, ratio),
            method=method,
            paced=realtime,
            echo=echo,
            simulation=simulate,
            out=out,
            force=force,
        )
        return job(options, output.err.print)

    output.run("replay", run, lambda result: _print(output, result))


def _print(output: Output, result: Result) -> None:
    headings = ("joint", "outcome", "profile", "rows missing", "position rms", "torque rms", "remarks")
    table = folding(*headings, whole=("joint", "position rms", "torque rms"), title=f"Replay of {result['source']}")
    for name, joint in result["joints"].items():
        position, torque = joint.get("position_rms_rad"), joint.get("torque_rms_nm")
        table.add_row(
            name,
            joint["outcome"],
            _verdict(joint),
            str(joint.get("lost_rows") or 0),
            "" if position is None else f"{degrees(position):.3g} deg",
            "" if torque is None else f"{torque:.3g} N m",
            "; ".join(joint["remarks"]),
        )
    output.out.print(table)
    log = result.get("log")
    if log:
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
