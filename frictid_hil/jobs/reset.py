"""``frictid-hil reset``: resets drives that an earlier run left in fault or quick stop, without giving power."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import Any

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import PlanRefused, UsageError
from frictid_hil.protocol.driver import Finding, Resettable, new_driver


def reset(robot_name: str, *, bus: str | None = None, ask: Callable[[list[Finding]], bool]) -> dict[str, Any]:
    """Show the faults, ask, and reset (``UsageError``: no such driver; ``PlanRefused``: a no; ``HardwareError``)."""
    robot = load_robot(robot_name)
    setup = robot.to_setup(bus)
    with robot.document.locating():
        driver = new_driver(robot.driver(bus), setup)
    if not isinstance(driver, Resettable):
        raise UsageError(
            f"the {robot.driver(bus)} driver cannot reset faults",
            where=setup.bus,
            next_step="reset them at the controller",
        )
    with closing(driver):
        driver.open()
        faults = driver.faults()
        if faults and not ask(faults):
            raise PlanRefused("not confirmed; nothing was reset")
        if faults:
            driver.reset_faults()
    return {
        "outcome": "ok",
        "robot": robot.name,
        "bus": setup.bus,
        "reset": [{"subject": fault.subject, "message": fault.message} for fault in faults],
    }
