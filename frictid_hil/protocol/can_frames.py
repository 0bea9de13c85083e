"""Frames of a CAN bus by the batch: all of a cycle in one call of the system, where the bus is a socket.

python-can makes an object of every frame and calls the system several times for it. A cycle that has its deadline in a
millisecond has no time for that. ``frames_of`` gives the quick way for SocketCAN and for the simulated bus, and the way
over ``can.Message`` for any other interface.

Identifiers carry the flags of ``FrameSink``: bit 29 for CAN FD. Extended and remote frames are nobody's here and are
left out; error frames are kept as the state of our own controller.
"""

from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Protocol

import can
from can.interfaces.socketcan import SocketcanBus

from frictid_hil.protocol.driver import EXTENDED, FD_FRAME

Heard = tuple[int, bytes]
"""Identifier and data."""

BUS_OFF = "bus-off"
_PASSIVE, _ALONE = "error-passive", "no acknowledgement"
CONTROLLER_STATES = {
    BUS_OFF: "our CAN controller went bus-off: a short circuit, a wrong bit rate, or missing termination",
    _PASSIVE: "our CAN controller is error-passive: frames are destroyed by a bad cable, termination or bit rate",
    _ALONE: "nobody acknowledges our frames: no other device is on the bus, or all have another bit rate",
}


class Frames(Protocol):
    """A bus for one cycle."""

    controller: str  # what error frames last said of our own CAN controller: a key of ``CONTROLLER_STATES``, or ""

    def send(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Send all of them, in order.

        Raises:
            Exception: one of ``can_bus.BUS_ERRORS``; those before the one that failed are sent.
        """

    def send_alone(self, can_id: int, data: bytes) -> None:
        """Send one, from any thread."""

    def receive(self, timeout_s: float) -> list[Heard] | None:
        """What has come, at least one frame; None where nothing came in time. Empty where it was of no meaning.

        Raises:
            Exception: one of ``can_bus.BUS_ERRORS``.
        """


def frames_of(bus: can.BusABC) -> Frames:
    """The quickest way that a bus has."""
    if isinstance(bus, SocketcanBus) and bus.channel and not bus.filters:
        return SocketFrames(bus.socket)
    own: Frames | None = getattr(bus, "frames", None)
    return own or MessageFrames(bus)


def controller_state(can_id: int, data: bytes | bytearray) -> str:
    """What an error frame of the interface says of our own CAN controller, by name; "" for passing errors.

    Source: Linux SocketCAN, ``linux/can/error.h``: the class is in the identifier (0x40 bus-off, 0x04 controller, 0x20
    nobody acknowledged), the controller's state in byte 1 (0x10, 0x20 error-passive).
    """
    if can_id & 0x40:
        return BUS_OFF
    if can_id & 0x04 and len(data) > 1 and data[1] & 0x30:
        return _PASSIVE
    return _ALONE if can_id & 0x20 else ""


class MessageFrames:
    """Any interface of python-can, frame by frame; nobody else reads it meanwhile."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._messages: dict[int, can.Message] = {}
        self.controller = ""

    def send(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """One by one."""
        for can_id, data in frames:
            message = self._messages.get(can_id)
            if message is None:
                message = self._messages[can_id] = message_of(can_id, data)
            # Bytes of its own each time: some interfaces (gs_usb) pad them in place.
            message.data, message.dlc = bytearray(data), len(data)
            self._bus.send(message)

    def send_alone(self, can_id: int, data: bytes) -> None:
        """Send one, from any thread."""
        self._bus.send(message_of(can_id, data))

    def receive(self, timeout_s: float) -> list[Heard] | None:
        """All that has come."""
        message = self._bus.recv(timeout_s)
        if message is None:
            return None
        heard: list[Heard] = []
        while message is not None:
            if message.is_error_frame:
                self.controller = controller_state(message.arbitration_id, message.data) or self.controller
            elif not message.is_extended_id and not message.is_remote_frame:
                heard.append((identifier_of(message), bytes(message.data)))
            message = self._bus.recv(0.0)
        return heard


def message_of(can_id: int, data: bytes) -> can.Message:
    """A frame for python-can, with bytes of its own: some interfaces pad the message that they are given."""
    fd, extended = can_id & FD_FRAME != 0, can_id & EXTENDED != 0
    return can.Message(
        arbitration_id=can_id & (0x1FFF_FFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_fd=fd,
        bitrate_switch=fd,
        data=bytearray(data),
    )


def identifier_of(message: can.Message) -> int:
    """Of a message, with its flags."""
    return message.arbitration_id | EXTENDED * message.is_extended_id | FD_FRAME * message.is_fd


class _Header(ctypes.Structure):
    """``struct msghdr`` of Linux."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("pieces", ctypes.c_void_p),
        ("piece_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """``struct mmsghdr``: one of the packets of a call."""

    _fields_ = (("header", _Header), ("length", ctypes.c_uint32))


class _Piece(ctypes.Structure):
    """``struct iovec``: where its bytes are."""

    _fields_ = (("at", ctypes.c_void_p), ("length", ctypes.c_size_t))


MOST = 64
"""Packets in one call of the system."""
_NOT_OURS, _ERROR_FRAME = 0xC000_0000, 0x2000_0000
_BIT_RATE_SWITCH = 1


class _Packets:
    """Room for packets that are handed to the system together."""

    def __init__(self, stride: int) -> None:
        self.room = bytearray(MOST * stride)
        at = ctypes.addressof(ctypes.c_char.from_buffer(self.room))
        self._pieces = (_Piece * MOST)(*(_Piece(at + k * stride, stride) for k in range(MOST)))
        first = ctypes.addressof(self._pieces)
        size = ctypes.sizeof(_Piece)
        self._messages = (_Message * MOST)(
            *(_Message(_Header(pieces=first + k * size, piece_count=1)) for k in range(MOST))
        )
        self.address = ctypes.addressof(self._messages)
        self.sizes = memoryview(self._pieces).cast("B").cast("L")[1::2]
        """Of what is sent, by packet."""
        words = ctypes.sizeof(_Message) // 4
        self.lengths = memoryview(self._messages).cast("B").cast("I")[_Message.length.offset // 4 :: words]
        """Of what came."""


class SocketFrames:
    """A socket whose packets are SocketCAN's, in as few calls of the system as there can be; nobody else reads it."""

    # ``stamped`` packets end with when they were sent, ns of the monotonic clock (the simulated bus).
    def __init__(self, wire: socket.socket, *, stamped: bool = False) -> None:
        self.controller = ""
        self._wire, self._fd, self._stamped = wire, wire.fileno(), stamped
        tail = "Q" if stamped else ""
        self._packing = {False: struct.Struct(f"<IBB2x8s{tail}"), True: struct.Struct(f"<IBB2x64s{tail}")}
        self._stride = self._packing[True].size
        self._classical = self._packing[False].size
        self._packets = struct.Struct("<IB3x64s8x" if stamped else "<IB3x64s")
        self._out, self._in = _Packets(self._stride), _Packets(self._stride)
        # These calls never wait, so that the interpreter's lock need not be let go.
        library = ctypes.PyDLL(None, use_errno=True)
        self._sendmmsg, self._recvmmsg = library.sendmmsg, library.recvmmsg
        # Arguments as the system wants them, made once: to turn numbers into them takes as long as the call.
        self._whose, self._at_once = ctypes.c_int(self._fd), ctypes.c_int(socket.MSG_DONTWAIT)
        self._counts = [ctypes.c_uint(count) for count in range(MOST + 1)]
        self._first = ctypes.c_void_p(self._out.address)
        room = ctypes.c_void_p(self._in.address)
        self._into = (self._whose, room, self._counts[MOST], self._at_once, ctypes.c_void_p(None))

    def send(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """All of them; a full transmit buffer is an error at once."""
        if len(frames) > MOST:
            self.send(frames[:MOST])
            self.send(frames[MOST:])
            return
        room, sizes, at = self._out.room, self._out.sizes, 0
        stamp = (time.monotonic_ns(),) if self._stamped else ()
        classical, size = self._packing[False].pack_into, self._classical
        for number, (can_id, data) in enumerate(frames):
            if can_id & FD_FRAME:
                packing = self._packing[True]
                packing.pack_into(room, at, can_id & ~FD_FRAME, len(data), _BIT_RATE_SWITCH, data, *stamp)
                sizes[number] = packing.size
            else:
                classical(room, at, can_id, len(data), 0, data, *stamp)
                sizes[number] = size
            at += self._stride
        left, first = len(frames), self._first
        while (sent := self._sendmmsg(self._whose, first, self._counts[left], self._at_once)) != left:
            if sent < 0:
                raise _failed()
            left -= sent
            first = ctypes.c_void_p(self._out.address + (len(frames) - left) * ctypes.sizeof(_Message))

    def send_alone(self, can_id: int, data: bytes) -> None:
        """Send one, from any thread."""
        fd = can_id & FD_FRAME != 0
        stamp = (time.monotonic_ns(),) if self._stamped else ()
        packet = self._packing[fd].pack(can_id & ~FD_FRAME, len(data), fd and _BIT_RATE_SWITCH, data, *stamp)
        self._wire.send(packet, socket.MSG_DONTWAIT)

    def receive(self, timeout_s: float) -> list[Heard] | None:
        """All that has come."""
        count = self._recvmmsg(*self._into)
        if count < 0 and ctypes.get_errno() == errno.EAGAIN:
            if timeout_s <= 0.0 or not select.select((self._fd,), (), (), timeout_s)[0]:
                return None
            count = self._recvmmsg(*self._into)
        if count < 0:
            raise _failed()
        heard: list[Heard] = []
        unpack, room, lengths, classical = self._packets.unpack_from, self._in.room, self._in.lengths, self._classical
        for at in range(count):
            length = lengths[at]
            can_id, size, data = unpack(room, at * self._stride)
            if length == classical and can_id <= 0x7FF and size <= 8:
                heard.append((can_id, data[:size]))
            elif length < classical:
                raise ConnectionResetError(errno.ECONNRESET, "the bus is gone: whoever kept it has ended")
            elif can_id & _ERROR_FRAME:
                self.controller = controller_state(can_id, data) or self.controller
            elif not can_id & _NOT_OURS:
                if length > classical:
                    can_id |= FD_FRAME
                elif size > 8:
                    size = 8
                heard.append((can_id, data[:size]))
        return heard


def _failed() -> OSError:
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))
