"""Servos that are not there: bytes in, bytes out, a simulated joint with its own position loop behind each.

Written against the makers' control tables; packets are taken apart here by other code than the driver's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from frictid_drivers.servos import faulty_chain
from frictid_drivers.servos.driver import ServoDriver
from frictid_drivers.servos.packets import WIRES
from frictid_drivers.servos.settings import JointSettings, read_settings
from frictid_drivers.virtual.devices import LOOP_S, Device, without_faults
from frictid_drivers.virtual.faults import faults_of
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Clock, WallClock
from frictid_hil.testing.wire import ManualClock

_EEPROM_END = 64
_PROFILE, _PROFILE_RAD_S = 112, 0.023981  # of a Dynamixel: speed of the way to a goal; 0 is at once
_ACCESS, _RANGE, _LIMIT = 7, 4, 6  # errors of protocol 2.0
_P_GAIN = {"feetech": 32, "dynamixel": 400}  # with it the loop has the gains of the robot file


class VirtualServoDriver(ServoDriver):
    """The ``servos`` driver with simulated servos on its line."""

    kind = replace(ServoDriver.kind, simulated=True, line="virtual", elsewhere={"serial": "servos"})

    def __init__(self, setup: RobotSetup) -> None:
        faults = faults_of(setup, kinds=faulty_chain.KINDS, frames=faulty_chain.FRAMES)
        setup = without_faults(setup)
        self.chain = Chain(setup)
        self._faulty = faulty_chain.FaultyChain(self.chain, faults) if faults else None
        port = self._faulty or self.chain
        self.chain.clock = WallClock() if setup.realtime else ManualClock(port.advance)
        super().__init__(setup, port_factory=lambda: port, clock=self.chain.clock)

    def start_cycling(self) -> None:
        """As ``ServoDriver``; times of faults count from here."""
        super().start_cycling()
        if self._faulty is not None:
            self._faulty.begin()

    def simulate_hand(self, joint: str, centre_rad: float, amplitude_rad: float, frequency_hz: float) -> None:
        """Let a person guide a joint along centre + amplitude sin(2 pi f t), t from now; frequency 0 lets go."""
        plant = self.chain.servos[joint].plant
        plant.hold_hand(
            plant.model.hand if frequency_hz > 0.0 else None,
            centre_rad=centre_rad,
            amplitude_rad=amplitude_rad,
            frequency_hz=frequency_hz,
        )


class Servo(Device):
    """One servo: memory, loop and plant; ``error`` has the bits that it shows."""

    def __init__(self, joint: JointSetup, setup: RobotSetup, mine: JointSettings) -> None:
        super().__init__(joint, setup)
        self.mine = mine
        self.memory = bytearray(256)
        registers = mine.model.registers
        self.memory[registers.model : registers.model + 2] = (777).to_bytes(2, "little")
        self.memory[registers.mode] = registers.position_mode
        self._put(*registers.p_gain, _P_GAIN[mine.model.wire])
        if registers.goal_current:
            self._put(registers.current_limit, 2, 1750 if mine.model.current_a < 0.002 else 1193)
        self.error = 0
        self._goal_rad = self._way_rad = joint.locked_position_rad
        self._delivered = bytes(self.memory)

    def told(self, quantity: str) -> float:
        """What it measures: ``position`` in rad or ``torque`` in N m."""
        return self.plant.measured_position_rad if quantity == "position" else self.plant.torque_nm

    def reboot(self) -> None:
        """As after a power failure: no torque, and everything that is not in its EEPROM is forgotten."""
        begin = _EEPROM_END if self.mine.model.wire == "dynamixel" else self.mine.model.registers.torque
        self.memory[begin:] = self._delivered[begin:]
        self.error = 0
        self._switch(False)

    def fail(self) -> None:
        """Overload: it shows so, and lets go."""
        self.error = 0x80 if self.mine.model.wire == "dynamixel" else 0x20
        self._switch(False)

    def write(self, address: int, data: bytes) -> int:
        """Into the control table; returns the error with which it is refused, 0 where it is taken."""
        registers = self.mine.model.registers
        refused = self._refusal(address, data)
        if refused:
            return refused
        changed = address == registers.mode and data[0] != self.memory[address]
        self.memory[address : address + len(data)] = data
        if address == registers.goal:
            self._goal_rad = self.mine.position_rad(self._decode(data))
        elif address == registers.torque:
            self._switch(data[0] == 1 and not self.error)
        elif changed and registers.goal_current:
            # e-Manual, Operating Mode: gains, profile and goal current are reset.
            self._put(*registers.p_gain, _P_GAIN[self.mine.model.wire])
            self.memory[registers.goal_current : registers.goal_current + 2] = self._limit()
            self.memory[108:116] = bytes(8)
        return 0

    def _switch(self, on: bool) -> None:
        if on and not self.on:
            self._way_rad = self.plant.measured_position_rad
        self.on = on
        self.plant.power(on)

    def _refusal(self, address: int, data: bytes) -> int:
        """EEPROM opens without torque alone, a tripped watchdog keeps goals, a current has a limit."""
        registers = self.mine.model.registers
        if self.mine.model.wire != "dynamixel":
            return 0
        if address < _EEPROM_END and self.on:
            return _ACCESS
        if address in (registers.goal, registers.goal_current) and self._tripped():
            return _RANGE
        if registers.goal_current and address == registers.goal_current:
            return _LIMIT if abs(self._decode(data)) > int.from_bytes(self._limit(), "little") else 0
        return 0

    def _limit(self) -> bytes:
        at = self.mine.model.registers.current_limit
        return bytes(self.memory[at : at + 2])

    def _watch_host(self) -> None:
        if self._tripped() and self.on:
            self._switch(False)

    def _asked_nm(self) -> float:
        """Its current times its constant in current mode, else what its position loop wants."""
        registers, gains, plant = self.mine.model.registers, self.plant.model.servo, self.plant
        if registers.goal_current and self.memory[registers.mode] == registers.current_mode:
            goal = self._decode(bytes(self.memory[registers.goal_current : registers.goal_current + 2]))
            return self.mine.direction * goal * self.mine.torque_nm_per_unit
        at, size = registers.p_gain
        share = int.from_bytes(self.memory[at : at + size], self._order) / _P_GAIN[self.mine.model.wire]
        # A goal comes in steps: its damping acts on the measured speed alone.
        torque_nm = share * gains.kp_nm_per_rad * (self._on_its_way() - plant.measured_position_rad)
        return torque_nm - gains.kd_nm_s_per_rad * plant.velocity_rad_s

    def _on_its_way(self) -> float:
        """Where its position loop is now: at the goal, or by its profile on the way there."""
        rest_rad, steps = self._goal_rad - self._way_rad, 0
        if self.mine.model.wire == "dynamixel":
            steps = int.from_bytes(self.memory[_PROFILE : _PROFILE + 4], self._order)
        most_rad = steps * _PROFILE_RAD_S * LOOP_S if steps else math.inf
        self._way_rad += min(max(rest_rad, -most_rad), most_rad)
        return self._way_rad

    def block(self, address: int, count: int) -> bytes:
        """A stretch of the control table, as of now."""
        model, registers = self.mine.model, self.mine.model.registers
        sign = self.mine.direction
        steps = math.floor(sign * self.told("position") / model.count_rad + 0.5) + self.mine.zero_counts
        self._put(registers.block + registers.position[0], registers.position[1], steps, 15)
        effort = int(sign * self.told("torque") / self.mine.torque_nm_per_unit) if self.on else 0
        if registers.load >= 0:
            load = effort if not model.current_a else max(-1000, min(1000, effort))
            self._put(registers.block + registers.load, 2, load, 10)
        if registers.current >= 0 and model.current_a:
            self._put(registers.block + registers.current, 2, abs(effort) if registers.load >= 0 else effort, 15)
        if registers.temperature >= 0:
            self.memory[registers.block + registers.temperature] = 33
        return bytes(self.memory[address : address + count])

    def _tripped(self) -> bool:
        """The bus watchdog: 1-127 times 20 ms, acts with torque on; -1 once it has."""
        at = self.mine.model.registers.watchdog
        if not at:
            return False
        value = self.memory[at]
        if 0 < value < 128 and self.on and self._now_ns - self._heard_ns > value * 20_000_000:
            self.memory[at] = 255
        return self.memory[at] == 255

    @property
    def _order(self) -> Literal["big", "little"]:
        return "big" if self.mine.model.big_endian else "little"

    def _decode(self, data: bytes) -> int:
        model = self.mine.model
        value = int.from_bytes(data, self._order)
        if model.sign_magnitude:
            return -(value & 0x7FFF) if value & 0x8000 else value
        return value - (1 << 8 * len(data)) if value >> (8 * len(data) - 1) else value

    def _put(self, address: int, size: int, value: int, sign_bit: int = 15) -> None:
        model = self.mine.model
        if value < 0:
            value = -value | 1 << sign_bit if model.sign_magnitude else value + (1 << 8 * size)
        self.memory[address : address + size] = value.to_bytes(size, self._order)


class Chain:
    """All servos of a robot on one line, as a port of the host."""

    def __init__(self, setup: RobotSetup) -> None:
        _, settings = read_settings(setup)
        self.wire = WIRES[settings[0].model.wire]
        self._dynamixel = settings[0].model.wire == "dynamixel"
        self.clock: Clock = WallClock()
        self.servos = {
            joint.name: Servo(joint, setup, mine) for joint, mine in zip(setup.joints, settings, strict=True)
        }
        self._by_id = {servo.id: servo for servo in self.servos.values()}
        self._out = bytearray()
        # Passed bytes and whether they go to the host; returns what becomes of them.
        self.fault: Callable[[bytes, bool], bytes] | None = None

    def advance(self, to_ns: int) -> None:
        """Run time goes on."""
        for servo in self.servos.values():
            servo.advance(to_ns)

    def connect(self, joint: str, there: bool) -> None:
        """Put a servo on the line, or take it off; it goes on either way."""
        servo = self.servos[joint]
        if there:
            self._by_id[servo.id] = servo
        else:
            self._by_id.pop(servo.id, None)

    def write(self, data: bytes) -> None:
        """The host's bytes: one packet at a time, as on a half-duplex line."""
        self._go_on()
        data = data if self.fault is None else self.fault(data, False)
        told = self._instruction(data)
        if told is None:
            return
        servo, code, body = told
        for each in self._by_id.values():
            each.heard()
        size = 2 if self._dynamixel else 1
        address = int.from_bytes(body[:size], "little")
        count = int.from_bytes(body[size : 2 * size], "little")
        if code == 0x83:
            rest = body[2 * size :]
            for k in range(0, len(rest), count + 1):
                if rest[k] in self._by_id:
                    self._by_id[rest[k]].write(address, rest[k + 1 : k + 1 + count])
        elif code == 0x82:
            for one in body[2 * size :]:
                self._answer(one, address, count)
        elif code == 0x02:
            self._answer(servo, address, count)
        elif code == 0x03 and servo in self._by_id:
            self._say(servo, self._by_id[servo].write(address, body[size:]), b"")

    def read(self, timeout_s: float) -> bytes:
        """Answers to the host."""
        self._go_on()
        data, self._out = bytes(self._out), bytearray()
        if not data and timeout_s > 0.0:
            self.clock.wait_until(self.clock.now_ns() + round(timeout_s * 1e9))
        return data

    def close(self) -> None:
        """The host is gone; the servos stay as they are."""

    def _go_on(self) -> None:
        if not self.clock.lock_step:
            self.advance(self.clock.now_ns())

    def _answer(self, servo: int, address: int, count: int) -> None:
        if servo in self._by_id:
            one = self._by_id[servo]
            self._say(servo, one.error, one.block(address, count))

    def _say(self, servo: int, error: int, data: bytes) -> None:
        packet = self.wire.answer(servo, error, data)
        self._out += packet if self.fault is None else self.fault(packet, True)

    def _instruction(self, data: bytes) -> tuple[int, int, bytes] | None:
        """Id, code and parameters; None for what is damaged."""
        if self._dynamixel:
            if len(data) < 10 or data[:4] != b"\xff\xff\xfd\x00" or len(data) != 7 + (data[5] | data[6] << 8):
                return None
            crc = 0
            for byte in data[:-2]:
                crc ^= byte << 8
                for _ in range(8):
                    crc = (crc << 1 ^ 0x18005) if crc & 0x8000 else crc << 1
            body = data[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
            return (data[4], data[7], body) if crc == data[-2] | data[-1] << 8 else None
        if len(data) < 6 or data[:2] != b"\xff\xff" or len(data) != data[3] + 4:
            return None
        return (data[2], data[4], data[5:-1]) if (sum(data[2:]) & 0xFF) == 0xFF else None
