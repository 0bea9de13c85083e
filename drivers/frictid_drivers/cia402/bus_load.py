"""How much of a CAN bus a layout of SYNC, PDOs and heartbeats takes; ``protocol.can_load`` has each frame's length.

A simulated bus happily runs rates that no wire can, so the load of the *configured* layout decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from frictid_hil.protocol.can_load import BUSIEST, BitRates, FrameBits, fd_frame_bits, frame_bits

AVERAGE_LIMIT_PERCENT = 100.0 * BUSIEST
"""Above this on average, low-priority frames (heartbeats, SDO) starve and one retransmission breaks a cycle."""

PEAK_LIMIT_PERCENT = 100.0  # no single cycle can carry more than the wire does


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
    """Load of a layout at one cycle rate."""

    cycle_hz: float
    rates: BitRates
    least_bits: float  # per cycle on average, no stuffing, in bits of the arbitration rate like all that follow
    average_bits: float  # per cycle on average, worst stuffing
    peak_bits: float  # in the worst single cycle, worst stuffing

    @property
    def average_percent(self) -> float:
        """Of the bus, worst stuffing."""
        return 100.0 * self.average_bits * self.cycle_hz / self.rates.nominal

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
    frames: Iterable[SyncFrame],  # SYNC itself and everything that follows it
    cycle_hz: float,  # rate of SYNC
    rates: BitRates,  # of the bus
    *,
    # Frames that are rare, but may fall into any cycle (a changed set-point of a locked joint): part of the peak,
    # not of the average.
    occasional: Iterable[SyncFrame] = (),
    # Data bytes and period in seconds of classical frames with a timer of their own (heartbeats). They have the
    # lowest priority and wait for everything else, except that one which has begun cannot be interrupted: the
    # average takes all of them, the peak the longest one.
    timed: Iterable[tuple[int, float]] = (),
) -> BusLoad:
    """Load of a layout."""
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
    """The highest whole rate up to ``start_hz`` that fits, 0 for none; from above, since the layout depends on it."""
    rate_hz = float(int(start_hz))
    while rate_hz >= 1.0:
        load = load_at(rate_hz)
        if load.fits:
            return rate_hz
        scale = min(AVERAGE_LIMIT_PERCENT / load.average_percent, PEAK_LIMIT_PERCENT / load.peak_percent)
        rate_hz = float(min(int(rate_hz * scale), int(rate_hz) - 1))
    return 0.0
