"""``new``: files of one's own to start from."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import typer

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import argument, option
from frictid_hil.cli.output import Output, Result, Told, takes, verb
from frictid_hil.errors import Interrupted, UsageError

_Value = TypeVar("_Value")

app = typer.Typer(help="Write a file of your own to start from.", no_args_is_help=True)


def _named(text: str) -> tuple[str, int]:
    name, _, address = text.partition("=")
    if not name or not address.isdecimal():
        raise typer.BadParameter(f"expected NAME=ADDRESS such as elbow=2, found {text!r}")
    return name, int(address)


def _all_named(text: str) -> list[tuple[str, int]]:
    return [_named(word) for word in text.replace(",", " ").split()]


def _travel(text: str) -> tuple[float, float]:
    low, dots, high = text.partition("..")
    if not dots:
        raise typer.BadParameter(f"expected LOW..HIGH such as -90deg..90deg, found {text!r}")
    parse = opt.quantity("angle")
    return parse(low), parse(high)


def _bus(text: str) -> str:
    interface, colon, channel = text.partition(":")
    if not (interface and colon and channel):
        raise typer.BadParameter(f"expected interface:channel such as socketcan:can0, found {text!r}")
    return text


def _ratio(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0.0:
        raise typer.BadParameter(f"expected a number above 0 such as 100, found {text!r}")
    return value


def _on_a_terminal() -> bool:
    return sys.stdin.isatty()


def _show_robot(output: Output, _result: Result) -> None:
    path = output.given["path"]
    output.say(f"{path}: look at every line, then `frictid-hil check --robot {path} --dry`")


@verb(app, "robot", _show_robot, schema="new_robot")
@takes(
    path=argument("FILE", "Robot file to write; the robot is named after it."),
    joint=option("--joint -j", "NAME=ADDRESS", "A joint and its address; repeat.", parser=_named),
    bus=option("--bus", "BUS", "interface:channel, e.g. socketcan:can0.", parser=_bus),
    driver=option("--driver", "DRIVER", "Driver of the bus."),
    travel=option("--travel", "LOW..HIGH", "Travel of the joints: -90deg..90deg.", parser=_travel),
    max_velocity=option("--max-velocity", "SPEED", "E.g. 115deg/s.", parser=opt.quantity("angular velocity")),
    max_torque=option("--max-torque", "TORQUE", "At the joint, e.g. 60Nm.", parser=opt.quantity("torque")),
    gear_ratio=option("--gear-ratio", "RATIO", "Motor revolutions per joint revolution.", parser=_ratio),
    rated_torque=option("--rated-torque", "TORQUE", "At the joint: motor x gear.", parser=opt.quantity("torque")),
    cycle_hz=typer.Option("--rate", min=1.0, help="Set-points per second."),
    read=typer.Option("--read", help="Ask the drives for gear and rated torque; nothing moves."),
)
def robot(
    output: Output,
    path: Path,
    joint: list[Any] | None = None,
    bus: str | None = None,
    driver: str = "cia402",
    travel: Any = None,
    max_velocity: float | None = None,
    max_torque: float | None = None,
    gear_ratio: float | None = None,
    rated_torque: float | None = None,
    cycle_hz: float = 1000.0,
    read: bool = (False),
    force: bool = False,
) -> Told:
    """A robot file for your robot. On a terminal it asks for what you did not give; one answer holds for all joints."""
    from frictid_hil.files import refuse_overwriting
    from frictid_hil.jobs.new_robot import JointAnswers, new_robot

    def answer(given: _Value | None, question: str, option: str, parse: Callable[[str], _Value]) -> _Value:
        if given is None and (output.as_json or not _on_a_terminal()):
            raise UsageError(f"{question} is not given", next_step=f"add `{option}`, or run it in a terminal")
        try:
            # A mistyped answer is asked for again.
            return given if given is not None else typer.prompt(question, err=True, value_proc=parse)
        except typer.Abort:
            raise Interrupted("interrupted; no file was written") from None

    refuse_overwriting([path], force=force)
    names = answer(joint or None, "joints and their addresses (shoulder=1 elbow=2)", "--joint", _all_named)
    spot = answer(bus, "bus (socketcan:can0)", "--bus", _bus)
    range_rad = answer(travel, "travel of the joints (-90deg..90deg)", "--travel", _travel)
    speed = answer(
        max_velocity, "highest speed of a joint (115deg/s)", "--max-velocity", opt.quantity("angular velocity")
    )
    torque = answer(max_torque, "highest torque at a joint (60Nm)", "--max-torque", opt.quantity("torque"))
    ratio, rated = gear_ratio, rated_torque
    if not read:
        ratio = answer(ratio, "motor revolutions per joint revolution (100)", "--gear-ratio", _ratio)
        rated = answer(rated, "rated torque at a joint: motor x gear (24Nm)", "--rated-torque", opt.quantity("torque"))
    joints = [JointAnswers(name, address, range_rad, speed, torque, ratio, rated) for name, address in names]
    return new_robot(path, driver=driver, bus=spot, joints=joints, cycle_hz=cycle_hz, read=read, force=force)


def _show_driver(output: Output, result: Result) -> None:
    for path in result["files"]:
        output.say(path)
    output.out.print("now: cd there, `pip install -e .`, `pytest`; then replace the frames by those of your device")


@verb(app, "driver", _show_driver, schema="new_driver")
@takes(
    name=argument("NAME", "Name of the driver, as robot files will have it."),
    out=typer.Option("--out", help="Folder to write; frictid-NAME here if not given."),
)
def driver(output: Output, name: str, out: Path | None = None) -> Result:
    """A driver of your own for CAN devices: a package that runs, with a fake device, a robot file and its tests."""
    from frictid_hil.jobs.new_driver import new_driver

    return {"files": [str(path.resolve()) for path in new_driver(name, out)]}
