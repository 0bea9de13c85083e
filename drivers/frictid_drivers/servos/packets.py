"""Packets of both makers: bytes to packets and back. A stream may begin anywhere and hold any garbage."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

BROADCAST = 0xFE
READ, WRITE, SYNC_READ, SYNC_WRITE = 0x02, 0x03, 0x82, 0x83  # instructions of both makers


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet, checked."""

    id: int  # of the servo that it is for, or from
    instruction: int  # code; -1 in an answer
    error: int  # of an answer
    data: bytes  # parameters
    raw: bytes  # as on the wire


class Wire(ABC):
    """How one maker puts bytes on the line."""

    name: ClassVar[str]
    answer_overhead: ClassVar[int]  # bytes of an answer beside its data
    word: ClassVar[int]  # bytes of an address, of a count and of the check at the end
    _head: ClassVar[bytes]

    def read(self, servo: int, address: int, count: int) -> bytes:
        """Ask one servo."""
        return self._packet(servo, READ, self._words(address, count))

    def write(self, servo: int, address: int, data: bytes) -> bytes:
        """Tell one servo."""
        return self._packet(servo, WRITE, self._words(address) + data)

    def sync_read(self, servos: Sequence[int], address: int, count: int) -> bytes:
        """Ask several; they answer one after another."""
        return self._packet(BROADCAST, SYNC_READ, self._words(address, count) + bytes(servos))

    def sync_write(self, address: int, data: Mapping[int, bytes]) -> bytes:
        """Tell several the same number of bytes each; nobody answers."""
        told = b"".join(bytes([servo]) + part for servo, part in data.items())
        return self._packet(BROADCAST, SYNC_WRITE, self._words(address, len(next(iter(data.values())))) + told)

    @abstractmethod
    def answer(self, servo: int, error: int, data: bytes) -> bytes:
        """What a servo says."""

    def parse(self, buffer: bytearray, *, answers: bool) -> Iterator[Packet]:
        """Whole packets, taken off the buffer; what cannot be the beginning of one is dropped.

        Args:
            buffer: left with what may still become a packet.
            answers: the line brings answers, not instructions.
        """
        while True:
            _drop_to(buffer, self._head)
            size = self._size(buffer)
            if size > len(buffer):
                return
            raw = bytes(buffer[:size])
            if not raw or raw[-self.word :] != self._check(raw[: -self.word]):
                del buffer[0]
                continue
            del buffer[:size]
            packet = self._parsed(raw, answers)
            if packet is not None:
                yield packet

    @abstractmethod
    def _packet(self, servo: int, code: int, data: bytes) -> bytes: ...

    @abstractmethod
    def _size(self, buffer: bytearray) -> int:
        """Of the packet at the beginning of the buffer, or the least that tells it; 0 where there is none."""

    @abstractmethod
    def _check(self, packet: bytes) -> bytes:
        """The check of all that comes before it."""

    @abstractmethod
    def _parsed(self, raw: bytes, answers: bool) -> Packet | None: ...

    def _words(self, *values: int) -> bytes:
        return b"".join(value.to_bytes(self.word, "little") for value in values)


class Feetech(Wire):
    """FF FF id length instruction-or-error data checksum; the checksum is the inverted sum from id on."""

    name = "feetech"
    answer_overhead = 6
    word = 1
    _head = b"\xff\xff"

    def answer(self, servo: int, error: int, data: bytes) -> bytes:
        """As ``Wire.answer``."""
        return self._packet(servo, error, data)

    def _packet(self, servo: int, code: int, data: bytes) -> bytes:
        packet = self._head + bytes([servo, len(data) + 2, code]) + data
        return packet + self._check(packet)

    def _size(self, buffer: bytearray) -> int:
        if len(buffer) < 4:
            return 4
        return 0 if buffer[2] == 0xFF or buffer[3] < 2 else buffer[3] + 4

    def _check(self, packet: bytes) -> bytes:
        return bytes([~sum(packet[2:]) & 0xFF])

    def _parsed(self, raw: bytes, answers: bool) -> Packet | None:
        return Packet(raw[2], -1 if answers else raw[4], raw[4] if answers else 0, raw[5:-1], raw)


class Dynamixel(Wire):
    """Protocol 2.0: FF FF FD 00 id length16 instruction [error] data crc16, with an FD stuffed after every FF FF FD."""

    name = "dynamixel"
    answer_overhead = 11
    word = 2
    _head = b"\xff\xff\xfd\x00"

    def answer(self, servo: int, error: int, data: bytes) -> bytes:
        """As ``Wire.answer``."""
        return self._packet(servo, _ANSWER, bytes([error]) + data)

    def _packet(self, servo: int, code: int, data: bytes) -> bytes:
        stuffed = (bytes([code]) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = self._head + bytes([servo]) + self._words(len(stuffed) + 2) + stuffed
        return packet + self._check(packet)

    def _size(self, buffer: bytearray) -> int:
        if len(buffer) < 7:
            return 7
        length = buffer[5] | buffer[6] << 8
        return length + 7 if 3 <= length <= _LONGEST else 0

    def _check(self, packet: bytes) -> bytes:
        """CRC-16 with polynomial 8005h, nothing reflected, from 0."""
        crc = 0
        for byte in packet:
            crc = (crc << 8 & 0xFFFF) ^ _CRC[crc >> 8 ^ byte]
        return self._words(crc)

    def _parsed(self, raw: bytes, answers: bool) -> Packet | None:
        body = raw[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        answered = raw[7] == _ANSWER
        if answered is not answers or (answered and not body):
            return None
        return Packet(raw[4], -1 if answered else raw[7], body[0] if answered else 0, body[answered:], raw)


_ANSWER = 0x55
_LONGEST = 512


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
