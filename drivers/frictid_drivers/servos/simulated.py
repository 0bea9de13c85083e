"""Servos that are not there: bytes in, bytes out, a simulated joint with its own position loop behind each.

Written against the makers' control tables; packets are taken apart here by other code than the driver's.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import replace

from frictid_drivers.servos.driver import ServoDriver
from frictid_drivers.servos.packets import WIRES
from frictid_drivers.servos.settings import JointSettings, read_settings
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Clock, WallClock
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop
from frictid_hil.testing.wire import ManualClock

_LOOP_NS = 500_000
_TORQUE_MODE = 10


class VirtualServoDriver(ServoDriver):
    """The ``servos`` driver with simulated servos on its line."""

    kind = replace(ServoDriver.kind, simulated=True, line="virtual", elsewhere={"serial": "servos"})

    def __init__(self, setup: RobotSetup) -> None:
        self.chain = Chain(setup)
        clock: Clock = WallClock() if setup.realtime else ManualClock(self.chain.advance)
        self.chain.clock = clock
        super().__init__(setup, port_factory=lambda: self.chain, clock=clock)


class Servo:
    """One servo: memory, loop and plant.

    Args:
        joint: of the robot file.
        mine: its options.
        seed: of the noise.

    Attributes:
        error: bits that it shows.
    """

    def __init__(self, joint: JointSetup, mine: JointSettings, seed: int) -> None:
        self.mine = mine
        self.plant = ServoLoop(
            JointModel.of(joint, joint.name),
            period_s=_LOOP_NS * 1e-9,
            seed=seed,
            position_rad=joint.locked_position_rad,
        )
        self.plant.set_mode(_TORQUE_MODE)
        self.plant.brake(False)
        self.memory = bytearray(256)
        registers = mine.model.registers
        self.memory[registers.model : registers.model + 2] = (777).to_bytes(2, "little")
        self.memory[registers.mode] = registers.position_mode
        self.error = 0
        self.on = False
        self._goal_rad = joint.locked_position_rad
        self._now_ns = self._heard_ns = 0

    def write(self, address: int, data: bytes) -> None:
        """Into the control table."""
        registers = self.mine.model.registers
        self.memory[address : address + len(data)] = data
        if address == registers.goal and not self._tripped():
            self._goal_rad = self.mine.direction * self._angle(self._decode(data))
        elif address == registers.torque:
            self.on = data[0] == 1 and not self.error
            self.plant.power(self.on)

    def heard(self) -> None:
        """A packet on the line."""
        self._heard_ns = self._now_ns

    def advance(self, to_ns: int) -> None:
        """Its own loop, period by period."""
        while self._now_ns + _LOOP_NS <= to_ns:
            if self._tripped() and self.on:
                self.on = False
                self.plant.power(False)
            gains, plant = self.plant.model.servo, self.plant
            # A goal comes in steps: its damping acts on the measured speed alone.
            torque_nm = gains.kp_nm_per_rad * (self._goal_rad - plant.measured_position_rad)
            torque_nm -= gains.kd_nm_s_per_rad * plant.velocity_rad_s
            plant.advance(_LOOP_NS * 1e-9, torque_nm=torque_nm if self.on else 0.0)
            self._now_ns += _LOOP_NS

    def block(self, address: int, count: int) -> bytes:
        """A stretch of the control table, as of now."""
        model, registers = self.mine.model, self.mine.model.registers
        sign = self.mine.direction
        steps = math.floor(sign * self.plant.measured_position_rad / model.count_rad + 0.5) + self.mine.zero_counts
        self._put(registers.block + registers.position[0], registers.position[1], steps, 15)
        effort = int(sign * self.plant.torque_nm / self.mine.torque_nm_per_unit) if self.on else 0
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

    def _angle(self, steps: int) -> float:
        return (steps - self.mine.zero_counts) * self.mine.model.count_rad

    def _decode(self, data: bytes) -> int:
        model = self.mine.model
        value = int.from_bytes(data, "big" if model.big_endian else "little")
        if model.sign_magnitude:
            return -(value & 0x7FFF) if value & 0x8000 else value
        return value - (1 << 8 * len(data)) if value >> (8 * len(data) - 1) else value

    def _put(self, address: int, size: int, value: int, sign_bit: int) -> None:
        model = self.mine.model
        if value < 0:
            value = -value | 1 << sign_bit if model.sign_magnitude else value + (1 << 8 * size)
        self.memory[address : address + size] = value.to_bytes(size, "big" if model.big_endian else "little")


class Chain:
    """All servos of a robot on one line, as a port of the host.

    Args:
        setup: with ``simulated`` of every joint.

    Attributes:
        fault: passed bytes and whether they go to the host; returns what becomes of them.
    """

    def __init__(self, setup: RobotSetup) -> None:
        _, settings = read_settings(setup)
        self._wire = WIRES[settings[0].model.wire]
        self._dynamixel = settings[0].model.wire == "dynamixel"
        self.clock: Clock = WallClock()
        self.servos = {
            joint.name: Servo(joint, mine, zlib.crc32(f"{setup.seed}/{setup.name}/{joint.name}".encode()))
            for joint, mine in zip(setup.joints, settings, strict=True)
        }
        self._by_id = {servo.mine.id: servo for servo in self.servos.values()}
        self._out = bytearray()
        self.fault: Callable[[bytes, bool], bytes] | None = None

    def advance(self, to_ns: int) -> None:
        """Run time goes on."""
        for servo in self.servos.values():
            servo.advance(to_ns)

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
            self._by_id[servo].write(address, body[size:])

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
            data = self._wire.answer(servo, one.error, one.block(address, count))
            self._out += data if self.fault is None else self.fault(data, True)

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
