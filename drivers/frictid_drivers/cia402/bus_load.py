"""How much of a CAN bus a layout of frames takes: time on the wire, stuffing and inter-frame space included.

A simulated bus happily runs rates that no wire can, so the load of the *configured* layout decides.

A classical data frame with an 11-bit identifier and n data bytes has 44 + 8n bits and is followed by 3 bits of
inter-frame space. Of these, 34 + 8n bits (start of frame to CRC) are subject to stuffing: after five equal bits one
opposite bit is inserted, itself counting for the next five, so at worst every fourth bit after the first.

A CAN FD frame (ISO 11898-1) with bit-rate switch has two speeds::

    bit rate        SOF 1, identifier 11, RRS, IDE, FDF, res, BRS            17 bits
    data bit rate   ESI 1, DLC 4, data 8n                                    5 + 8n
                    stuff count 4, CRC 17 (21 above 16 bytes)                21 or 25
                    fixed stuff bits: before the stuff count, then
                    after every fourth bit                                   6 or 7
    bit rate        CRC delimiter, acknowledgement 2, end 7, space 3         13

Start of frame to the last data bit, 22 + 8n bits, are stuffed as in a classical frame; of the stuff bits at most four
fall among the first 17. Both bits at whose sample point the rate changes (BRS, CRC delimiter) are counted whole at the
lower rate. Times are given in bits of the arbitration rate, so that classical and FD frames add up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

AVERAGE_LIMIT_PERCENT = 80.0
"""Above this on average, low-priority frames (heartbeats, SDO) starve and one retransmission breaks a cycle."""

PEAK_LIMIT_PERCENT = 100.0
"""No single cycle can carry more than the wire does."""


FD_SIZES: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Data bytes that a CAN FD frame can carry."""

_FD_HEAD, _FD_TAIL = 17, 13
_FD_HEAD_STUFF = (_FD_HEAD - 1) // 4


@dataclass(frozen=True, slots=True)
class BitRates:
    """What the wire does.

    Attributes:
        nominal: bit/s; of arbitration, where frames are CAN FD.
        data: bit/s of the data of CAN FD frames; None on a classical bus.
    """

    nominal: int
    data: int | None = None

    def __str__(self) -> str:
        nominal = f"{self.nominal / 1000:g} kbit/s"
        return nominal if self.data is None else f"{nominal} (CAN FD, data at {self.data / 1000:g} kbit/s)"


@dataclass(frozen=True, slots=True)
class FrameBits:
    """Length of one frame on the wire, with inter-frame space, in bits of the arbitration rate.

    Attributes:
        least: without a single stuff bit.
        worst: with the most stuff bits there can be.
    """

    least: float
    worst: float


def frame_bits(data_bytes: int) -> FrameBits:
    """Bits of a classical 11-bit-identifier data frame.

    Args:
        data_bytes: 0 to 8.

    Raises:
        ValueError: not a classical frame.
    """
    if not 0 <= data_bytes <= 8:
        raise ValueError(f"a classical CAN frame carries 0..8 bytes, not {data_bytes}")
    stuffable = 34 + 8 * data_bytes
    least = 44 + 8 * data_bytes + 3
    return FrameBits(least, least + (stuffable - 1) // 4)


def fd_size(data_bytes: int) -> int:
    """The shortest CAN FD frame that so many bytes fit into; the rest is padding.

    Raises:
        ValueError: more than 64.
    """
    for size in FD_SIZES:
        if data_bytes <= size:
            return size
    raise ValueError(f"a CAN FD frame carries at most 64 bytes, not {data_bytes}")


def fd_frame_bits(data_bytes: int, rates: BitRates) -> FrameBits:
    """Length of a CAN FD frame with an 11-bit identifier and bit-rate switch; see the head of this file.

    Args:
        data_bytes: as mapped; padded to the next size that there is.
        rates: both.

    Raises:
        ValueError: more than 64 bytes, or a classical bus.
    """
    if rates.data is None:
        raise ValueError("no CAN FD frame on a classical bus")
    data_bits = 8 * fd_size(data_bytes)
    crc = 17 if data_bits <= 128 else 21
    checked = 4 + crc
    fast = 5 + data_bits + checked + -(-checked // 4)
    stuff = (_FD_HEAD + 5 + data_bits - 1) // 4
    share = rates.nominal / rates.data
    least = _FD_HEAD + _FD_TAIL + fast * share
    return FrameBits(least, least + _FD_HEAD_STUFF + (stuff - _FD_HEAD_STUFF) * share)


@dataclass(frozen=True, slots=True)
class SyncFrame:
    """A frame that follows SYNC: every ``every``-th one, beginning with SYNC number ``start``; ``fd``: a CAN FD one."""

    data_bytes: int
    every: int = 1
    start: int = 0
    fd: bool = False

    def bits(self, rates: BitRates) -> FrameBits:
        """Its length on a bus."""
        return fd_frame_bits(self.data_bytes, rates) if self.fd else frame_bits(self.data_bytes)


@dataclass(frozen=True, slots=True)
class BusLoad:
    """Load of a layout at one cycle rate.

    Attributes:
        cycle_hz: rate of SYNC.
        rates: of the bus.
        least_bits: per cycle on average, no stuffing, in bits of the arbitration rate like all that follow.
        average_bits: per cycle on average, worst stuffing.
        peak_bits: in the worst single cycle, worst stuffing.
    """

    cycle_hz: float
    rates: BitRates
    least_bits: float
    average_bits: float
    peak_bits: float

    @property
    def average_percent(self) -> float:
        """Of the bus, worst stuffing."""
        return 100.0 * self.average_bits * self.cycle_hz / self.rates.nominal

    @property
    def least_percent(self) -> float:
        """Of the bus, no stuffing."""
        return 100.0 * self.least_bits * self.cycle_hz / self.rates.nominal

    @property
    def peak_percent(self) -> float:
        """Of one cycle period, the fullest cycle."""
        return 100.0 * self.peak_bits * self.cycle_hz / self.rates.nominal

    @property
    def fits(self) -> bool:
        """Within both limits."""
        return self.average_percent <= AVERAGE_LIMIT_PERCENT and self.peak_percent <= PEAK_LIMIT_PERCENT

    def __str__(self) -> str:
        return (
            f"{self.average_percent:.0f} % on average and {self.peak_percent:.0f} % in the fullest cycle "
            f"at {self.cycle_hz:g} Hz and {self.rates}"
        )


def bus_load(
    frames: Iterable[SyncFrame],
    cycle_hz: float,
    rates: BitRates,
    *,
    occasional: Iterable[SyncFrame] = (),
    timed: Iterable[tuple[int, float]] = (),
) -> BusLoad:
    """Load of a layout.

    Args:
        frames: SYNC itself and everything that follows it.
        cycle_hz: rate of SYNC.
        rates: of the bus.
        occasional: frames that are rare, but may fall into any cycle (a changed set-point of a locked joint): part of
            the peak, not of the average.
        timed: data bytes and period in seconds of classical frames with a timer of their own (heartbeats). They have
            the lowest priority and wait for everything else, except that one which has begun cannot be interrupted:
            the average takes all of them, the peak the longest one.
    """
    synchronous = list(frames)
    phases = math.lcm(*(frame.every for frame in synchronous))
    peak = [0.0] * phases
    least = average = 0.0
    for frame in synchronous:
        bits = frame.bits(rates)
        least += bits.least / frame.every
        average += bits.worst / frame.every
        for phase in range(frame.start % frame.every, phases, frame.every):
            peak[phase] += bits.worst
    blocking = 0.0
    for data_bytes, period_s in timed:
        bits = frame_bits(data_bytes)
        least += bits.least / (period_s * cycle_hz)
        average += bits.worst / (period_s * cycle_hz)
        blocking = max(blocking, bits.worst)
    rare = sum(frame.bits(rates).worst for frame in occasional)
    return BusLoad(cycle_hz, rates, least, average, max(peak) + rare + blocking)


def highest_rate_hz(load_at: Callable[[float], BusLoad], start_hz: float) -> float:
    """The highest whole rate that fits, at most ``start_hz``; 0 where none does.

    The layout itself depends on the rate (decimated frames keep their interval in time), so the rate is approached
    from above until the load fits.
    """
    rate_hz = float(int(start_hz))
    while rate_hz >= 1.0:
        load = load_at(rate_hz)
        if load.fits:
            return rate_hz
        scale = min(AVERAGE_LIMIT_PERCENT / load.average_percent, PEAK_LIMIT_PERCENT / load.peak_percent)
        rate_hz = float(min(int(rate_hz * scale), int(rate_hz) - 1))
    return 0.0
