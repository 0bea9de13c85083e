"""The serial line: a port held exclusively, packets out and in, each told to the bus log."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import serial

from frictid_drivers.servos.logs import RECEIVED_ID, SENT_ID
from frictid_drivers.servos.packets import Packet, Wire
from frictid_hil.errors import HardwareBusy, HardwareError
from frictid_hil.protocol.driver import Clock, FrameSink

LOGGED_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Lengths that a row of a bus log can have; a packet is padded to the next with zeros, which no parser minds."""
_TRIES = 3
PORT_ERRORS = (OSError, RuntimeError, ValueError)  # what ports raise, pyserial's own error included


class BytePort(Protocol):
    """Bytes out and in."""

    def write(self, data: bytes) -> None:
        """Send."""

    def read(self, timeout_s: float) -> bytes:
        """What is there; waits so long for the first byte."""

    def close(self) -> None:
        """Release."""


PortFactory = Callable[[], BytePort]


class SerialPort:
    """A real one.

    Raises:
        HardwareBusy: held by another process.
        HardwareError: no such port, or no permission.
    """

    def __init__(self, path: str, baud: int) -> None:
        try:
            self._serial = serial.Serial(path, baud, timeout=0, exclusive=True)
        except PORT_ERRORS as error:
            busy = "exclusively lock" in str(error)
            raise (HardwareBusy if busy else HardwareError)(
                f"cannot open the port: {error}",
                where=path,
                cause="another program holds it" if busy else "the adapter is absent, or you may not use it",
                next_step="see `ls -l /dev/serial/by-id`; add your user to the group that owns it",
            ) from error

    def write(self, data: bytes) -> None:
        """Send; also empties what was left of earlier answers."""
        self._serial.write(data)

    def read(self, timeout_s: float) -> bytes:
        """What is there; waits so long for the first byte."""
        self._serial.timeout = max(0.0, timeout_s)
        first: bytes = self._serial.read(1)
        return first + self._serial.read(self._serial.in_waiting) if first else b""

    def close(self) -> None:
        """Release."""
        self._serial.close()


@dataclass
class Line:
    """Packets of one maker on one port; ``HardwareError`` where the port is gone or a servo that is asked is silent."""

    port: BytePort
    wire: Wire
    sink: FrameSink | None  # told of every packet
    clock: Clock
    answer_s: float  # how long an answer may take
    # Told of every packet, with its run time and identifier in the log.
    heard: Callable[[int, int, bytes], None] | None = None
    _buffer: bytearray = field(default_factory=bytearray)

    def send(self, packet: bytes) -> None:
        """One packet."""
        try:
            self.port.write(packet)
        except PORT_ERRORS as error:
            raise _gone(error) from error
        self._tell(SENT_ID, packet, True)

    def received(self, until_ns: int) -> Iterator[Packet]:
        """Packets as they come until then; at once those that are here."""
        while True:
            left_s = (until_ns - self.clock.now_ns()) * 1e-9
            try:
                data = self.port.read(0.0 if self.clock.lock_step else max(0.0, left_s))
            except PORT_ERRORS as error:
                raise _gone(error) from error
            self._buffer += data
            for packet in self.wire.parse(self._buffer, answers=True):
                self._tell(RECEIVED_ID, packet.raw, False)
                yield packet
            if not data and (self.clock.lock_step or left_s <= 0):
                return

    def _awaited(self, until_ns: int) -> Iterator[Packet]:
        """As ``received``; in lock-step, too, time passes until the answer comes."""
        yield from self.received(until_ns)
        if self.clock.lock_step:
            self.clock.wait_until(until_ns)
            yield from self.received(until_ns)

    def tell(self, address: int, data: Mapping[int, bytes]) -> None:
        """Write the same number of bytes to each of these servos; nobody answers."""
        self.send(self.wire.sync_write(address, data))

    def ask(self, servo: int, address: int, count: int) -> bytes:
        """Read so many bytes."""
        for _ in range(_TRIES):
            self.send(self.wire.read(servo, address, count))
            for packet in self._awaited(self.clock.now_ns() + round(self.answer_s * 1e9)):
                if packet.id == servo and len(packet.data) == count:
                    return packet.data
        raise HardwareError(
            f"no answer to reading register {address}",
            where=f"servo {servo}",
            cause="no supply, another id or baud, or a cable that is not in",
            next_step="scan the line with the maker's tool",
        )

    def put(self, servo: int, address: int, data: bytes) -> bool:
        """Write and read back; False where the servo does not take it."""
        for _ in range(_TRIES):
            self.tell(address, {servo: data})
            if self.ask(servo, address, len(data)) == data:
                return True
        return False

    def close(self) -> None:
        """Release the port."""
        with contextlib.suppress(*PORT_ERRORS):
            self.port.close()

    def _tell(self, can_id: int, packet: bytes, sent: bool) -> None:
        t_ns = self.clock.now_ns()
        size = next((size for size in LOGGED_LENGTHS if size >= len(packet)), len(packet))
        if self.sink is not None:
            self.sink(t_ns, can_id, packet.ljust(size, b"\0"), sent)
        if self.heard is not None:
            self.heard(t_ns, can_id, packet)


def _gone(error: Exception) -> HardwareError:
    return HardwareError(
        f"the port is gone: {error}",
        cause="the adapter was unplugged",
        next_step="servos keep their last goal: switch their supply off before you touch the cable",
    )
