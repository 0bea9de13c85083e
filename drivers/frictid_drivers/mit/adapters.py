"""The makers' own USB adapters as python-can interfaces: ``damiao:/dev/ttyACM0``, ``robstride:/dev/ttyUSB0``.

=========  =====================================================================================  ==============
adapter    a frame on the serial line                                                             carries
=========  =====================================================================================  ==============
Damiao     out 30 bytes: 55 AA 1E 03 01 .. , id at 13-14 (least significant first), data at       11-bit ids,
           21-28; in 16 bytes: AA 11 .. , id at 3-6, data at 7-14, 55                             8 bytes
RobStride  both ways: "AT", id << 3 | 4 in 4 bytes (most significant first), length, data, CR LF  29-bit ids
=========  =====================================================================================  ==============

Source: the maker's DM_Control_Python, and public programs for RobStride's adapter, one source each; never tried on an
adapter. Neither has a checksum: what does not begin and end as it should is left out.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from typing import Any, Protocol

import can
import serial

BAUD = 921_600
LINE_BYTES = {"damiao": 30, "robstride": 17}
"""Bytes on the serial line that a command takes, by interface; answers take no more."""


class Port(Protocol):
    """What is used of a serial port."""

    timeout: float | None

    def read(self, size: int = 1) -> bytes:
        """At most so many bytes, waiting for ``timeout``."""

    def write(self, data: bytes) -> int | None:
        """Send."""

    def close(self) -> None:
        """Hang up."""


class SerialAdapter(can.BusABC):
    """What both have in common; ``CanInitializationError`` where there is no such port, or somebody else has it."""

    def __init__(self, channel: str, tty_baudrate: int = BAUD, port: Port | None = None, **_: Any) -> None:
        try:
            self._port: Port = port or serial.Serial(channel, tty_baudrate, exclusive=True)
        except (OSError, serial.SerialException) as error:
            raise can.CanInitializationError(str(error)) from error
        self._heard = bytearray()
        self.channel_info = f"{type(self).__name__} on {channel}"
        super().__init__(channel=channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame; ``CanOperationError`` where the adapter cannot carry it, or is gone."""
        packed = self._packed(msg)
        try:
            self._port.write(packed)
        except (OSError, serial.SerialException) as error:
            raise can.CanOperationError(str(error)) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        until_s = None if timeout is None else time.monotonic() + timeout
        while True:
            message = self._next()
            if message is not None:
                return message, False
            left_s = None if until_s is None else max(0.0, until_s - time.monotonic())
            try:
                self._port.timeout = left_s
                more = self._port.read(1)
                self._port.timeout = 0.0
                more += self._port.read(4096)
            except (OSError, serial.SerialException) as error:
                raise can.CanOperationError(str(error)) from error
            self._heard += more
            if not more and left_s is not None:
                return None, False

    def shutdown(self) -> None:
        """Close the port."""
        super().shutdown()
        self._port.close()

    @abstractmethod
    def _packed(self, message: can.Message) -> bytes:
        """A frame as the adapter takes it."""

    @abstractmethod
    def _next(self) -> can.Message | None:
        """The next whole frame of what was heard, taken out of it."""


class DamiaoAdapter(SerialAdapter):
    """Damiao's USB adapter."""

    def _packed(self, message: can.Message) -> bytes:
        if message.is_extended_id or len(message.data) != 8:
            raise can.CanOperationError("Damiao's adapter carries 11-bit identifiers and 8 bytes")
        head = bytes.fromhex("55AA1E030100 00000A00 000000")
        low, high = message.arbitration_id & 0xFF, message.arbitration_id >> 8
        return head + bytes([low, high, 0, 0, 0, 8, 0, 0]) + bytes(message.data) + b"\0"

    def _next(self) -> can.Message | None:
        heard = self._heard
        while len(heard) >= 16:
            if heard[0] == 0xAA and heard[1] == 0x11 and heard[15] == 0x55:
                can_id, data = int.from_bytes(heard[3:7], "little"), bytes(heard[7:15])
                del heard[:16]
                return can.Message(arbitration_id=can_id & 0x7FF, is_extended_id=False, data=data)
            del heard[0]
        return None


class RobStrideAdapter(SerialAdapter):
    """RobStride's USB adapter."""

    def _packed(self, message: can.Message) -> bytes:
        if not message.is_extended_id:
            raise can.CanOperationError("RobStride's adapter carries 29-bit identifiers")
        head = b"AT" + (message.arbitration_id << 3 | 4).to_bytes(4, "big")
        return head + bytes([len(message.data)]) + bytes(message.data) + b"\r\n"

    def _next(self) -> can.Message | None:
        heard = self._heard
        while len(heard) >= 9:
            end = 7 + heard[6]
            if heard[:2] != b"AT" or heard[6] > 8:
                del heard[0]
                continue
            if len(heard) < end + 2:
                return None
            if heard[end : end + 2] != b"\r\n":
                del heard[0]
                continue
            can_id, data = int.from_bytes(heard[2:6], "big") >> 3, bytes(heard[7:end])
            del heard[: end + 2]
            return can.Message(arbitration_id=can_id, is_extended_id=True, data=data)
        return None
