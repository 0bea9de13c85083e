"""``frictid-hil emulate``: emulates a controller or drives, with the robot's simulated joints behind them."""

from __future__ import annotations

import signal
from collections.abc import Callable
from importlib.metadata import entry_points
from types import FrameType

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import UsageError

_GROUP = "frictid_hil.emulators"


def emulate(
    kind: str,
    *,
    announce: Callable[[str], None],
    robot_name: str,
    bus: str | None = None,
    **settings: object,
) -> None:
    """Serve until Ctrl-C or SIGTERM.

    Args:
        kind: name of an installed emulator (``motoman``, ``cia402``).
        announce: told the port or bus once it can be opened.
        robot_name: robot file.
        bus: ``interface:channel`` instead of the file's own.
        settings: what else this emulator takes.

    Raises:
        UsageError: no such emulator, or settings that it cannot take.
        HardwareError: the bus cannot be opened.
        ConfigError: the robot file is wrong.
    """
    installed = {point.name: point for point in entry_points(group=_GROUP)}
    if kind not in installed:
        raise UsageError(f"no emulator named {kind!r}; installed: {', '.join(sorted(installed)) or 'none'}")
    robot = load_robot(robot_name)
    setup = robot.to_setup(bus)
    serve = installed[kind].load()
    stopping = False

    def stop(_signal: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        stopping = True

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with robot.document.locating():
            serve(setup, announce=announce, stop=lambda: stopping, **settings)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
