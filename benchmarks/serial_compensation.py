"""Friction compensated by a table on the serial controller, against the same law over CAN with the same delay.

    python benchmarks/serial_compensation.py [JOINT ...]       (about a minute of processor time for six joints)

Over CAN it is the product's own ``calibrate`` and ``compensate`` on the virtual drives at 250 Hz: encoder and velocity
of SYNC k, torque from SYNC k + 1 on. The table holds the curve of that same profile, with the ratio R, the stiffness K
and the gravity that the CAN run used, and acts on the emulated controller's tick - one tick late, as over CAN, and
without any delay. The same simulated person swings the joint 20 deg to either side at 0.5 Hz about the same place. What
is compared is how much less torque that person needs, F_s of (25), than with gravity alone; the first cycle is not
counted.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from command_line import call

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.emulator.build import build
from frictid_drivers.motoman.emulator.loopback import LoopbackPort
from frictid_hil.config.profile import JointProfile, load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.plan import Hold, JointPlan, Motion, Move
from frictid_hil.simulation.servo_loop import ServoLoop

LIMIT_POINTS = 3.0
TICK_S, SECONDS, NOT_COUNTED_S = 0.004, 12.0, 2.0
ROBOT = "hp3j-250.yaml"
CAN = """\
schema: frictid.robot/1
extends: hp3j.yaml
name: hp3j-250
bus: virtual:hp3j-250
cycle_hz: 250
"""


def felt_nm(
    joint: str, motions: Sequence[Motion], curve: FrictionCurve, *, delay_ms: float, **table: float
) -> list[float]:
    """What the person gives at each tick of the emulated controller while the table is in force.

    Args:
        joint: name.
        motions: the last but one is guided.
        curve: phi.
        delay_ms: by which the table acts late.
        table: ratio, stiffness and gravity, as ``download_table`` takes them.
    """
    setup = load_robot("hp3j-serial.yaml").to_setup("serial:loopback")
    setup = replace(setup, options={**setup.options, "emulator": {"table_delay_ms": delay_ms}})
    emulator = build(setup)
    driver = MotomanDriver(setup, port_factory=lambda path, baud, parity: LoopbackPort(emulator, baud, parity))
    axis = emulator.axes[setup.joint(joint).address]
    felt: list[float] = []
    move_on = axis.run

    def feel(duration_s: float) -> None:
        move_on(duration_s)
        if axis.floating:
            assert isinstance(axis.servo, ServoLoop)
            felt.append(axis.servo.external_torque_nm)

    with patch.object(axis, "run", feel):
        driver.open()
        driver.download_table(joint, curve, **table)
        driver.compensate_by_table([joint])
        driver.run_batch(JointPlan(joint, tuple(motions), {}))
        driver.close()
    return felt


def effort_nm(joint: str, entry: JointProfile, run: dict[str, Any], ratio: float, delay_ms: float) -> float:
    """What the person needs with this table."""
    geometry = load_robot("hp3j-serial.yaml").to_setup("serial:loopback").joint(joint)
    home = geometry.locked_position_rad
    centre = geometry.start_position_rad + (entry.procedure.amplitude_rad if entry.procedure else 0.0) / 2
    motions: list[Motion] = [] if math.isclose(home, centre) else [Move.within(home, centre, 0.2)]
    motions += [Hold(centre, 0.5), Hold(centre, SECONDS, name="guided"), Hold(centre, 0.1)]
    felt = felt_nm(
        joint,
        motions,
        entry.curve(),
        delay_ms=delay_ms,
        ratio=ratio,
        stiffness_nm_per_rad=run["stiffness_nm_per_rad"],
        gravity_cos_nm=entry.gravity_cos_nm.value or 0.0,
        gravity_sin_nm=entry.gravity_sin_nm.value or 0.0,
    )
    return rms_nm(felt, NOT_COUNTED_S)


def rms_nm(felt: Sequence[float], not_counted_s: float) -> float:
    """F_s of (25) of what is felt once the swing has settled."""
    counted = felt[round(not_counted_s / TICK_S) :]
    return math.sqrt(sum(torque * torque for torque in counted) / len(counted))


def profile_over_can(joints: Sequence[str], folder: Path) -> Path:
    """The 250 Hz robot, calibrated; its profile."""
    (folder / ROBOT).write_text(CAN)
    run = folder / "run"
    call("calibrate", "--robot", str(folder / ROBOT), *(f"--joint={joint}" for joint in joints), "--out", str(run))
    return run / "profile.yaml"


def reductions(
    joint: str, profile: Path, folder: Path, delays_ms: Sequence[float]
) -> tuple[dict[str, Any], list[float]]:
    """The CAN run's JSON, and by how many percent the table lessens the effort with each of these delays."""
    can = call(
        *("compensate", "--robot", str(folder / ROBOT), "--profile", str(profile), "--joint", joint),
        *("--task", "hand", "--mode", "nc,mop", "--out", str(folder / f"hand-{joint}")),
    )
    entry, ratio = load_profile(profile).joint(joint), can["compensation_ratio"]
    less = [
        100 * (1 - effort_nm(joint, entry, can, ratio, delay_ms) / effort_nm(joint, entry, can, 0.0, delay_ms))
        for delay_ms in delays_ms
    ]
    return can, less


def main() -> int:
    """0 when every joint is within the bar with the same delay."""
    joints = sys.argv[1:] or list("012345")
    print("| joint | R | K [N m/rad] | CAN, 250 Hz | table, one tick late | difference | table, no delay |")
    print("|---|---|---|---|---|---|---|")
    within = True
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        profile = profile_over_can(joints, folder)
        for joint in joints:
            can, (late, at_once) = reductions(joint, profile, folder, (1e3 * TICK_S, 0.0))
            over_can = can["modes"]["mop"]["reduction_percent"]
            within = within and abs(late - over_can) <= LIMIT_POINTS
            print(
                f"| {joint} | {can['compensation_ratio']:g} | {can['stiffness_nm_per_rad']:.0f} | {over_can:.1f} % "
                f"| {late:.1f} % | {late - over_can:+.1f} | {at_once:.1f} % |",
                flush=True,
            )
    return 0 if within else 1


if __name__ == "__main__":
    sys.exit(main())
