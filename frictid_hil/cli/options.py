"""Options that several verbs share: one name, one help text, one completion each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from frictid_hil.errors import UsageError
from frictid_hil.units import parse_quantity


def option(names: str, metavar: str, help: str, complete: Callable[..., list[str]] | None = None, **more: Any) -> Any:
    """An option that takes a value, such as ``option("--robot -r", "FILE", "Robot file.")``."""
    return typer.Option(*names.split(), metavar=metavar, help=help, autocompletion=complete, **more)


def argument(metavar: str, help: str, complete: Callable[..., list[str]] | None = None, **more: Any) -> Any:
    """What is given by its place."""
    return typer.Argument(metavar=metavar, help=help, autocompletion=complete, **more)


def quantity(dimension: str) -> Callable[[str], float]:
    """A parser for options typed with a unit, e.g. ``20deg``."""

    def parse(text: str) -> float:
        try:
            return parse_quantity(text, dimension)
        except UsageError as error:
            hint = f"; {error.next_step}" if error.next_step else ""
            raise typer.BadParameter(f"{error}{hint}") from None

    return parse


def one_of(*choices: str) -> Callable[[str], list[str]]:
    """Shell completion from a few words."""
    return lambda incomplete: [choice for choice in choices if choice.startswith(incomplete)]


def robot_files(incomplete: str) -> list[str]:
    """Shell completion of robot files on the search path, and of paths."""
    from frictid_hil.config.search import places

    named = {path.name for place in places() if place.is_dir() for path in place.glob("*.yaml")}
    here = Path(incomplete).parent if "/" in incomplete else Path()
    literal = {str(path) for path in here.glob("*.y*ml")}
    return sorted(name for name in named | literal if name.startswith(incomplete))


def joints(context: typer.Context, incomplete: str) -> list[str]:
    """Shell completion of the joints of the robot that the line names."""
    from frictid_hil.config.robot import load_robot
    from frictid_hil.errors import FrictidError

    try:
        names = load_robot(str(context.params.get("robot"))).joint_names
    except FrictidError:
        return []
    return [name for name in names if name.startswith(incomplete)]


def robots(incomplete: str) -> list[str]:
    """Shell completion of the robots that the user's store knows."""
    from frictid_hil.profiles.store import ProfileStore

    return [name for name in ProfileStore(None).robots() if name.startswith(incomplete)]


def profiles(incomplete: str) -> list[str]:
    """Shell completion of profiles: those of the user's store by id, run folders and files by path."""
    from frictid_hil.profiles.store import ProfileStore

    store = ProfileStore(None)
    known = {one.stem for robot in store.robots() for one in (store.root / robot / "profiles").glob("*.yaml")}
    below = Path(incomplete).parent if "/" in incomplete else Path()
    near = {str(path) for path in below.glob("*.yaml")} | {str(path.parent) for path in below.glob("*/profile.yaml")}
    return sorted(name for name in known | near | {"active"} if name.startswith(incomplete))


SHARED: dict[str, Any] = {
    "as_json": typer.Option("--json", help="Exactly one JSON object on stdout."),
    "quiet": typer.Option("--quiet", "-q", help="No progress; the result and errors alone."),
    "dry_run": typer.Option("--dry-run", help="Print the plan; open no bus."),
    "yes": typer.Option("--yes", "-y", help="Skip the question before motion, never the checks."),
    "out": option("--out", "FOLDER", "Folder to write to."),
    "force": typer.Option("--force", help="Write over files that are there."),
    "resume": option("--resume", "RUN", "Go on with this run: its robot and options, what it still lacks."),
    "notify": option(
        "--notify",
        "CMD",
        "Command that is given the JSON on its standard input, however it ended; a shell needs `sh -c '...'`.",
    ),
    "robot": option("--robot -r", "FILE", "Robot file, by path or by name (hp3j.yaml).", complete=robot_files),
    "bus": option(
        "--bus", "BUS", "interface:channel instead of the robot file's (socketcan:can0, serial:/dev/ttyUSB0)."
    ),
    "realtime": typer.Option("--realtime", help="Run the virtual robot on the wall clock."),
    "seed": option("--seed", "N", "Seed of the virtual robot's noise."),
    "joint": option("--joint -j", "JOINT", "The joint.", complete=joints),
    "joints": option("--joint -j", "JOINT", "Only this joint; repeat for several. Default: all.", complete=joints),
    "amplitude_rad": option("--amplitude -A", "ANGLE", "Peak-to-peak travel A, e.g. 20deg.", parser=quantity("angle")),
    "velocity_rad_s": option(
        "--velocity -V", "SPEED", "Peak speed V, e.g. 115deg/s.", parser=quantity("angular velocity")
    ),
    "cycles": option("--cycles -N", "N", "Number of cycles N.", min=2),
    "ratio": option("--ratio -c", "C", "Window ratio c.", min=0.0, max=0.999),
    "method": option(
        "--method",
        "METHOD",
        "function-a (as published), aligned or least-squares; else that of the programme or of the profile.",
        complete=one_of("function-a", "aligned", "least-squares"),
    ),
    "profile": argument("PROFILE", "Profile, or a run folder that holds one.", complete=profiles),
    "live": typer.Option("--live", help="Stream samples over Foxglove WebSocket to this computer (127.0.0.1:8765)."),
    "live_at": option("--live-at", "HOST:PORT", "As --live, on this address; 0.0.0.0:8765 for everybody."),
    "store": option("--store", "FOLDER", "Folder of the profile store; default: the user's data folder."),
}
"""Options that several verbs share, by the name of their parameter."""
