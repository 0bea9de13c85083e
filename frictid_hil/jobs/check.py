"""``frictid-hil check``: everything that can be said without moving or writing."""

from __future__ import annotations

from typing import Any

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import PlanRefused
from frictid_hil.jobs.plans import calibration_plan, expected_of
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.protocol.driver import Finding, Severity, new_driver


def check(robot_name: str, *, bus: str | None = None) -> dict[str, Any]:
    """Reach the hardware, read it, compare it with the robot file and with the standard plan.

    Args:
        robot_name: robot file.
        bus: ``interface:channel`` instead of the file's own.

    Raises:
        HardwareError: the bus or a drive cannot be reached at all.
        ConfigError: the robot file is wrong.
    """
    robot = load_robot(robot_name)
    setup = robot.to_setup(bus)
    procedures = {name: robot.procedure(name) for name in robot.joint_names}
    expected = expected_of(robot)
    plan = calibration_plan(robot, setup, procedures, expected)
    findings: list[Finding] = []
    try:
        refuse_beyond_limits(plan, setup, expected)
        findings.append(
            Finding(Severity.OK, "plan", f"{len(plan.joints)} joints, {plan.duration_s:.0f} s, within limits")
        )
    except PlanRefused as refused:
        findings.append(Finding(Severity.ERROR, "plan", refused.what, refused.next_step))
    for name in procedures:
        if name not in expected:
            findings.append(
                Finding(
                    Severity.WARNING,
                    f"joint {name}",
                    "no `expected` inertia, gravity and friction: peak torque cannot be predicted before the first run",
                    "add `expected:` to the joint in the robot file",
                )
            )
    with robot.document.locating():
        driver = new_driver(robot.driver(bus), setup)
    identities = {}
    try:
        with robot.document.locating():
            driver.open()
        findings.extend(driver.check(plan))
        identities = driver.identify()
    finally:
        driver.close()
    ok = all(finding.severity is not Severity.ERROR for finding in findings)
    return {
        "outcome": "ok" if ok else "refused",
        "exit_code": 0 if ok else 2,
        "robot": robot.name,
        "driver": robot.driver(bus),
        "bus": setup.bus,
        "ok": ok,
        "findings": [
            {
                "severity": finding.severity.value,
                "subject": finding.subject,
                "message": finding.message,
                "next_step": finding.next_step,
            }
            for finding in findings
        ],
        "joints": {
            name: {
                "serial": identity.serial,
                "firmware": identity.firmware,
                "product": identity.product,
                "rated_torque_nm": identity.rated_torque_nm,
                "gear_ratio": identity.gear_ratio,
                "torque_source": identity.torque_source,
                "settings": dict(identity.settings),
            }
            for name, identity in identities.items()
        },
    }
