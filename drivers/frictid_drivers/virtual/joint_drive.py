"""From one joint of a robot file to the drive that a supplier would have set up for it: plant and power-on values."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from fractions import Fraction

from frictid_drivers.virtual.objects import Key, Value, key
from frictid_drivers.virtual.personality import Personality, personality_of
from frictid_drivers.virtual.servo import Send, Servo
from frictid_hil.errors import ConfigError
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop

_RPM = 2.0 * math.pi / 60.0
_OVERSPEED = 1.5
_FOLLOWING_WINDOW_RAD = 0.05
_U16, _U32 = (1 << 16) - 1, (1 << 32) - 1


def servo_for(
    robot: RobotSetup,
    joint: JointSetup,
    plant: ServoLoop,
    send: Send,
    *,
    missing: Iterable[int] = (),  # indices of objects that it does not have
    sync_gap_tenths: int = 20,  # longest tolerated gap between SYNCs, in tenths of the period (2010h:01)
) -> Servo:
    """The drive of one joint, unpowered, its brake engaged, standing at the start position."""
    model = plant.model
    gear = Fraction(joint.gear_ratio).limit_denominator(1000)
    counts = Fraction(model.encoder.counts_per_revolution).limit_denominator(1)
    if counts <= 0:
        counts = Fraction(round(2 * math.pi * 1e6))  # a continuous encoder counts micro-radians
    per_motor_turn = counts if model.encoder.side == "motor" else counts / gear
    per_joint_turn = per_motor_turn * gear
    overrides = {
        key(0x1018, 4): zlib.crc32(f"{robot.name}/{joint.name}".encode()),
        key(0x2010, 1): sync_gap_tenths,
        **_settings(joint, model, float(per_joint_turn) / (2 * math.pi)),
    }
    for index, ratio in ((0x608F, per_motor_turn), (0x6091, gear), (0x6092, per_joint_turn)):
        overrides[key(index, 1)], overrides[key(index, 2)] = ratio.numerator, ratio.denominator
        if ratio.numerator > _U32:
            raise ConfigError(
                f"{float(ratio):g} increments do not fit a drive's 32 bits",
                where=f"joint {joint.name}: simulated.encoder",
            )

    def hold_hand(held: bool, centre_rad: float, amplitude_rad: float, frequency_hz: float) -> None:
        plant.hold_hand(
            model.hand if held else None, centre_rad=centre_rad, amplitude_rad=amplitude_rad, frequency_hz=frequency_hz
        )

    family = personality_of(joint, robot.folder) or Personality()
    return Servo(
        joint.address,
        plant,
        send,
        gear_ratio=joint.gear_ratio,
        increments_per_revolution=float(per_joint_turn),
        direction=joint.direction,
        torque_step=max(1, round(model.drive.torque_quantum_per_mille)),
        overrides=family.overrides(overrides),
        records=family.records,
        missing=missing,
        manner=family.manner_for(joint, float(per_joint_turn)),
        hold_hand=hold_hand if model.hand is not None else None,
    )


def _settings(joint: JointSetup, model: JointModel, counts_per_rad: float) -> dict[Key, Value]:
    """Filters, limits and ramps, as somebody who knew the joint has set them."""
    rated_motor_nmm = max(1, round(joint.rated_torque_nm / joint.gear_ratio * 1000.0))
    rated_nm = rated_motor_nmm / 1000.0 * joint.gear_ratio
    lowest, highest = sorted(
        joint.direction * round(limit * counts_per_rad) for limit in (joint.position_min_rad, joint.position_max_rad)
    )
    return {
        key(0x2022, 1): round(model.drive.velocity_filter_s * 1e6),
        key(0x2022, 2): round(model.drive.torque_filter_s * 1e6),
        key(0x6065): round(_FOLLOWING_WINDOW_RAD * counts_per_rad),
        key(0x6072): min(_U16, math.ceil(joint.max_torque_nm / rated_nm * 1000.0)),
        key(0x6076): rated_motor_nmm,
        key(0x607D, 1): max(-(1 << 31), lowest),
        key(0x607D, 2): min((1 << 31) - 1, highest),
        key(0x6080): math.ceil(_OVERSPEED * joint.max_velocity_rad_s * joint.gear_ratio / _RPM),
        # In units of the power-on 60A9h, rpm/s behind the gear: full speed to rest in 0.4 s and in 0.15 s.
        key(0x6084): max(1, round(joint.max_velocity_rad_s / _RPM / 0.4)),
        key(0x6085): max(1, round(joint.max_velocity_rad_s / _RPM / 0.15)),
    }
