"""The simulated drives on any bus of python-can: they answer whoever asks, and survive a bus that is down."""

import json
import signal
import subprocess
import sys
import threading

import can
import pytest

from frictid_drivers.virtual import on_a_bus
from frictid_hil.config.robot import load_robot
from frictid_hil.protocol.driver import FD_FRAME

READ_6502 = bytes([0x40, 0x02, 0x65, 0, 0, 0, 0, 0])


@pytest.fixture
def host(monkeypatch):
    """A member of the bus on which the drives of the shipped robot are."""
    monkeypatch.setattr(on_a_bus, "be_punctual", lambda: None)
    bus = "virtual:test-on-a-bus"
    ready, stop = threading.Event(), threading.Event()
    with can.Bus(interface="virtual", channel="test-on-a-bus") as host:
        told = {"announce": lambda name: name == bus and ready.set(), "stop": stop.is_set}
        drives = threading.Thread(target=on_a_bus.serve, args=(load_robot("hp3j.yaml").to_setup(bus),), kwargs=told)
        drives.start()
        assert ready.wait(60)
        yield host
        stop.set()
        drives.join(10)
        assert not drives.is_alive()


def test_every_drive_boots_and_answers(host):
    for node in range(1, 7):
        host.send(can.Message(arbitration_id=0x600 + node, data=READ_6502, is_extended_id=False))
    heard = {}
    while len(heard) < 12 and (message := host.recv(5.0)) is not None:
        heard[message.arbitration_id] = bytes(message.data)
    assert all(heard[0x700 + node] == b"\0" for node in range(1, 7)), "boot-up"
    assert all(heard[0x580 + node][:4] == bytes([0x43, 0x02, 0x65, 0]) for node in range(1, 7))


class Down(can.BusABC):
    """An interface whose link is down."""

    def __init__(self):
        super().__init__(channel="")

    def send(self, msg, timeout=None):
        raise OSError(100, "Network is down")

    def _recv_internal(self, timeout):
        raise can.CanOperationError("Network is down")


def test_a_bus_that_is_down_loses_frames_and_no_more():
    with Down() as bus:
        wire = on_a_bus.BusWire(bus)
        wire.send(0x181, bytes(8))
        wire.wait(0.0)
        wire.serve()


def test_kinds_of_frames_are_kept():
    bus, other = (can.Bus("kinds", interface="virtual", protocol=can.CanProtocol.CAN_FD) for _ in range(2))
    with bus, other:
        wire, heard = on_a_bus.BusWire(bus), []
        wire.heard = lambda can_id, data, stamp_ns: heard.append((can_id, data))
        wire.send(0x181 | FD_FRAME, bytes(12))
        assert (sent := other.recv(1.0)) is not None and sent.is_fd and sent.arbitration_id == 0x181
        other.send(can.Message(arbitration_id=0x201, data=bytes(12), is_fd=True, is_extended_id=False))
        other.send(can.Message(arbitration_id=0x40, is_error_frame=True))
        other.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        wire.wait(1.0)
        wire.serve()
    assert heard == [(0x201 | FD_FRAME, bytes(12)), (0x80, b"")]


@pytest.mark.slow
def test_the_command_says_where_they_are_and_ends_when_asked():
    command = [sys.executable, "-m", "frictid_hil.cli.app", "emulate", "cia402", "--bus", "virtual:said", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        told = json.loads(process.stdout.readline())
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
    assert told == {"schema": "frictid.emulate/1", "outcome": "ok", "bus": "virtual:said"}
