"""``frictid-hil emulate``: emulates a controller or drives, with the robot's simulated joints behind them."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from threading import Event

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import UsageError
from frictid_hil.runner.stop_signals import handling_signals

_GROUP = "frictid_hil.emulators"


def emulate(
    kind: str,
    *,
    announce: Callable[[str], None],  # told the port or bus once it can be opened
    robot_name: str,
    bus: str | None = None,
    **settings: object,  # what else this emulator takes
) -> None:
    """Serve until Ctrl-C or SIGTERM (``UsageError``: no such emulator; ``HardwareError``, ``ConfigError``)."""
    installed = {point.name: point for point in entry_points(group=_GROUP)}
    if kind not in installed:
        raise UsageError(f"no emulator named {kind!r}; installed: {', '.join(sorted(installed)) or 'none'}")
    robot = load_robot(robot_name)
    setup = robot.to_setup(bus)
    serve = installed[kind].load()
    stopping = Event()
    with handling_signals(lambda *_: stopping.set()), robot.document.locating():
        serve(setup, announce=announce, stop=stopping.is_set, **settings)
