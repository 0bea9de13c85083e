"""``frictid-hil emulate``: emulates a controller, with the robot's simulated joints behind it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from types import FrameType

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import UsageError

_GROUP = "frictid_hil.emulators"


def emulate(
    kind: str,
    *,
    announce: Callable[[str], None],
    robot_name: str,
    link: Path | None = None,
    faults: Sequence[str] = (),
) -> None:
    """Serve until Ctrl-C or SIGTERM.

    Args:
        kind: name of an installed emulator (``motoman``).
        announce: told the port once it can be opened.
        robot_name: robot file.
        link: name for the port, under which it also comes back after a fault.
        faults: what shall go wrong, in the emulator's words.

    Raises:
        UsageError: no such emulator, a link that cannot be, or a fault that is none.
        ConfigError: the robot file is wrong.
    """
    installed = {point.name: point for point in entry_points(group=_GROUP)}
    if kind not in installed:
        raise UsageError(f"no emulator named {kind!r}; installed: {', '.join(sorted(installed)) or 'none'}")
    robot = load_robot(robot_name)
    setup = robot.to_setup()
    serve = installed[kind].load()
    stopping = False

    def stop(_signal: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        stopping = True

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with robot.document.locating():
            serve(setup, announce=announce, link=link, faults=faults, stop=lambda: stopping)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
