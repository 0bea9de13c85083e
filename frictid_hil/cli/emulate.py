"""``emulate``: simulated controllers and drives for those who have none at hand."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import typer

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import option
from frictid_hil.cli.output import Output, takes, verb
from frictid_hil.errors import UsageError

app = typer.Typer(help="Put a simulated controller or drives on a port or bus of this computer.", no_args_is_help=True)


@verb(app, "motoman", schema="emulate")
@takes(
    pty=typer.Option("--pty", help="On a pseudo terminal, whose name is printed first."),
    robot=option("--robot -r", "FILE", "Robot file whose joints stand behind it.", complete=opt.robot_files),
    link=option(
        "--link",
        "NAME",
        "A name of your own for the port, under which it comes back after a fault that took it away.",
        dir_okay=False,
    ),
    fault=option("--fault", "FAULT", "What shall go wrong, in the emulator's words; repeat."),
)
def motoman(
    output: Output,
    pty: bool = False,
    robot: str = "hp3j-serial.yaml",
    link: Path | None = None,
    fault: list[str] | None = None,
) -> NoReturn:
    """A serial MOTOMAN-style controller with six simulated joints; runs until Ctrl-C."""
    from frictid_hil.jobs.emulate import emulate

    if not pty:
        raise UsageError("where shall it listen?", next_step="frictid-hil emulate motoman --pty")
    announce = output.announce("emulate", "port", "port")
    emulate("motoman", announce=announce, robot_name=robot, link=link, faults=tuple(fault or ()))
    raise typer.Exit(0)


@verb(app, "cia402", schema="emulate")
@takes(
    bus=option("--bus", "BUS", "interface:channel of python-can, e.g. socketcan:vcan0."),
    robot=option("--robot -r", "FILE", "Robot file of these drives.", complete=opt.robot_files),
)
def cia402(output: Output, bus: str, robot: str = "hp3j.yaml") -> NoReturn:
    """The CiA-402 drives of a robot file on a CAN bus, for any host; runs until Ctrl-C."""
    from frictid_hil.jobs.emulate import emulate

    emulate("cia402", announce=output.announce("emulate", "bus", "bus"), robot_name=robot, bus=bus)
    raise typer.Exit(0)
