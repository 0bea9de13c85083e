"""How much of a CAN bus a layout of frames takes: bits on the wire, stuffing and inter-frame space included.

A simulated bus happily runs rates that no wire can, so the load of the *configured* layout decides.

A classical data frame with an 11-bit identifier and n data bytes has 44 + 8n bits and is followed by 3 bits of
inter-frame space. Of these, 34 + 8n bits (start of frame to CRC) are subject to stuffing: after five equal bits one
opposite bit is inserted, itself counting for the next five, so at worst every fourth bit after the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

AVERAGE_LIMIT_PERCENT = 80.0
"""Above this on average, low-priority frames (heartbeats, SDO) starve and one retransmission breaks a cycle."""

PEAK_LIMIT_PERCENT = 100.0
"""No single cycle can carry more than the wire does."""


@dataclass(frozen=True, slots=True)
class FrameBits:
    """Length of one frame on the wire, with inter-frame space.

    Attributes:
        least: without a single stuff bit.
        worst: with the most stuff bits there can be.
    """

    least: int
    worst: int


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


@dataclass(frozen=True, slots=True)
class SyncFrame:
    """A frame that follows SYNC: every ``every``-th one, beginning with SYNC number ``start``."""

    data_bytes: int
    every: int = 1
    start: int = 0


@dataclass(frozen=True, slots=True)
class BusLoad:
    """Load of a layout at one cycle rate.

    Attributes:
        cycle_hz: rate of SYNC.
        bitrate: of the bus, bit/s.
        least_bits: per cycle on average, no stuffing.
        average_bits: per cycle on average, worst stuffing.
        peak_bits: in the worst single cycle, worst stuffing.
    """

    cycle_hz: float
    bitrate: int
    least_bits: float
    average_bits: float
    peak_bits: float

    @property
    def average_percent(self) -> float:
        """Of the bus, worst stuffing."""
        return 100.0 * self.average_bits * self.cycle_hz / self.bitrate

    @property
    def least_percent(self) -> float:
        """Of the bus, no stuffing."""
        return 100.0 * self.least_bits * self.cycle_hz / self.bitrate

    @property
    def peak_percent(self) -> float:
        """Of one cycle period, the fullest cycle."""
        return 100.0 * self.peak_bits * self.cycle_hz / self.bitrate

    @property
    def fits(self) -> bool:
        """Within both limits."""
        return self.average_percent <= AVERAGE_LIMIT_PERCENT and self.peak_percent <= PEAK_LIMIT_PERCENT

    def __str__(self) -> str:
        return (
            f"{self.average_percent:.0f} % on average and {self.peak_percent:.0f} % in the fullest cycle "
            f"at {self.cycle_hz:g} Hz and {self.bitrate / 1000:g} kbit/s"
        )


def bus_load(
    frames: Iterable[SyncFrame],
    cycle_hz: float,
    bitrate: int,
    *,
    occasional: Iterable[int] = (),
    timed: Iterable[tuple[int, float]] = (),
) -> BusLoad:
    """Load of a layout.

    Args:
        frames: SYNC itself and everything that follows it.
        cycle_hz: rate of SYNC.
        bitrate: bit/s.
        occasional: data bytes of frames that are rare, but may fall into any cycle (a changed set-point of a locked
            joint): part of the peak, not of the average.
        timed: data bytes and period in seconds of frames with a timer of their own (heartbeats). They have the lowest
            priority and wait for everything else, except that one which has begun cannot be interrupted: the average
            takes all of them, the peak the longest one.
    """
    synchronous = list(frames)
    phases = math.lcm(*(frame.every for frame in synchronous))
    peak = [0] * phases
    least = average = 0.0
    for frame in synchronous:
        bits = frame_bits(frame.data_bytes)
        least += bits.least / frame.every
        average += bits.worst / frame.every
        for phase in range(frame.start % frame.every, phases, frame.every):
            peak[phase] += bits.worst
    blocking = 0
    for data_bytes, period_s in timed:
        bits = frame_bits(data_bytes)
        least += bits.least / (period_s * cycle_hz)
        average += bits.worst / (period_s * cycle_hz)
        blocking = max(blocking, bits.worst)
    rare = sum(frame_bits(data_bytes).worst for data_bytes in occasional)
    return BusLoad(cycle_hz, bitrate, least, average, float(max(peak) + rare + blocking))


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
