"""How long frames last on a CAN bus, stuffing and inter-frame space included, and which rate leaves room on it.

A classical data frame with an 11-bit identifier and n data bytes has 44 + 8n bits and is followed by 3 bits of
inter-frame space. Of these, 34 + 8n bits (start of frame to CRC) are subject to stuffing: after five equal bits one
opposite bit is inserted, itself counting for the next five, so at worst every fourth bit after the first. A 29-bit
identifier makes it 20 bits longer.

A CAN FD frame (ISO 11898-1) with bit-rate switch has two speeds::

    bit rate        SOF 1, identifier 11, RRS, IDE, FDF, res, BRS            17 bits
                    with a 29-bit identifier, SRR and 18 bits more           36 bits
    data bit rate   ESI 1, DLC 4, data 8n                                    5 + 8n
                    stuff count 4, CRC 17 (21 above 16 bytes)                21 or 25
                    fixed stuff bits: before the stuff count, then
                    after every fourth bit                                   6 or 7
    bit rate        CRC delimiter, acknowledgement 2, end 7, space 3         13

Start of frame to the last data bit are stuffed as in a classical frame; of the stuff bits at most every fourth falls
among those at the lower rate. Both bits at whose sample point the rate changes (BRS, CRC delimiter) are counted whole
at the lower rate. Times are given in bits of the arbitration rate, so that classical and FD frames add up.

Identifiers carry the flags of ``FrameSink``: bit 31 for 29-bit identifiers, bit 29 for CAN FD.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from frictid_hil.protocol.driver import EXTENDED, FD_FRAME

BUSIEST = 0.8
"""Share of a bus that frames of the cycle may take; above, one repeated frame makes the next cycle late."""

FD_SIZES: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Data bytes that a CAN FD frame can carry."""

_FD_HEAD, _FD_LONG_HEAD, _FD_TAIL = 17, 36, 13
_LONGER = 20


@dataclass(frozen=True, slots=True)
class BitRates:
    """What the wire does."""

    nominal: int  # bit/s; of arbitration, where frames are CAN FD
    data: int | None = None  # bit/s of the data of CAN FD frames; None on a classical bus

    def __str__(self) -> str:
        nominal = f"{self.nominal / 1000:g} kbit/s"
        return nominal if self.data is None else f"{nominal} (CAN FD, data at {self.data / 1000:g} kbit/s)"


@dataclass(frozen=True, slots=True)
class FrameBits:
    """Length of one frame on the wire, with inter-frame space, in bits of the arbitration rate."""

    least: float  # without a single stuff bit
    worst: float  # with the most stuff bits there can be


def frame_bits(data_bytes: int, *, extended: bool = False) -> FrameBits:
    """Bits of a classical data frame; ``ValueError`` for more than 8 bytes. ``extended``: with a 29-bit identifier."""
    if not 0 <= data_bytes <= 8:
        raise ValueError(f"a classical CAN frame carries 0..8 bytes, not {data_bytes}")
    more = _LONGER * extended + 8 * data_bytes
    stuffable, least = 34 + more, 44 + more + 3
    return FrameBits(least, least + (stuffable - 1) // 4)


def fd_size(data_bytes: int) -> int:
    """The shortest CAN FD frame that so many bytes fit into; the rest is padding. ``ValueError`` for more than 64."""
    if data_bytes > FD_SIZES[-1]:
        raise ValueError(f"a CAN FD frame carries at most 64 bytes, not {data_bytes}")
    return next(size for size in FD_SIZES if size >= data_bytes)


def fd_frame_bits(data_bytes: int, rates: BitRates, *, extended: bool = False) -> FrameBits:
    """Length of a CAN FD frame with bit-rate switch, padded to the next size that there is; see the head of this file.

    Raises:
        ValueError: more than 64 bytes, or a classical bus.
    """
    if rates.data is None:
        raise ValueError("no CAN FD frame on a classical bus")
    data_bits = 8 * fd_size(data_bytes)
    crc = 17 if data_bits <= 128 else 21
    checked = 4 + crc
    fast = 5 + data_bits + checked + -(-checked // 4)
    head = _FD_LONG_HEAD if extended else _FD_HEAD
    stuff, slow_stuff = (head + 5 + data_bits - 1) // 4, (head - 1) // 4
    share = rates.nominal / rates.data
    least = head + _FD_TAIL + fast * share
    return FrameBits(least, least + slow_stuff + (stuff - slow_stuff) * share)


def highest_rate_hz(cycle_frames: Iterable[tuple[int, int]], rates: BitRates) -> float:
    """The highest whole rate at which the frames of a cycle (identifier, data bytes) leave a fifth of the bus."""
    bits = 0.0
    for can_id, data_bytes in cycle_frames:
        extended = bool(can_id & EXTENDED)
        if can_id & FD_FRAME:
            bits += fd_frame_bits(data_bytes, rates, extended=extended).worst
        else:
            bits += frame_bits(data_bytes, extended=extended).worst
    return float(int(BUSIEST * rates.nominal / bits)) if bits else float("inf")
