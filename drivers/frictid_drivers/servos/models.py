"""What the registers of each servo are worth.

A servo's torque is never measured. Where it reports a current, torque is that times a constant; where it reports only
its PWM duty ("load"), torque is that times the stall torque, which also holds back-EMF and the supply voltage. The
constants here come from stall figures of data sheets, so they bear the stated uncertainty: a scale error common to all
torques of a joint, which no interval of a profile contains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Registers:
    """Addresses of one maker's control table; a size in bytes where it differs."""

    torque: int  # power
    goal: int  # position
    goal_bytes: int  # of it
    block: int  # first byte of what is read every cycle
    block_bytes: int  # of it
    position: tuple[int, int]  # offset in the block, and bytes
    load: int  # offset of duty; -1 where there is none
    current: int  # offset; -1 where there is none
    temperature: int  # offset; -1 outside the block
    watchdog: int  # bus watchdog; 0 where there is none
    model: int  # number and firmware are read from here
    mode: int  # operating mode
    position_mode: int  # its value for position
    return_delay: int  # of answers, in steps of 2 us
    p_gain: tuple[int, int] = (0, 0)  # proportional part of its position loop, and bytes
    i_gain: tuple[int, int] = (0, 0)  # integral part
    goal_current: int = 0  # where it takes a current; 0 where it takes none
    current_limit: int = 0  # no goal beyond it is taken
    current_mode: int = 0  # value of ``mode`` in which the goal current rules


FEETECH = Registers(40, 42, 2, 56, 15, (0, 2), 4, 13, 7, 0, 3, 33, 0, 7, (21, 1), (23, 1))
DYNAMIXEL_LOAD = Registers(64, 116, 4, 124, 12, (8, 4), 2, -1, -1, 98, 0, 11, 3, 9, (84, 2), (82, 2))
DYNAMIXEL = replace(DYNAMIXEL_LOAD, load=-1, current=2, goal_current=102, current_limit=38)


@dataclass(frozen=True, slots=True)
class Model:
    """One servo of a catalogue."""

    wire: str  # ``feetech`` or ``dynamixel``
    registers: Registers  # its table
    counts_per_turn: int = 4096  # of position
    turn_rad: float = 2 * math.pi  # what these counts span
    current_a: float = 0.0  # one step of current; 0 where only load is told
    torque_constant_nm_per_a: float = 0.0  # joint torque per ampere
    stall_nm: float = 0.0  # torque at full duty, for servos that tell load only
    uncertainty_percent: float = 30.0  # of the torque scale
    sign_magnitude: bool = False  # negative numbers have a sign bit instead of two's complement
    big_endian: bool = False  # high byte first

    @property
    def count_rad(self) -> float:
        """One step of position."""
        return self.turn_rad / self.counts_per_turn


def _sts(constant: float) -> Model:
    return Model("feetech", FEETECH, current_a=0.0065, torque_constant_nm_per_a=constant, sign_magnitude=True)


def _x(current_a: float, constant: float) -> Model:
    return Model(
        "dynamixel", DYNAMIXEL, current_a=current_a, torque_constant_nm_per_a=constant, uncertainty_percent=20.0
    )


MODELS = {
    "STS3215": _sts(0.79),  # 7.4 V: 1.9 N m at 2.4 A
    "STS3215-12V": _sts(1.09),  # 2.94 N m at 2.7 A
    "STS3250": _sts(1.2),
    "SCS15": Model(  # 1024 steps over 220 deg (one source), high byte first, no current
        "feetech",
        FEETECH,
        counts_per_turn=1024,
        turn_rad=math.radians(220.0),
        stall_nm=1.5,
        uncertainty_percent=50.0,
        sign_magnitude=True,
        big_endian=True,
    ),
    "XL330-M077": _x(0.001, 0.146),  # 0.215 N m at 1.47 A
    "XL330-M288": _x(0.001, 0.35),  # 0.52 N m at 1.47 A
    "XC330-M288": _x(0.001, 0.52),
    "XM430-W350": _x(0.00269, 1.78),  # 4.1 N m at 2.3 A
    "XM540-W150": _x(0.00269, 1.66),  # 7.3 N m at 4.4 A
    "XM540-W270": _x(0.00269, 2.4),
    "XH430-W350": _x(0.00269, 2.6),  # 3.4 N m at 1.3 A
    "XL430-W250": Model("dynamixel", DYNAMIXEL_LOAD, stall_nm=1.4, uncertainty_percent=50.0),
    "XC430-W150": Model("dynamixel", DYNAMIXEL_LOAD, stall_nm=1.6, uncertainty_percent=50.0),
}
