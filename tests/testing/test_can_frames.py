"""Frames by the batch: the quick way through a socket says what python-can would say."""

import socket
import struct

import can
import pytest

from frictid_hil.protocol.can_frames import BUS_OFF, MOST, MessageFrames, SocketFrames, controller_state, frames_of
from frictid_hil.protocol.driver import FD_FRAME

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29


def packet(can_id, data, *, room=8, flags=0):
    """``struct can_frame`` of Linux, or ``struct canfd_frame`` with room for 64 bytes."""
    return struct.pack(f"<IBB2x{room}s", can_id, len(data), flags, data)


@pytest.fixture
def joined():
    """The quick way, and the other end of its wire."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    far.setblocking(False)
    with near, far:
        yield SocketFrames(near), far


def test_a_batch_leaves_as_the_packets_of_socketcan(joined):
    frames, far = joined
    frames.send([(0x201, b"\x0f\x00"), (0x202 | FD_FRAME, bytes(range(12))), (0x80, b"")])
    assert far.recv(100) == packet(0x201, b"\x0f\x00")
    assert far.recv(100) == packet(0x202, bytes(range(12)), room=64, flags=1)  # at the higher bit rate
    assert far.recv(100) == packet(0x80, b"")
    frames.send_alone(0x601, bytes(8))
    assert far.recv(100) == packet(0x601, bytes(8))


def test_more_than_fits_into_one_call_leaves_whole_and_in_order(joined):
    frames, far = joined
    frames.send([(number, bytes([number])) for number in range(1, 2 * MOST)])
    assert [far.recv(100)[8] for _ in range(1, 2 * MOST)] == list(range(1, 2 * MOST))


def test_what_has_come_comes_at_once_and_in_order(joined):
    frames, far = joined
    assert frames.receive(0.0) is None
    for sent in (packet(0x181, b"12345678"), packet(0x182, b"x" * 20, room=64), packet(0x701, b"\5")):
        far.send(sent)
    heard = frames.receive(0.0)
    assert [(can_id, data) for can_id, data in heard] == [
        (0x181, b"12345678"), (0x182 | FD_FRAME, b"x" * 20), (0x701, b"\5"),
    ]  # fmt: skip
    assert frames.receive(0.001) is None


def test_old_bytes_of_a_longer_frame_are_not_read_again(joined):
    frames, far = joined
    far.send(packet(0x181, b"y" * 64, room=64))
    frames.receive(0.0)
    far.send(packet(0x181, b"12"))
    far.send(packet(0x181, b"12")[:4] + b"\x40" + packet(0x181, b"12")[5:])  # a length that no classical frame has
    assert [data for _, data in frames.receive(0.0)] == [b"12", b"12" + bytes(6)]


def test_frames_that_are_nobodys_are_left_out_and_error_frames_tell_of_the_controller(joined):
    frames, far = joined
    far.send(packet(0x181 | EXTENDED, b"1"))
    far.send(packet(0x181 | REMOTE, b""))
    far.send(packet(0x40 | ERROR, bytes(8)))
    far.send(packet(0x2 | ERROR, bytes(8)))
    assert frames.receive(0.0) == [] and frames.controller == BUS_OFF
    assert controller_state(0x04, bytes([0, 0x30])) == "error-passive"


def test_a_full_buffer_and_a_bus_that_is_gone_are_errors_at_once(joined):
    frames, far = joined
    with pytest.raises(OSError, match="temporarily unavailable"):
        for _ in range(10_000):
            frames.send([(0x80, b"")])
    far.close()
    with pytest.raises(OSError):
        frames.send([(0x80, b"")])
    with pytest.raises(OSError, match="the bus is gone"):
        frames.receive(0.0)


def test_any_other_interface_goes_by_messages_and_says_the_same():
    with (
        can.Bus("frames", interface="virtual", protocol=can.CanProtocol.CAN_FD) as bus,
        can.Bus("frames", interface="virtual", protocol=can.CanProtocol.CAN_FD) as other,
    ):
        frames = frames_of(bus)
        assert isinstance(frames, MessageFrames)
        frames.send([(0x201, b"\x0f"), (0x202 | FD_FRAME, bytes(12))])
        first, second = other.recv(0.0), other.recv(0.0)
        assert (first.arbitration_id, bytes(first.data), first.is_fd) == (0x201, b"\x0f", False)
        assert (second.arbitration_id, len(second.data), second.is_fd, second.bitrate_switch) == (0x202, 12, True, True)
        for message in (
            can.Message(arbitration_id=0x181, data=b"12", is_extended_id=False),
            can.Message(arbitration_id=0x181, data=b"12"),
            can.Message(arbitration_id=0x40, is_error_frame=True),
        ):
            other.send(message)
        assert [(can_id, data) for can_id, data in frames.receive(0.0)] == [(0x181, b"12")]
        assert frames.controller == BUS_OFF and frames.receive(0.0) is None
        other.send(can.Message(arbitration_id=0x181, data=b"12"))
        assert frames.receive(0.0) == [] and frames.receive(0.0) is None
