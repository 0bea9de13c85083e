"""``emulate``: simulated controllers and drives for those who have none at hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.cli.options import JsonOption, QuietOption, robot_files
from frictid_hil.cli.output import Output, Result
from frictid_hil.errors import UsageError

app = typer.Typer(help="Put a simulated controller or drives on a port or bus of this computer.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Put a simulated controller or drives on a port or bus of this computer."""


@app.command("motoman")
def motoman(
    pty: Annotated[bool, typer.Option("--pty", help="On a pseudo terminal, whose name is printed first.")] = False,
    robot: Annotated[
        str,
        typer.Option(
            "--robot",
            "-r",
            metavar="FILE",
            autocompletion=robot_files,
            help="Robot file whose joints stand behind it.",
        ),
    ] = "hp3j-serial.yaml",
    link: Annotated[
        Path | None,
        typer.Option(
            "--link",
            metavar="NAME",
            dir_okay=False,
            help="A name of your own for the port, under which it comes back after a fault that took it away.",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="FAULT", help="What shall go wrong, in the emulator's words; repeat."),
    ] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """A serial MOTOMAN-style controller with six simulated joints; runs until Ctrl-C."""
    from frictid_hil.jobs.emulate import emulate

    output = Output(as_json, quiet)

    def run() -> Result:
        if not pty:
            raise UsageError("where shall it listen?", next_step="frictid-hil emulate motoman --pty")
        announce = _announced(as_json, "port")
        emulate("motoman", announce=announce, robot_name=robot, link=link, faults=tuple(fault or ()))
        raise typer.Exit(0)

    output.run("emulate", run)


@app.command("cia402")
def cia402(
    bus: Annotated[
        str,
        typer.Option("--bus", metavar="BUS", help="interface:channel of python-can, e.g. socketcan:vcan0."),
    ],
    robot: Annotated[
        str,
        typer.Option("--robot", "-r", metavar="FILE", autocompletion=robot_files, help="Robot file of these drives."),
    ] = "hp3j.yaml",
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """The CiA-402 drives of a robot file on a CAN bus, for any host; runs until Ctrl-C."""
    from frictid_hil.jobs.emulate import emulate

    output = Output(as_json, quiet)

    def run() -> Result:
        emulate("cia402", announce=_announced(as_json, "bus"), robot_name=robot, bus=bus)
        raise typer.Exit(0)

    output.run("emulate", run)


def _announced(as_json: bool, what: str) -> Callable[[str], None]:
    """Tells where it can be reached; whoever waits for it reads the first line."""

    def announce(name: str) -> None:
        told = (
            json.dumps({"schema": "frictid.emulate/1", "outcome": "ok", what: name}) if as_json else f"{what}: {name}"
        )
        print(told, flush=True)

    return announce
