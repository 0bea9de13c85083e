"""What host and batch application tell each other: greeting, job, its state, friction table.

The data of a BSC block may hold no control codes, so binary travels as base64 text.
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from frictid_drivers.motoman.joint_units import AxisUnits
from frictid_drivers.motoman.stream_frames import crc16
from frictid_hil.friction.curve import FrictionCurve

TABLE_POINTS: Final = 21


@dataclass(frozen=True, slots=True)
class BatchHello:
    """What the batch application says of itself."""

    tick_us: int  # interpolation clock
    axes: int  # how many it has
    most_ticks: int  # longest job
    torque_measured: bool  # feedback torque is measured, not commanded
    averaging_ms: int | None  # moving average on the command, None where it does not know
    table_points: int  # points of a friction table, 0 where it cannot compensate
    name: str  # of the application
    reads_while_running: bool = False  # it hands over what is recorded already while the job runs


@dataclass(frozen=True, slots=True)
class JobOrder:
    """One job of one axis; positions and bounds in pulses."""

    number: int  # 1..65535, to tell it from the job before
    axis: int
    start: int  # where it begins; the axis must stand there
    lowest: int
    highest: int
    step: int  # most pulses per tick
    torque_micro: int  # torque limit at the motor shaft, uN m
    watchdog_ticks: int  # ticks without a word from the host after which it stops
    segments: Sequence[str]  # see ``motion_segments``

    def text(self) -> str:
        """The FJOB command, with its CRC over everything up to and including the last comma."""
        *figures, segments = astuple(self)
        covered = f"FJOB 1,{','.join(map(str, [*figures, *segments]))},"
        return f"{covered}{crc16(covered.encode('ascii')):04X}"


@dataclass(frozen=True, slots=True)
class JobState:
    """The reply to FSTAT."""

    number: int
    state: int
    done_ticks: int
    total_ticks: int
    alarm: int
    reason: int
    velocity_shift: int
    torque_shift: int
    dropped_pulses: int


def friction_table(
    units: AxisUnits,
    curve: FrictionCurve,
    ratio: float,
    stiffness_nm_per_rad: float,
    gravity_cos_nm: float,
    gravity_sin_nm: float,
) -> str:
    """One axis's compensation, base64 with its CRC; see ``download_table``.

    The curve is given at 21 equal steps of speed from standstill to the fastest identified one, in the controller's
    units: torque in uN m at the motor shaft, positions in pulses, speed in 0.1 pulse/s, stiffness in nN m per pulse.
    """
    pulses_per_rad = abs(units.pulses_per_rad)
    fastest_rad_s = curve.measured_range_rad_s[1]
    step_tenths = max(1, round(fastest_rad_s / (TABLE_POINTS - 1) * pulses_per_rad * 10.0))
    speeds_rad_s = np.arange(TABLE_POINTS) * step_tenths * 0.1 / pulses_per_rad
    stiffness_nano = max(1, round(stiffness_nm_per_rad / units.gear_ratio / pulses_per_rad * 1e9))
    raw = struct.pack(
        f"<BBHIIIii{TABLE_POINTS}i",
        *(units.axis, TABLE_POINTS, round(ratio * 1e4), step_tenths, stiffness_nano),
        round(2 * math.pi * pulses_per_rad),
        # Where positive pulses turn the joint backwards, torque and angle change sign: cosine flips, sine stays.
        *(units.motor_micro(gravity_cos_nm) * units.direction, units.motor_micro(gravity_sin_nm)),
        *(units.motor_micro(float(torque)) for torque in curve.magnitude(speeds_rad_s)),
    )
    return base64.b64encode(raw + crc16(raw).to_bytes(2, "little")).decode("ascii")
