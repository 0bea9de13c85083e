"""MIT-mode actuators that are not there: frames in, frames out, a simulated joint behind each.

Written against the makers' frame tables and not against the driver: the two share no codec, only the catalogue of
ranges. Numbers are truncated on the way out, as the makers' firmware does. The torque is the mean of what was applied,
with the plant's noise, in the 12 or 16 bits of the family.

Of the faults of ``virtual.faults``, ``frames`` is ``command`` or ``report`` here, ``level`` is in rad, rad/s or N m,
and ``at_s`` counts from the first cycle.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import can

from frictid_drivers.mit.driver import MitDriver
from frictid_drivers.mit.frames import Ranges
from frictid_drivers.mit.settings import JointSettings, read_settings
from frictid_drivers.virtual.devices import DEVICE_KINDS, Device, DeviceFaults, without_faults
from frictid_drivers.virtual.faults import HOST_KINDS, Fault, faults_of
from frictid_drivers.virtual.faulty_bus import FaultyBus
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import FD_FRAME, Clock, WallClock
from frictid_hil.testing.wire import Devices, FakeCanBus, Frame, ManualClock

FRAMES = ("command", "report")
KINDS = (*DEVICE_KINDS, *HOST_KINDS)
_FAULT = 0xA
_LONG_ID = 1 << 31
_SERVICE_PORT = 0x7FF


class VirtualMitDriver(MitDriver):
    """The ``mit`` driver with simulated actuators on its bus."""

    kind = replace(MitDriver.kind, simulated=True, line="virtual", elsewhere={"can": "mit"})

    def __init__(self, setup: RobotSetup) -> None:
        faults = faults_of(setup, kinds=KINDS, frames=FRAMES)
        setup = without_faults(setup)
        self.rack = Rack(setup)
        self._begin: list[Callable[[], None]] = []
        motors: Devices = self.rack
        if faults:
            motors = faulty = FaultyMotors(self.rack, faults)
            self._begin.append(faulty.begin)
        clock: Clock = WallClock() if setup.realtime else ManualClock(motors.advance)

        def open_bus() -> can.BusABC:
            bus = FakeCanBus(motors, clock)
            ours = [fault for fault in faults if fault.kind in HOST_KINDS]
            if not ours:
                return bus
            spoilt = FaultyBus(
                bus,
                ours,
                now_ns=clock.now_ns,
                stand_still=lambda lasts_s: clock.wait_until(clock.now_ns() + round(lasts_s * 1e9)),
            )
            self._begin.append(spoilt.begin)
            return spoilt

        super().__init__(setup, bus_factory=open_bus, clock=clock)

    def start_cycling(self) -> None:
        """As ``MitDriver``; times of faults count from here."""
        super().start_cycling()
        for begin in self._begin:
            begin()

    def mount_payload(self, joint: str, mounted: bool) -> None:
        """Put the payload of the robot file on a joint, or take it off."""
        self.rack.actuators[joint].plant.mount_payload(mounted)


class Actuator(Device):
    """One motor: its control law, its plant, its memory and its watchdog."""

    def __init__(self, joint: JointSetup, setup: RobotSetup, ranges: Ranges) -> None:
        super().__init__(joint, setup)
        self.ranges, self.direction = ranges, joint.direction
        self.fault = 0  # code that it shows; 0 when healthy
        self.timeout_ns = 0  # without a command for so long it lets go; 0 for never
        self.asked = (0.0, 0.0, 0.0, 0.0, 0.0)  # position, velocity, kp, kd, torque in force

    def switch(self, on: bool) -> None:
        """Power; a fault keeps it off."""
        self.on = on and not self.fault
        self.asked = (0.0, 0.0, 0.0, 0.0, 0.0)
        self.plant.power(self.on)

    def _watch_host(self) -> None:
        if self.on and self.timeout_ns and self._now_ns - self._heard_ns > self.timeout_ns:
            self.fault = 0xD
            self.switch(False)

    def _asked_nm(self) -> float:
        p, v, kp, kd, t = self.asked
        torque, most = kp * (p - self.position) + kd * (v - self.velocity) + t, self.ranges.torque_nm
        return self.direction * min(max(torque, -most), most)

    @property
    def position(self) -> float:
        """In the motor's direction."""
        return self.direction * self.plant.measured_position_rad

    @property
    def velocity(self) -> float:
        """In the motor's direction."""
        return self.direction * self.plant.velocity_rad_s

    @property
    def torque(self) -> float:
        """In the motor's direction, as it believes."""
        return self.direction * self.plant.torque_nm

    def told(self, quantity: str) -> float:
        """As ``Device.told``, in the motor's direction."""
        value: float = getattr(self, quantity)
        return value


Wire = Callable[[Actuator, int, bytes], list[Frame] | None]
"""How one family speaks: what a motor answers to a frame; None where it is not meant for this motor."""


class Rack:
    """All actuators of a robot on one bus."""

    def __init__(self, setup: RobotSetup) -> None:
        self.actuators: dict[str, Actuator] = {}
        self._wires: list[tuple[Actuator, Wire]] = []
        bus, settings = read_settings(setup)
        for joint in setup.joints:
            mine = settings[joint.name]
            self.actuators[joint.name] = actuator = Actuator(joint, setup, mine.motor.ranges)
            serial = zlib.crc32(f"{setup.name}/{joint.name}".encode())
            self._wires.append((actuator, _wire_of(mine, serial, bus.rates.data)))

    def receive(self, can_id: int, data: bytes) -> Iterable[Frame]:
        """A frame of the host; the answer of the motor that it is meant for."""
        for actuator, wire in self._wires:
            answer = wire(actuator, can_id, data)
            if answer is not None:
                actuator.heard()
                return answer
        return []

    def meant(self, can_id: int, data: bytes) -> str | None:
        """The joint whose motor a frame of the host is for; None for nobody's."""
        number = can_id & 0xFF if can_id & _LONG_ID else can_id & 0x7FF
        if number == _SERVICE_PORT and not can_id & _LONG_ID:
            number = int.from_bytes(data[:2], "little")
        return next((name for name, actuator in self.actuators.items() if actuator.id == number), None)

    def advance(self, to_ns: int) -> None:
        """Run time goes on."""
        for actuator in self.actuators.values():
            actuator.advance(to_ns)


class FaultyMotors(DeviceFaults):
    """Motors whose wire, reports and power fail by a schedule; to the bus they look like any ``Rack``."""

    def __init__(self, rack: Rack, faults: Sequence[Fault]) -> None:
        super().__init__(faults, rack.actuators, rack.advance)
        self._rack, self._answers = rack, list[Frame]()
        self._muted: set[str] = set()
        strangers = [fault for fault in faults if fault.kind == "foreign" and fault.frames == "command"]
        self._commanded_by_others = {joint for fault in strangers for joint in fault.joints}

    def receive(self, can_id: int, data: bytes) -> Iterable[Frame]:
        """A frame of the host; what comes back now, and what was late and has come meanwhile."""
        joint = self._rack.meant(can_id, data)
        if joint is not None and joint not in self._muted:
            for number, (due_ns, out_id, out) in enumerate(self._spoilt("command", joint, can_id, data)):
                self._at(due_ns, partial(self._to_motor, joint, out_id, out))
                if number and joint in self._commanded_by_others:
                    # Whoever sent it, the host hears it as well as the motor.
                    self._at(due_ns, partial(self._answers.append, (out_id, out)))
        answers = list(self._answers)
        self._answers.clear()
        return answers

    def _to_motor(self, joint: str, can_id: int, data: bytes) -> None:
        for answer in self._rack.receive(can_id, data):
            for due_ns, out_id, out in self._spoilt("report", joint, *answer) if joint not in self._muted else ():
                self._at(due_ns, partial(self._answers.append, (out_id, out)))

    def _switch(self, fault: Fault, joint: str, on: bool) -> None:
        motor = self._rack.actuators[joint]
        match fault.kind:
            case "mute":
                (self._muted.add if on else self._muted.discard)(joint)
            case "blocked":
                motor.plant.brake(on)
            case "reset" if on:
                motor.fault, motor.timeout_ns = 0, 0
                motor.switch(False)
            case "fault" if on:
                motor.fault = _FAULT
                motor.switch(False)


def _wire_of(settings: JointSettings, serial: int, data_bitrate: int | None) -> Wire:
    name, reply_id = settings.family.name, settings.motor.reply_id
    if name == "damiao":
        rate = {None: 4, 2_000_000: 5, 2_500_000: 6, 3_200_000: 7, 4_000_000: 8, 5_000_000: 9}[data_bitrate]
        return _DamiaoWire(settings.motor.ranges, reply_id, serial, rate)
    if name in ("robstride", "cybergear"):
        return _RobStrideWire(reply_id, 0x200C if name == "cybergear" else 0x7028)
    return _PlainWire(reply_id, deci=name == "robstride-mit")


def _to_bits(value: float, end: float, bits: int) -> int:
    full = (1 << bits) - 1
    return max(0, min(full, int((value + end) * full / (2 * end))))


def _from_bits(number: int, low: float, high: float, bits: int) -> float:
    return number * (high - low) / ((1 << bits) - 1) + low


def _mit_command(motor: Actuator, data: bytes) -> None:
    """As in the table: p 16, v 12, kp 12, kd 12, t 12 bits; the four special frames."""
    if data[:7] == b"\xff" * 7 and data[7] in (0xFB, 0xFC, 0xFD):
        if data[7] == 0xFB:
            motor.fault = 0
        else:
            motor.switch(data[7] == 0xFC)
        return
    word = int.from_bytes(data, "big")
    _ask(motor, word >> 48, *(word >> at & 0xFFF for at in (36, 24, 12, 0)), bits=12)


def _ask(motor: Actuator, p: int, v: int, kp: int, kd: int, t: int, *, bits: int) -> None:
    r = motor.ranges
    motor.asked = (
        _from_bits(p, -r.position_rad, r.position_rad, 16),
        _from_bits(v, -r.velocity_rad_s, r.velocity_rad_s, bits),
        _from_bits(kp, 0.0, r.kp_nm_per_rad, bits),
        _from_bits(kd, 0.0, r.kd_nm_s_per_rad, bits),
        _from_bits(t, -r.torque_nm, r.torque_nm, bits),
    )


def _told(motor: Actuator, bits: int) -> tuple[int, int, int]:
    return (
        _to_bits(motor.told("position"), motor.ranges.position_rad, 16),
        _to_bits(motor.told("velocity"), motor.ranges.velocity_rad_s, bits),
        _to_bits(motor.told("torque"), motor.ranges.torque_nm, bits),
    )


def _mit_report(motor: Actuator, first: int) -> bytes:
    p, v, t = _told(motor, 12)
    return bytes([first, p >> 8, p & 255, v >> 4, (v & 15) << 4 | t >> 8, t & 255])


class _DamiaoWire:
    """Register numbers and status nibble as in the J4310 manual.

    It hears classical and CAN FD frames alike, and answers in FD ones where register 35 says more than 1 Mbit/s (codes
    5 to 9), else in classical ones: both ways were reported.
    """

    def __init__(self, ranges: Ranges, reply_id: int, serial: int, rate: int) -> None:
        self._reply_id = reply_id
        self._floats = {21: ranges.position_rad, 22: ranges.velocity_rad_s, 23: ranges.torque_nm}
        self._words: dict[int, int] = {9: 0, 10: 1, 14: 5013, 15: serial, 35: rate}

    def __call__(self, motor: Actuator, can_id: int, data: bytes) -> list[Frame] | None:
        answers = self._hear(motor, can_id & ~FD_FRAME, data)
        kind = FD_FRAME if self._words[35] > 4 else 0
        return answers and [(answered | kind, said) for answered, said in answers]

    def _hear(self, motor: Actuator, can_id: int, data: bytes) -> list[Frame] | None:
        if can_id == _SERVICE_PORT and len(data) == 8 and data[0] | data[1] << 8 == motor.id:
            return self._service(motor, data)
        if can_id != motor.id or len(data) != 8:
            return None
        if self._words[10] == 1:
            _mit_command(motor, data)
        return [self._report(motor)]

    def _service(self, motor: Actuator, data: bytes) -> list[Frame]:
        kind, register = data[2], data[3]
        if kind == 0xCC:
            return [self._report(motor)]
        if kind == 0x55 and register in self._words:
            self._words[register] = struct.unpack("<I", data[4:])[0]
            motor.timeout_ns = self._words[9] * 50_000
        if register in self._floats:
            value = struct.pack("<f", self._floats[register])
        else:
            value = struct.pack("<I", self._words.get(register, 0))
        return [(self._reply_id, bytes([*data[:4], *value]))]

    def _report(self, motor: Actuator) -> Frame:
        status = motor.fault or int(motor.on)
        return self._reply_id, _mit_report(motor, status << 4 | motor.id & 15) + bytes([31, 28])


class _PlainWire:
    """Mini Cheetah's answers: the id, figures, and on some a temperature."""

    def __init__(self, reply_id: int, *, deci: bool) -> None:
        self._reply_id, self._deci = reply_id, deci

    def __call__(self, motor: Actuator, can_id: int, data: bytes) -> list[Frame] | None:
        if can_id != motor.id or len(data) != 8:
            return None
        _mit_command(motor, data)
        tail = struct.pack(">H", 285) if self._deci else b""
        return [(self._reply_id, _mit_report(motor, motor.id) + tail)]


class _RobStrideWire:
    """29-bit identifiers as in the RS manuals of 2026-04."""

    def __init__(self, host: int, timeout_index: int) -> None:
        self._host = host
        self._timeout_index = timeout_index
        self._words: dict[int, int] = {0x7005: 0, timeout_index: 0}

    def __call__(self, motor: Actuator, can_id: int, data: bytes) -> list[Frame] | None:
        if not can_id & _LONG_ID or can_id & 0xFF != motor.id or len(data) != 8:
            return None
        kind = can_id >> 24 & 0x1F
        if kind == 1 and self._words[0x7005] == 0:
            p, v, kp, kd = struct.unpack(">4H", data)
            _ask(motor, p, v, kp, kd, can_id >> 8 & 0xFFFF, bits=16)
        elif kind == 3:
            motor.switch(True)
        elif kind == 4:
            motor.switch(False)
            motor.fault = 0 if data[0] == 1 else motor.fault
        elif kind == 17:
            return [self._parameter(motor, data)]
        elif kind == 18:
            self._words[data[0] | data[1] << 8] = struct.unpack("<I", data[4:])[0]
            motor.timeout_ns = self._words[self._timeout_index] * 50_000
        return [self._report(motor)]

    def _parameter(self, motor: Actuator, data: bytes) -> Frame:
        index = data[0] | data[1] << 8
        value = struct.pack("<f", motor.position) if index == 0x7019 else struct.pack("<I", self._words.get(index, 0))
        unknown = index != 0x7019 and index not in self._words
        return self._id(17, motor, unknown), bytes([data[0], data[1], 0, 0]) + value

    def _report(self, motor: Actuator) -> Frame:
        state = (2 if motor.on else 0) << 6 | (1 if motor.fault else 0)
        return self._id(2, motor, state), struct.pack(">4H", *_told(motor, 16), 285)

    def _id(self, kind: int, motor: Actuator, content: int) -> int:
        return _LONG_ID | kind << 24 | content << 16 | motor.id << 8 | self._host
