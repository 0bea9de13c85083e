"""Options that several verbs share: one name, one help text, one completion each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.errors import UsageError
from frictid_hil.units import parse_quantity


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


DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Print the plan; open no bus.")]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Skip the question before motion, never the checks.")]
OutOption = Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="Folder to write to.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Write over files that are there.")]
ResumeOption = Annotated[
    Path | None,
    typer.Option("--resume", metavar="RUN", help="Go on with this run: its robot and options, what it still lacks."),
]
NotifyOption = Annotated[
    str | None,
    typer.Option(
        "--notify",
        metavar="CMD",
        help="Command that is given the JSON on its standard input, however it ended; a shell needs `sh -c '...'`.",
    ),
]

RobotOption = Annotated[
    str,
    typer.Option(
        "--robot",
        "-r",
        metavar="FILE",
        help="Robot file, by path or by name (hp3j.yaml).",
        autocompletion=robot_files,
    ),
]
BusOption = Annotated[
    str | None,
    typer.Option(
        "--bus",
        metavar="BUS",
        help="interface:channel instead of the robot file's (socketcan:can0, serial:/dev/ttyUSB0).",
    ),
]
RealtimeOption = Annotated[bool | None, typer.Option("--realtime", help="Run the virtual robot on the wall clock.")]
SeedOption = Annotated[int, typer.Option("--seed", metavar="N", help="Seed of the virtual robot's noise.")]

OneJointOption = Annotated[
    str, typer.Option("--joint", "-j", metavar="JOINT", help="The joint.", autocompletion=joints)
]
JointOption = Annotated[
    list[str] | None,
    typer.Option(
        "--joint",
        "-j",
        metavar="JOINT",
        help="Only this joint; repeat for several. Default: all.",
        autocompletion=joints,
    ),
]
AmplitudeOption = Annotated[
    float | None,
    typer.Option(
        "--amplitude",
        "-A",
        metavar="ANGLE",
        parser=quantity("angle"),
        help="Peak-to-peak travel A, e.g. 20deg.",
    ),
]
VelocityOption = Annotated[
    float | None,
    typer.Option(
        "--velocity",
        "-V",
        metavar="SPEED",
        parser=quantity("angular velocity"),
        help="Peak speed V, e.g. 115deg/s.",
    ),
]
CyclesOption = Annotated[int | None, typer.Option("--cycles", "-N", metavar="N", min=2, help="Number of cycles N.")]
RatioOption = Annotated[
    float | None, typer.Option("--ratio", "-c", metavar="C", min=0.0, max=0.999, help="Window ratio c.")
]
MethodOption = Annotated[
    str | None,
    typer.Option(
        "--method",
        metavar="METHOD",
        autocompletion=one_of("function-a", "aligned", "least-squares"),
        help="function-a (as published), aligned or least-squares; else that of the programme or of the profile.",
    ),
]

ProfileArgument = Annotated[
    Path,
    typer.Argument(metavar="PROFILE", help="Profile, or a run folder that holds one.", autocompletion=profiles),
]
LiveOption = Annotated[
    bool, typer.Option("--live", help="Stream samples over Foxglove WebSocket to this computer (127.0.0.1:8765).")
]
LiveAtOption = Annotated[
    str | None,
    typer.Option("--live-at", metavar="HOST:PORT", help="As --live, on this address; 0.0.0.0:8765 for everybody."),
]
StoreOption = Annotated[
    Path | None,
    typer.Option("--store", metavar="FOLDER", help="Folder of the profile store; default: the user's data folder."),
]
