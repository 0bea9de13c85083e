"""``frictid-hil check``: everything that can be said without moving or writing."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from typing import Any

from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import PlanRefused
from frictid_hil.jobs.plans import calibration_plan, expected_of
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Finding, JointIdentity, Severity, new_driver
from frictid_hil.runner.realtime import Latency, measure_latency


def check(robot_name: str, *, bus: str | None = None, latency_s: float = 0.0, dry: bool = False) -> dict[str, Any]:
    """Read the hardware and compare it with robot file and plan; ``dry`` looks at these two alone and opens no bus.

    ``HardwareError``: the bus or a drive cannot be reached at all. ``ConfigError``: the robot file is wrong.
    """
    robot = load_robot(robot_name)
    setup = robot.to_setup(bus)
    plan, findings = _planned(robot, setup)
    with robot.document.locating():
        driver = new_driver(robot.driver(bus), setup)
    identities: Mapping[str, JointIdentity] = {}
    if not dry:
        with closing(driver):
            with robot.document.locating():
                driver.open()
            findings.extend(driver.check(plan))
            identities = driver.identify()
    measured = None
    if latency_s:
        # In a process of its own, as the cyclic loop is, because what makes it punctual cannot be undone.
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            measured = pool.apply(measure_latency, (latency_s,))
        findings.extend(_told(measured, setup.cycle_hz))
    ok = all(finding.severity is not Severity.ERROR for finding in findings)
    return {
        "outcome": "ok" if ok else "refused",
        "exit_code": 0 if ok else 2,
        "robot": robot.name,
        "driver": robot.driver(bus),
        "bus": setup.bus,
        "ok": ok,
        "dry": dry,
        "latency": None if measured is None else asdict(measured),
        "findings": [{**_values(finding, _FINDING), "severity": finding.severity.value} for finding in findings],
        "joints": {
            name: {**_values(identity, _IDENTITY), "settings": dict(identity.settings)}
            for name, identity in identities.items()
        },
    }


_FINDING = ("severity", "subject", "message", "next_step")
_IDENTITY = ("serial", "firmware", "product", "rated_torque_nm", "gear_ratio", "torque_source")


def _values(told: object, names: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(told, name) for name in names}


def _planned(robot: Robot, setup: RobotSetup) -> tuple[Plan, list[Finding]]:
    """Make the standard plan, and the findings about it that need no hardware."""
    expected = expected_of(robot)
    plan = calibration_plan(robot, setup, {name: robot.procedure(name) for name in robot.joint_names}, expected)
    try:
        refuse_beyond_limits(plan, setup, expected)
        judged = Finding(Severity.OK, "plan", f"{len(plan.joints)} joints, {plan.duration_s:.0f} s, within limits")
    except PlanRefused as refused:
        judged = Finding(Severity.ERROR, "plan", refused.what, refused.next_step)
    unknown = [
        Finding(
            Severity.WARNING,
            f"joint {name}",
            "no `expected` inertia, gravity and friction: peak torque cannot be predicted before the first run",
            "add `expected:` to the joint in the robot file",
        )
        for name in robot.joint_names
        if name not in expected
    ]
    return plan, [judged, *unknown]


def _told(found: Latency, cycle_hz: float) -> list[Finding]:
    names = ("half of them", "99 %", "99.9 %", "the latest")
    values = (found.p50_s, found.p99_s, found.p999_s, found.worst_s)
    figures = ", ".join(f"{name} {1e3 * value:.2f} ms" for name, value in zip(names, values, strict=True))
    said = (
        f"cycles of an empty loop begin late by at most: {figures}, in {found.duration_s:g} s; it holds "
        f"{found.highest_hz} Hz"
    )
    if found.isolated_cpu is not None:
        said += f", alone on processor {found.isolated_cpu}"
    enough = found.highest_hz >= cycle_hz
    remedy = "close other programs, isolate a processor, use a real-time kernel, or lower cycle_hz in the robot file"
    own = Finding(Severity.OK if enough else Severity.WARNING, "this computer", said, "" if enough else remedy)
    return [own, *(Finding(Severity.WARNING, "this computer", told) for told in found.told)]
