"""The makers' USB adapters: their bytes, and a motor driven through them."""

from __future__ import annotations

from dataclasses import replace

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mit_bench import Bench, robot

from frictid_drivers.mit.adapters import DamiaoAdapter, RobStrideAdapter, SerialAdapter
from frictid_drivers.mit.driver import MitDriver
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import EXTENDED


class FakePort:
    """What the adapter sends is kept, or given to ``devices``; what it shall hear waits in ``coming``."""

    timeout: float | None = None

    def __init__(self, heard=lambda data: b"") -> None:
        self.sent, self.coming, self._heard = bytearray(), bytearray(), heard

    def read(self, size: int = 1) -> bytes:
        data = bytes(self.coming[:size])
        del self.coming[:size]
        return data

    def write(self, data: bytes) -> int:
        self.sent += data
        self.coming += self._heard(data)
        return len(data)

    def close(self) -> None:
        pass


def damiao_answer(can_id: int, data: bytes) -> bytes:
    return b"\xaa\x11\x08" + can_id.to_bytes(4, "little") + data + b"\x55"


def robstride_frame(can_id: int, data: bytes) -> bytes:
    return b"AT" + (can_id << 3 | 4).to_bytes(4, "big") + bytes([len(data)]) + data + b"\r\n"


def test_bytes_of_the_field() -> None:
    port = FakePort()
    bus = DamiaoAdapter("fake", port=port)
    bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(range(1, 9))))
    assert len(port.sent) == 30 and port.sent[:3] == b"\x55\xaa\x1e"
    assert port.sent[13:15] == b"\x23\x01" and port.sent[21:29] == bytes(range(1, 9))
    port = FakePort()
    bus_2 = RobStrideAdapter("fake", port=port)
    bus_2.send(can.Message(arbitration_id=0x0300FD01, is_extended_id=True, data=bytes(8)))
    assert port.sent.hex() == "4154" + "1807e80c" + "08" + "00" * 8 + "0d0a"
    bus.shutdown()
    bus_2.shutdown()


def test_what_an_adapter_cannot_carry_is_refused() -> None:
    for adapter, extended in ((DamiaoAdapter, True), (RobStrideAdapter, False)):
        bus: SerialAdapter = adapter("fake", port=FakePort())
        with pytest.raises(can.CanOperationError, match="identifiers"):
            bus.send(can.Message(arbitration_id=1, is_extended_id=extended, data=bytes(8)))
        bus.shutdown()
    with pytest.raises(can.CanInitializationError):
        DamiaoAdapter("/nowhere")


@given(st.binary(max_size=12), st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8))
def test_a_frame_is_found_behind_any_rubbish_that_is_no_frame(rubbish: bytes, can_id: int, data: bytes) -> None:
    for adapter, framed in ((DamiaoAdapter, damiao_answer), (RobStrideAdapter, robstride_frame)):
        port = FakePort()
        bus: SerialAdapter = adapter("fake", port=port)
        port.coming += bytes(byte for byte in rubbish if byte not in b"\xaaA") + framed(can_id, data)
        message = bus.recv(0.0)
        assert message is not None and message.arbitration_id == can_id and bytes(message.data) == data
        assert bus.recv(0.0) is None
        bus.shutdown()


@pytest.mark.parametrize("family", ["damiao", "robstride"])
def test_a_motor_is_driven_through_its_makers_adapter(tmp_path, family) -> None:
    b = Bench(robot(tmp_path, family).to_setup())

    def damiao(data: bytes) -> bytes:
        frame = int.from_bytes(data[13:15], "little"), data[21:29]
        return b"".join(damiao_answer(can_id, answer) for can_id, answer in b.rack.receive(*frame))

    def robstride(data: bytes) -> bytes:
        frame = int.from_bytes(data[2:6], "big") >> 3 | EXTENDED, data[7 : 7 + data[6]]
        return b"".join(robstride_frame(can_id & ~EXTENDED, answer) for can_id, answer in b.rack.receive(*frame))

    adapter = DamiaoAdapter if family == "damiao" else RobStrideAdapter
    bus = adapter("fake", port=FakePort(damiao if family == "damiao" else robstride))
    b.driver = MitDriver(b.setup, bus_factory=lambda: bus, clock=b.clock)
    b.begin()
    b.enabled(Mode.POSITION)
    for _ in range(200):
        b.set_points[0].position_rad += 0.002
        (report,) = b.cycles(1)
    assert report.position_rad == pytest.approx(0.4, abs=0.05)
    b.driver.close()
    assert not b.rack.actuators["0"].on


@pytest.mark.parametrize(("bus", "family", "most_hz"), [("damiao", "damiao", 102), ("robstride", "robstride", 180)])
def test_the_serial_line_limits_the_rate(tmp_path, bus, family, most_hz) -> None:
    setup = replace(robot(tmp_path, family, joints=6).to_setup(), bus=f"{bus}:/dev/ttyACM0")
    b = Bench(setup, tty_baudrate=184_320)
    b.driver.open()
    assert b.driver.capabilities().max_cycle_hz == most_hz


def test_they_are_interfaces_of_python_can() -> None:
    with pytest.raises(can.CanInitializationError):
        can.Bus(interface="damiao", channel="/nowhere")
