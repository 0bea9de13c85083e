"""``new``: files of one's own to start from."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from frictid_hil.cli.options import ForceOption, JsonOption, QuietOption, quantity
from frictid_hil.cli.output import Output
from frictid_hil.errors import UsageError
from frictid_hil.units import parse_quantity

app = typer.Typer(help="Write a file of your own to start from.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Write a file of your own to start from."""


@app.command("robot")
def robot(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="Robot file to write; the robot is named after it.")],
    joint: Annotated[
        list[str] | None,
        typer.Option("--joint", "-j", metavar="NAME=ADDRESS", help="A joint and its node, axis or id; repeat."),
    ] = None,
    bus: Annotated[
        str | None, typer.Option("--bus", metavar="BUS", help="interface:channel, e.g. socketcan:can0.")
    ] = None,
    driver: Annotated[str, typer.Option("--driver", metavar="DRIVER", help="Driver of the bus.")] = "cia402",
    travel: Annotated[
        str | None, typer.Option("--travel", metavar="LOW..HIGH", help="Travel of the joints, e.g. -90deg..90deg.")
    ] = None,
    max_velocity: Annotated[
        float | None,
        typer.Option("--max-velocity", metavar="SPEED", parser=quantity("angular velocity"), help="E.g. 115deg/s."),
    ] = None,
    max_torque: Annotated[
        float | None,
        typer.Option("--max-torque", metavar="TORQUE", parser=quantity("torque"), help="At the joint, e.g. 60Nm."),
    ] = None,
    gear_ratio: Annotated[
        float | None, typer.Option("--gear-ratio", min=1e-3, help="Motor revolutions per joint revolution.")
    ] = None,
    rated_torque: Annotated[
        float | None,
        typer.Option("--rated-torque", metavar="TORQUE", parser=quantity("torque"), help="At the joint: motor x gear."),
    ] = None,
    cycle_hz: Annotated[float, typer.Option("--rate", min=1.0, help="Set-points per second.")] = 1000.0,
    read: Annotated[bool, typer.Option("--read", help="Ask the drives for gear and rated torque; nothing moves.")] = (
        False
    ),
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """A robot file for your robot. On a terminal it asks for what you did not give; one answer holds for all joints."""
    from frictid_hil.files import refuse_overwriting
    from frictid_hil.jobs.new_robot import JointAnswers, new_robot

    output = Output(as_json, quiet)
    asks = sys.stdin.isatty() and not as_json

    def answer(given: str | None, question: str, option: str) -> str:
        if given is not None:
            return given
        if not asks:
            raise UsageError(f"{question} is not given", next_step=f"add `{option}`, or run it in a terminal")
        return str(typer.prompt(question, err=True))

    def written() -> dict[str, Any]:
        refuse_overwriting([path], force=force)
        names = joint or answer(None, "joints, as NAME=ADDRESS NAME=ADDRESS", "--joint").split()
        spot = answer(bus, "bus, as interface:channel", "--bus")
        low, high = _travel(answer(travel, "travel of the joints, as LOW..HIGH (-90deg..90deg)", "--travel"))
        speed = max_velocity or parse_quantity(
            answer(None, "highest speed of a joint (115deg/s)", "--max-velocity"), "angular velocity"
        )
        torque = max_torque or parse_quantity(
            answer(None, "highest torque at a joint (60Nm)", "--max-torque"), "torque"
        )
        joints = [
            JointAnswers(name, address, (low, high), speed, torque, gear_ratio, rated_torque)
            for name, address in map(_named, names)
        ]
        return new_robot(
            path, driver=driver, bus=spot, joints=joints, cycle_hz=cycle_hz, read=read, force=force
        ).to_json()

    def show(result: Mapping[str, Any]) -> None:
        output.out.print(f"{path}: look at every line, then `frictid-hil calibrate --robot {path} --dry-run`")

    output.run("new-robot", written, show)


@app.command("driver")
def driver(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the driver, as robot files will have it.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write; frictid-NAME here if not given.")] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """A driver of your own for CAN devices: a package that runs, with a fake device, a robot file and its tests."""
    from frictid_hil.jobs.new_driver import new_driver

    output = Output(as_json, quiet)

    def written() -> dict[str, Any]:
        return {"files": [str(path.resolve()) for path in new_driver(name, out)]}

    def show(result: Mapping[str, Any]) -> None:
        for path in result["files"]:
            output.out.print(path, soft_wrap=True)
        output.out.print("now: cd there, `pip install -e .`, `pytest`; then replace the frames by those of your device")

    output.run("new-driver", written, show)


def _named(text: str) -> tuple[str, int]:
    name, _, address = text.partition("=")
    if not name or not address.isdecimal():
        raise UsageError(f"expected NAME=ADDRESS such as elbow=2, found {text!r}")
    return name, int(address)


def _travel(text: str) -> tuple[float, float]:
    low, dots, high = text.partition("..")
    if not dots:
        raise UsageError(f"expected LOW..HIGH such as -90deg..90deg, found {text!r}")
    return parse_quantity(low, "angle"), parse_quantity(high, "angle")
