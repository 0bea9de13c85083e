"""Packets of both makers: bytes to packets and back. A stream may begin anywhere and hold any garbage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

BROADCAST = 0xFE


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet, checked.

    Attributes:
        id: of the servo that it is for, or from.
        instruction: code; -1 in an answer.
        error: of an answer.
        data: parameters.
        raw: as on the wire.
    """

    id: int
    instruction: int
    error: int
    data: bytes
    raw: bytes


class Wire(Protocol):
    """How one maker puts bytes on the line."""

    name: ClassVar[str]
    answer_overhead: ClassVar[int]
    """Bytes of an answer beside its data."""

    def read(self, servo: int, address: int, count: int) -> bytes:
        """Ask one servo."""
        ...

    def write(self, servo: int, address: int, data: bytes) -> bytes:
        """Tell one servo."""
        ...

    def sync_read(self, servos: Sequence[int], address: int, count: int) -> bytes:
        """Ask several; they answer one after another."""
        ...

    def sync_write(self, address: int, data: Mapping[int, bytes]) -> bytes:
        """Tell several the same number of bytes each; nobody answers."""
        ...

    def answer(self, servo: int, error: int, data: bytes) -> bytes:
        """What a servo says."""
        ...

    def parse(self, buffer: bytearray, *, answers: bool) -> Iterator[Packet]:
        """Whole packets, taken off the buffer; what cannot be the beginning of one is dropped.

        Args:
            buffer: left with what may still become a packet.
            answers: the line brings answers, not instructions.
        """
        ...


class Feetech:
    """FF FF id length instruction-or-error data checksum; the checksum is the inverted sum from id on."""

    name: ClassVar[str] = "feetech"
    answer_overhead: ClassVar[int] = 6

    def read(self, servo: int, address: int, count: int) -> bytes:
        """As ``Wire.read``."""
        return _feetech(servo, 0x02, bytes([address, count]))

    def write(self, servo: int, address: int, data: bytes) -> bytes:
        """As ``Wire.write``."""
        return _feetech(servo, 0x03, bytes([address]) + data)

    def sync_read(self, servos: Sequence[int], address: int, count: int) -> bytes:
        """As ``Wire.sync_read``."""
        return _feetech(BROADCAST, 0x82, bytes([address, count, *servos]))

    def sync_write(self, address: int, data: Mapping[int, bytes]) -> bytes:
        """As ``Wire.sync_write``."""
        size = len(next(iter(data.values())))
        told = b"".join(bytes([servo]) + part for servo, part in data.items())
        return _feetech(BROADCAST, 0x83, bytes([address, size]) + told)

    def answer(self, servo: int, error: int, data: bytes) -> bytes:
        """As ``Wire.answer``."""
        return _feetech(servo, error, data)

    def parse(self, buffer: bytearray, *, answers: bool) -> Iterator[Packet]:
        """As ``Wire.parse``."""
        while True:
            _drop_to(buffer, b"\xff\xff")
            if len(buffer) < 4:
                return
            length = buffer[3]
            if buffer[2] == 0xFF or length < 2:
                del buffer[0]
                continue
            if len(buffer) < length + 4:
                return
            raw = bytes(buffer[: length + 4])
            if _checksum(raw[2:-1]) != raw[-1]:
                del buffer[0]
                continue
            del buffer[: length + 4]
            yield Packet(raw[2], -1 if answers else raw[4], raw[4] if answers else 0, raw[5:-1], raw)


class Dynamixel:
    """Protocol 2.0: FF FF FD 00 id length16 instruction [error] data crc16, with an FD stuffed after every FF FF FD."""

    name: ClassVar[str] = "dynamixel"
    answer_overhead: ClassVar[int] = 11

    def read(self, servo: int, address: int, count: int) -> bytes:
        """As ``Wire.read``."""
        return _dynamixel(servo, 0x02, _words(address, count))

    def write(self, servo: int, address: int, data: bytes) -> bytes:
        """As ``Wire.write``."""
        return _dynamixel(servo, 0x03, _words(address) + data)

    def sync_read(self, servos: Sequence[int], address: int, count: int) -> bytes:
        """As ``Wire.sync_read``."""
        return _dynamixel(BROADCAST, 0x82, _words(address, count) + bytes(servos))

    def sync_write(self, address: int, data: Mapping[int, bytes]) -> bytes:
        """As ``Wire.sync_write``."""
        size = len(next(iter(data.values())))
        told = b"".join(bytes([servo]) + part for servo, part in data.items())
        return _dynamixel(BROADCAST, 0x83, _words(address, size) + told)

    def answer(self, servo: int, error: int, data: bytes) -> bytes:
        """As ``Wire.answer``."""
        return _dynamixel(servo, 0x55, bytes([error]) + data)

    def parse(self, buffer: bytearray, *, answers: bool) -> Iterator[Packet]:
        """As ``Wire.parse``."""
        while True:
            _drop_to(buffer, b"\xff\xff\xfd\x00")
            if len(buffer) < 7:
                return
            length = buffer[5] | buffer[6] << 8
            if not 3 <= length <= _LONGEST:
                del buffer[0]
                continue
            if len(buffer) < length + 7:
                return
            raw = bytes(buffer[: length + 7])
            if crc16(raw[:-2]) != raw[-2] | raw[-1] << 8:
                del buffer[0]
                continue
            del buffer[: length + 7]
            body = raw[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
            answered = raw[7] == 0x55
            if answered is answers and (body or not answered):
                yield Packet(raw[4], -1 if answered else raw[7], body[0] if answered else 0, body[answered:], raw)


_LONGEST = 512


def _feetech(servo: int, code: int, data: bytes) -> bytes:
    body = bytes([servo, len(data) + 2, code]) + data
    return b"\xff\xff" + body + bytes([_checksum(body)])


def _checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF


def _dynamixel(servo: int, code: int, data: bytes) -> bytes:
    stuffed = (bytes([code]) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = b"\xff\xff\xfd\x00" + bytes([servo]) + _words(len(stuffed) + 2) + stuffed
    return packet + _words(crc16(packet))


def _words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "little") for value in values)


def crc16(data: bytes) -> int:
    """CRC-16 with polynomial 8005h, nothing reflected, from 0."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC[crc >> 8 ^ byte]
    return crc


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return table


_CRC = _crc_table()


def _drop_to(buffer: bytearray, head: bytes) -> None:
    """Drop everything before the head; what may be its beginning stays."""
    at = buffer.find(head)
    if at < 0:
        at = next(
            (len(buffer) - n for n in range(min(len(head) - 1, len(buffer)), 0, -1) if buffer.endswith(head[:n])),
            len(buffer),
        )
    del buffer[:at]


WIRES: Mapping[str, Wire] = {"feetech": Feetech(), "dynamixel": Dynamixel()}
