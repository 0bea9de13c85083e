"""The operating mode of a servo that takes currents, and how it is changed.

Its register lies in EEPROM, which opens while the servo has no torque, and a change resets gains, profile and goal
current (ROBOTIS e-Manual, "Operating Mode"). So a change under power costs a joint its torque for one question and one
answer on the line, about 2 ms at 1 Mbit/s. What the change resets is written back.

A joint that comes under its position loop from a current may be elsewhere than it was last read, and may move. The
servo's own profile then bounds how fast it goes to its goal (e-Manual, "Profile Velocity"), until it follows goals.
"""

from __future__ import annotations

import math

from frictid_drivers.servos.line import Line
from frictid_drivers.servos.logs import to_bytes
from frictid_drivers.servos.packets import Packet
from frictid_drivers.servos.settings import JointSettings
from frictid_hil.errors import HardwareError

_RESET = ((80, 6), (88, 4), (108, 8))
"""Gains of the position loop, its feed-forward, its profile: first byte, and bytes."""
_OFF, _ON = b"\0", b"\1"
_DRIVE_MODE, _BY_TIME = 10, 4
_PROFILE, _PROFILE_RAD_S = 112, 0.229 * 2 * math.pi / 60
"""Highest speed on the way to a goal, in these steps; 0 is none. By time it is the length of the way in ms instead."""
_WAY_MS = 300


class OperatingMode:
    """The mode of one servo, in position mode now; to where it shall hold it goes no faster than ``most_rad_s``.

    Raises:
        HardwareError: it does not answer, or did not take another mode.
    """

    def __init__(self, line: Line, mine: JointSettings, most_rad_s: float) -> None:
        self._line, self._mine, self._registers = line, mine, mine.model.registers
        self._kept = {address: line.ask(mine.id, address, count) for address, count in _RESET}
        by_time = line.ask(mine.id, _DRIVE_MODE, 1)[0] & _BY_TIME
        self._slow = _WAY_MS if by_time else max(1, math.floor(most_rad_s / _PROFILE_RAD_S))
        self._slowed = False
        self.holds_positions = True  # as it was read back last

    def take_currents(self, goal: int, *, powered: bool) -> None:
        """Current mode, beginning with this goal; under power if it was."""
        self._change(self._registers.current_mode, powered)
        self.follow_current(goal)
        if powered:
            self._tell(self._registers.torque, _ON)

    def take_positions(self, goal: int | None, *, powered: bool) -> None:
        """Position mode, beginning with this goal; under power if it was and the goal is known."""
        self._change(self._registers.position_mode, powered)
        self._restore()
        if powered and goal is not None:
            self._hold(goal)

    def answered(self, packet: Packet) -> None:
        """Its answer to the question which mode it is in."""
        if packet.id == self._mine.id and len(packet.data) == 1:
            self.holds_positions = packet.data[0] == self._registers.position_mode

    def stop(self, goal: int | None) -> None:
        """Hold a position at once; waits for no answer.

        Whatever of it is lost on the line, the joint has no current that drives it: the goal current is 0 first.
        """
        self.follow_current(0)
        self._tell(self._registers.torque, _OFF)
        self._tell(self._registers.mode, bytes([self._registers.position_mode]))
        self._restore()
        if goal is not None:
            self._hold(goal)

    def follow_current(self, goal: int) -> None:
        """Another goal."""
        self._tell(self._registers.goal_current, to_bytes(goal, 2, self._mine.model))

    def follow_goals(self) -> None:
        """From now on it goes as fast as its goals, with the profile that its owner gave it."""
        for address, data in self._kept.items() if self._slowed else ():
            if address <= _PROFILE < address + len(data):
                self._tell(address, data)
        self._slowed = False

    def _hold(self, goal: int) -> None:
        """Power at a goal; wherever the joint is, it goes there slowly."""
        self._tell(_PROFILE, self._slow.to_bytes(4, "little"))
        self._slowed = True
        self._tell(self._registers.goal, to_bytes(goal, self._registers.goal_bytes, self._mine.model))
        self._tell(self._registers.torque, _ON)

    def _change(self, mode: int, powered: bool) -> None:
        if powered:
            self._tell(self._registers.torque, _OFF)
        self.holds_positions = False
        if not self._line.put(self._mine.id, self._registers.mode, bytes([mode])):
            raise HardwareError(
                f"does not take operating mode {mode}",
                where=f"servo {self._mine.id}",
                cause="it does not hear writes, or kept its torque, which locks the register",
                next_step="look at its operating mode with the maker's tool",
            )
        self.holds_positions = mode == self._registers.position_mode

    def _restore(self) -> None:
        for address, data in self._kept.items():
            self._tell(address, data)
        self._slowed = False

    def _tell(self, address: int, data: bytes) -> None:
        self._line.tell(address, {self._mine.id: data})
