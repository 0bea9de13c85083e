"""One axis as the controller drives it: pulses in, pulses out, a simulated joint behind.

What an application asks for passes the speed limiter, which silently drops what is too fast, and the averaging filter,
which smooths and delays, before it reaches the servo. The application therefore reads back, every tick, what was
really issued.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from frictid_hil.simulation.servo_loop import ServoLoop

_FRESH_S = 0.001  # reported torque is the mean over this last part of a tick

_POSITION_MODE = 8
_TORQUE_MODE = 10


@dataclass(frozen=True, slots=True)
class Plate:
    """What the controller knows of an axis."""

    pulses_per_rad: float  # signed; negative where positive pulses turn the joint backwards
    gear_ratio: float  # motor revolutions per joint revolution
    rated_torque_nm: float  # joint side
    lowest: int  # software limit, pulses; so is ``highest``
    highest: int
    step: int  # most pulses per tick

    @property
    def sign(self) -> float:
        """-1 where positive pulses turn the joint backwards."""
        return math.copysign(1.0, self.pulses_per_rad)


class Axis:
    """See the module's first page; ``servo`` stands unpowered, and the command is averaged over ``averaging_ticks``."""

    def __init__(self, plate: Plate, servo: ServoLoop, averaging_ticks: int = 1) -> None:
        self.plate = plate
        self.servo = servo
        self._window: deque[int] = deque(maxlen=max(1, averaging_ticks))
        self.issued = self.pulses  # command after the limiter; what an application reads back
        self._goal_rad = servo.measured_position_rad
        self.feed_forward_nm = 0.0  # joint-side torque added by the servo
        self.floating = False  # torque mode, no position loop (hand guiding)
        self._powered = False

    @property
    def pulses(self) -> int:
        """Encoder position."""
        return round(self.servo.measured_position_rad * self.plate.pulses_per_rad)

    @property
    def speed_tenths(self) -> int:
        """0.1 pulse/s."""
        return round(self.servo.velocity_rad_s * self.plate.pulses_per_rad * 10.0)

    @property
    def torque_micro(self) -> int:
        """uN m at the motor shaft, positive towards positive pulses."""
        return round(self.plate.sign * self.servo.torque_nm / self.plate.gear_ratio * 1e6)

    def power(self, on: bool) -> None:
        """Servo power; switched on, the axis holds where it stands."""
        if on == self._powered:
            return
        self._powered = on
        self._stay()
        self.feed_forward_nm = 0.0
        self.set_floating(False)
        self.servo.power(on)
        self.servo.brake(not on)

    def set_floating(self, floating: bool) -> None:
        """Let the axis be guided by hand, or hold it again where it stands."""
        if floating != self.floating:
            self.floating = floating
            self.servo.set_mode(_TORQUE_MODE if floating else _POSITION_MODE)
            self._stay()

    def ask(self, target: int, dropped: int = 0) -> int:
        """Go towards ``target`` this tick; how many pulses the limiter dropped (``dropped`` of them by a fault)."""
        wanted = target - self.issued
        step = self.plate.step
        given = max(-step, min(step, wanted))
        if dropped and given:
            given -= max(-dropped, min(dropped, given))
        self.issued += given
        return abs(wanted - given)

    def run(self, duration_s: float) -> None:
        """Let the servo follow what was issued, over one tick."""
        window = self._window
        window.append(self.issued)
        if len(window) == 1:
            window.extend([self.issued] * (window.maxlen or 1))
        goal_rad = sum(window) / len(window) / self.plate.pulses_per_rad
        # One linear approach in two portions, so that the torque of the last one is the torque of now.
        before_rad = goal_rad - (goal_rad - self._goal_rad) * _FRESH_S / duration_s
        self.servo.advance(duration_s - _FRESH_S, position_rad=before_rad, torque_offset_nm=self.feed_forward_nm)
        self.servo.advance(_FRESH_S, position_rad=goal_rad, torque_offset_nm=self.feed_forward_nm)
        self._goal_rad = goal_rad

    def rest(self, duration_s: float) -> None:
        """Let time pass without a new command."""
        self.servo.advance(duration_s, position_rad=self._goal_rad, torque_offset_nm=self.feed_forward_nm)

    def _stay(self) -> None:
        """The command becomes the position."""
        self.issued = self.pulses
        self._goal_rad = self.servo.measured_position_rad
        self._window.clear()
