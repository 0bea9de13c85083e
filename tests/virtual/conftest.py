"""A drive on a desk: one servo, a joint that can be reasoned about by hand, and the wire between them and the test."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from frictid_drivers.virtual.objects import Key, Value
from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.servo import Servo
from frictid_hil.plan.setup import JointSetup, RobotSetup

MS = 1_000_000
COUNTS_PER_REVOLUTION = 1_000_000


@dataclass
class DeskPlant:
    """A joint without friction or gravity that follows position and velocity at once, and torque by its inertia."""

    measured_position_rad: float = 0.0
    velocity_rad_s: float = 0.0
    torque_nm: float = 0.0
    external_torque_nm: float = 0.0
    temperature_c: float = 25.0
    saturated: bool = False
    inertia_kg_m2: float = 1.0
    blocked: bool = False
    powered: bool = False
    braked: bool = False
    mode: int = 8
    torque_limit_nm: float = 1e9
    payload: bool = False
    calls: list[dict[str, float]] = field(default_factory=list)

    @property
    def position_counts(self) -> int:
        return round(self.measured_position_rad / 6.283185307179586 * COUNTS_PER_REVOLUTION)

    def power(self, on: bool) -> None:
        self.powered = on

    def brake(self, engaged: bool) -> None:
        self.braked = engaged

    def set_mode(self, mode: int) -> None:
        self.mode = mode

    def limits(self, torque_nm: float) -> None:
        self.torque_limit_nm = torque_nm

    def mount_payload(self, on: bool) -> None:
        self.payload = on

    def advance(self, duration_s, *, position_rad=0.0, velocity_rad_s=0.0, torque_nm=0.0, torque_offset_nm=0.0):
        self.calls.append(
            {"duration_s": duration_s, "position_rad": position_rad, "velocity_rad_s": velocity_rad_s,
             "torque_nm": torque_nm, "torque_offset_nm": torque_offset_nm, "mode": self.mode}
        )  # fmt: skip
        before = self.measured_position_rad
        if self.braked or self.blocked:
            self.velocity_rad_s = 0.0
        elif not self.powered:
            self.measured_position_rad += self.velocity_rad_s * duration_s
        elif self.mode == 8:
            self.measured_position_rad = position_rad
            self.velocity_rad_s = (position_rad - before) / duration_s
        elif self.mode == 9:
            self.velocity_rad_s = velocity_rad_s
            self.measured_position_rad += velocity_rad_s * duration_s
        else:
            self.velocity_rad_s += torque_nm / self.inertia_kg_m2 * duration_s
            self.measured_position_rad += self.velocity_rad_s * duration_s
        self.torque_nm = torque_nm + torque_offset_nm if self.powered else 0.0


class Desk:
    """A rack with one drive, node 5, and both ends of the wire."""

    node = 5

    def __init__(self, overrides: dict[Key, Value] | None = None, missing: tuple[int, ...] = (), **servo) -> None:
        self.rack = Rack()
        self.heard: list[tuple[int, str]] = []
        self.rack.transmit = lambda can_id, data: self.heard.append((can_id, data.hex()))
        self.plant = DeskPlant()
        plant = cast(Any, self.plant)  # in the place of a ``ServoLoop``
        servo.setdefault("increments_per_revolution", COUNTS_PER_REVOLUTION)
        self.servo = Servo(self.node, plant, self.rack.send, overrides=overrides, missing=missing, **servo)
        self.rack.add("joint", self.servo)
        self.rack.power_on()

    def send(self, can_id: int, data: str | bytes, *, remote: bool = False) -> list[tuple[int, str]]:
        """Put a frame on the wire; what the drive says to it."""
        self.heard.clear()
        self.rack.process(can_id, bytes.fromhex(data) if isinstance(data, str) else data, remote=remote)
        return list(self.heard)

    def wait(self, milliseconds: float) -> list[tuple[int, str]]:
        """Let run time pass; what the drive says meanwhile."""
        self.heard.clear()
        self.rack.advance(self.rack.now_ns + round(milliseconds * MS))
        return list(self.heard)

    def sync(self, counter: int | None = None) -> list[tuple[int, str]]:
        return self.send(0x80, b"" if counter is None else bytes([counter]))

    def cycle(self, data: bytes, milliseconds: float = 1.0) -> list[tuple[int, str]]:
        """RPDO 1 and SYNC, then a period passes; what was said at the SYNC."""
        self.send(0x200 + self.node, data)
        heard = self.sync()
        self.wait(milliseconds)
        return heard

    def write(self, index: int, subindex: int, value: int, size: int) -> int:
        """Expedited download; the abort code, 0 when it was accepted."""
        request = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex)
        request += (value & 0xFFFFFFFF).to_bytes(4, "little")
        replies = [bytes.fromhex(data) for can_id, data in self.send(0x600 + self.node, request) if can_id == 0x585]
        assert len(replies) == 1 and replies[0][1:4] == request[1:4]
        return 0 if replies[0][0] == 0x60 else int.from_bytes(replies[0][4:], "little")

    def read(self, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        """Expedited upload."""
        request = struct.pack("<BHB4x", 0x40, index, subindex)
        reply = bytes.fromhex(next(data for can_id, data in self.send(0x600 + self.node, request) if can_id == 0x585))
        assert reply[0] & 0xE3 == 0x43, f"{index:04X}:{subindex:02X} -> {reply.hex()}"
        return int.from_bytes(reply[4 : 8 - (reply[0] >> 2 & 3)], "little", signed=signed)

    def abort_of_read(self, index: int, subindex: int = 0) -> int:
        request = struct.pack("<BHB4x", 0x40, index, subindex)
        reply = bytes.fromhex(self.send(0x600 + self.node, request)[0][1])
        return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0

    def map_pdo(self, receive: bool, number: int, entries: list[int], kind: int, **extra: int) -> None:
        """The whole protocol: invalid, type, count 0, entries, count, valid."""
        com = (0x1400 if receive else 0x1800) + number - 1
        mapping = (0x1600 if receive else 0x1A00) + number - 1
        cob_id = (0x100 if receive else 0x80) + 0x100 * number + self.node
        steps = [(com, 1, 1 << 31 | cob_id, 4), (com, 2, kind, 1), (mapping, 0, 0, 1)]
        steps += [(com, {"inhibit": 3, "timer": 5, "start": 6}[name], value, 1 if name == "start" else 2)
                  for name, value in extra.items()]  # fmt: skip
        steps += [(mapping, sub, entry, 4) for sub, entry in enumerate(entries, 1)]
        steps += [(mapping, 0, len(entries), 1), (com, 1, cob_id, 4)]
        for step in steps:
            assert self.write(*step) == 0, step

    def state(self) -> int:
        """The state bits of the statusword."""
        status = self.read(0x6041)
        return status & (0x4F if status & 0x48 and not status & 0x20 else 0x6F)

    def control(self, word: int) -> int:
        """Write the controlword; the state that follows."""
        assert self.write(0x6040, 0, word, 2) == 0
        return self.state()

    def enable(self, mode: int = 8) -> None:
        """By SDO, from wherever it is after boot."""
        assert self.write(0x6060, 0, mode, 1) == 0
        for word in (0x06, 0x07, 0x0F):
            self.control(word)
        assert self.state() == 0x27

    def said(self, can_id: int, frames: list[tuple[int, str]]) -> list[str]:
        return [data for heard, data in frames if heard == can_id]


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture(scope="session")
def make_desk():
    return Desk


SIMULATED = {
    "inertia_kg_m2": 0.5,
    "gravity_cos_nm": 5.0,
    "friction": {"coulomb_nm": 4.0, "viscous_nm_s_per_rad": 1.0},
    "payload": {"inertia_kg_m2": 0.2, "gravity_cos_nm": 6.0},
    "hand": {"stiffness_nm_per_rad": 200.0, "damping_nm_s_per_rad": 10.0},
}


def robot(joints: int = 2, name: str = "bench", **more) -> RobotSetup:
    """A robot of equal joints, every second one mounted backwards."""
    return RobotSetup(
        name=name,
        bus=f"virtual:{name}",
        cycle_hz=1000.0,
        joints=tuple(
            JointSetup(
                name=str(at),
                address=at + 1,
                gear_ratio=100.0,
                direction=-1 if at % 2 else 1,
                max_velocity_rad_s=3.5,
                max_torque_nm=90.0,
                rated_torque_nm=30.0,
                position_min_rad=-2.0,
                position_max_rad=2.0,
                start_position_rad=-0.2,
                locked_position_rad=0.1 * at,
                simulated=SIMULATED,
            )
            for at in range(joints)
        ),
        **more,
    )


@pytest.fixture(scope="session")
def make_robot():
    return robot


@pytest.fixture
def runtime_folder(tmp_path, monkeypatch):
    """Locks and sockets of this test alone."""
    monkeypatch.setenv("FRICTID_RUNTIME_DIR", str(tmp_path))
    return tmp_path
