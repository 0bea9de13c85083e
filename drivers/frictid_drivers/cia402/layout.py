"""Which PDO carries what, and on which SYNC: the layout of a robot's frames for one rate and one set of active joints.

==========  ===================================  ==========================================================
PDO         carries                              goes out
==========  ===================================  ==========================================================
RPDO1       6040 607A 60B2 (8 bytes)             every cycle in position mode, else when it changes
RPDO2       6060 6071 60FF (7 bytes)             every cycle in torque and velocity mode, else when it changes
TPDO1       6041 6064 6077 (8 bytes)             active joint: every SYNC; locked joint: at least every 10 ms
TPDO2       606C, force sensor (4 to 8 bytes)    together with TPDO1
TPDO3       6061 603F, temperature (3 to 5)      active joint: every 10 ms; locked joint: every sixth of those
TPDO4       60FD (4), where an interlock is on   at least every 10 ms
==========  ===================================  ==========================================================

Where frames are CAN FD and the drives' PDOs are long enough, TPDO2's content follows TPDO1's in one frame: most of a
short frame is its head, and that goes at the lower bit rate. PDOs are CAN FD frames then; SYNC, NMT, SDO, EMCY and
heartbeats stay classical.

The mapping is the same for every joint, active or locked, so that going on to the next joint changes transmission
types only, and one frame map decodes a whole run. Reports that do not come on every SYNC are spread over the SYNCs by
their start value (18xx:06, with the SYNC counter of 1019): transmission type 10 alone would let all of them answer the
same SYNC. Where a drive has no SYNC counter they do, and the load is computed so: a simulated bus runs rates that no
wire can, so the load of the configured layout decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.frame_map import Frame
from frictid_drivers.cia402.objects import Entry
from frictid_hil.protocol.can_load import BUSIEST, BitRates, FrameBits, fd_frame_bits, frame_bits

REPORT_INTERVAL_S = 0.010  # a locked joint is seen to stand still at least this often

_SLOW_FACTOR = 6
_MAX_TYPE = 240

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


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO as it shall be configured: a TPDO of the drive (``transmit``) or an RPDO, numbered from 1."""

    transmit: bool
    number: int
    frame: Frame  # its COB-ID is that of the predefined connection set
    every: int = 1  # transmission type: sent or applied on every so many SYNCs
    start: int = 0  # SYNC counter value of the first one, 0 for none


@dataclass(frozen=True, slots=True)
class NodeWish:
    """What the layout must know of one joint."""

    joint: str
    node: int
    torque_offset: bool = True  # 60B2 exists and can be mapped
    torque_target: bool = True  # 6071 likewise
    velocity_target: bool = True  # 60FF likewise
    external_torque: Entry | None = None  # vendor object of a force sensor
    temperature: Entry | None = None  # vendor object of a temperature
    digital_inputs: bool = False  # 60FD is to be reported
    error_code: bool = True  # 603F exists and can be mapped
    interpolated: bool = False  # targets go to 60C1, for interpolated position mode
    offset: od.Object = od.TORQUE_OFFSET  # 60B2 as this drive has it
    decimates: bool = True  # its PDOs take any number of SYNCs as transmission type
    supervised_s: float = 0.0  # how long the drive waits for an RPDO before it stops (1400:05); 0 where it does not


@dataclass(frozen=True, slots=True)
class Layout:
    """All frames of a robot at one rate."""

    cycle_hz: float
    active: tuple[str, ...]  # joints that report on every SYNC
    pdos: dict[str, tuple[Pdo, ...]]
    sync_overflow: int  # 1019, 0 where no SYNC counter is used
    host_heartbeat_s: float
    drive_heartbeat_s: float
    rates: BitRates  # of the bus; PDOs are CAN FD frames where it has a data rate
    # By joint, after how many cycles a command goes out again though nothing changed.
    resend_cycles: Mapping[str, int] = field(default_factory=dict)

    @property
    def fd(self) -> bool:
        """PDOs are CAN FD frames."""
        return self.rates.data is not None

    def load(self) -> BusLoad:
        """Load of this layout on its bus."""
        fd = self.fd
        frames = [SyncFrame(1 if self.sync_overflow else 0)]
        largest_command = 0
        for joint, pdos in self.pdos.items():
            commands = [pdo.frame.size for pdo in pdos if not pdo.transmit]
            largest_command = max(largest_command, *commands)
            if joint in self.active:
                frames.append(SyncFrame(max(commands), fd=fd))
            frames += [SyncFrame(pdo.frame.size, pdo.every, pdo.start, fd) for pdo in pdos if pdo.transmit]
        timed = [(1, self.host_heartbeat_s)] + [(1, self.drive_heartbeat_s)] * len(self.pdos)
        for joint, cycles in self.resend_cycles.items():
            timed += [(min(8, pdo.frame.size), cycles / self.cycle_hz) for pdo in self.pdos[joint] if not pdo.transmit]
        # Besides the active joints' commands at most one more goes out per cycle, to whichever joint needs one.
        return bus_load(frames, self.cycle_hz, self.rates, occasional=[SyncFrame(largest_command, fd=fd)], timed=timed)


def plan_layout(
    wishes: Sequence[NodeWish],
    active: Sequence[str],
    cycle_hz: float,
    *,
    sync_counter: bool,  # every drive has 1019 and 18xx:06
    host_heartbeat_s: float,
    drive_heartbeat_s: float,
    rates: BitRates,
    pdo_bytes: int = 8,  # how long the drives' PDOs may be
) -> Layout:
    """Decide every PDO, for joints of which the active ones report on every SYNC."""
    interval = max(1, min(_MAX_TYPE, math.floor(REPORT_INTERVAL_S * cycle_hz + 1e-9)))
    slow = interval * max(1, min(_SLOW_FACTOR, _MAX_TYPE // interval))
    starts = (
        _starts(wishes, interval, slow, rates, pdo_bytes) if sync_counter else {wish.joint: (0, 0) for wish in wishes}
    )
    pdos: dict[str, tuple[Pdo, ...]] = {}
    for wish in wishes:
        fast_start, slow_start = starts[wish.joint]
        often, seldom = (interval, fast_start), (slow, slow_start)
        if not wish.decimates:
            often = seldom = (1, 0)
        elif wish.joint in active:
            # The same SYNCs as when it is locked, more often: no other joint's start value has to change.
            often, seldom = (1, 0), (interval, (slow_start - 1) % interval + 1 if interval > 1 and slow_start else 0)
        pdos[wish.joint] = _pdos(wish, pdo_bytes, often, seldom)
    return Layout(
        cycle_hz=cycle_hz,
        active=tuple(joint for joint in pdos if joint in active),
        pdos=pdos,
        sync_overflow=slow if sync_counter and slow > 1 else 0,
        host_heartbeat_s=host_heartbeat_s,
        drive_heartbeat_s=drive_heartbeat_s,
        rates=rates,
        resend_cycles={
            wish.joint: max(1, math.floor(wish.supervised_s * cycle_hz / 3)) for wish in wishes if wish.supervised_s
        },
    )


def _starts(
    wishes: Sequence[NodeWish], interval: int, slow: int, rates: BitRates, pdo_bytes: int
) -> dict[str, tuple[int, int]]:
    """Start values (reports, slow report) of every joint as if all were locked; 0 where each SYNC is answered."""
    filled = [0.0] * slow  # bits in each SYNC of one turn of the counter
    fd = rates.data is not None
    fast_starts = {}
    for wish in wishes:
        pdos = _pdos(wish, pdo_bytes, (1, 0), (1, 0))
        fast = [SyncFrame(pdo.frame.size, fd=fd) for pdo in pdos if pdo.transmit and pdo.number < 3]
        bits = sum(frame.bits(rates).worst for frame in fast)
        fast_starts[wish.joint] = _take(filled, interval, bits) if interval > 1 else 0
    # The slow ones go where the others left room.
    bits = SyncFrame(5, fd=fd).bits(rates).worst
    return {wish.joint: (fast_starts[wish.joint], _take(filled, slow, bits) if slow > 1 else 0) for wish in wishes}


def _take(filled: list[float], every: int, bits: float) -> int:
    """The start value, from 1, that leaves the fullest SYNC least full."""
    start = min(range(every), key=lambda first: max(filled[first::every]))
    for slot in range(start, len(filled), every):
        filled[slot] += bits
    return start + 1


def _pdos(wish: NodeWish, pdo_bytes: int, often: tuple[int, int], seldom: tuple[int, int]) -> tuple[Pdo, ...]:
    """With transmission type and start value of the reports that come often, and of those that come seldom."""
    node, of = wish.node, Entry.of
    command = [of(od.CONTROLWORD), of(od.INTERPOLATED_TARGET if wish.interpolated else od.TARGET_POSITION)]
    other = [of(od.MODE)]
    short_offset = wish.offset.type.bits == 16
    if wish.torque_offset:
        # Beside the position where it fits a frame, else with the mode, which goes out whenever it changes.
        (command if short_offset else other).append(of(wish.offset))
    if wish.torque_target:
        other.append(of(od.TARGET_TORQUE))
    if wish.velocity_target and short_offset:  # 6060, 6071, 60FF and 60B2 of 32 bits are too much
        other.append(of(od.TARGET_VELOCITY))
    fast = [of(od.STATUSWORD), of(od.POSITION_ACTUAL), of(od.TORQUE_ACTUAL)]
    velocity = [of(od.VELOCITY_ACTUAL), *([wish.external_torque] if wish.external_torque else [])]
    display = [of(od.MODE_DISPLAY), *([of(od.ERROR_CODE)] if wish.error_code else [])]
    display += [wish.temperature] if wish.temperature else []
    pdos = [
        Pdo(False, 1, Frame(0x200 + node, tuple(command))),
        Pdo(False, 2, Frame(0x300 + node, tuple(other))),
        Pdo(True, 1, Frame(0x180 + node, tuple(fast)), *often),
        Pdo(True, 2, Frame(0x280 + node, tuple(velocity)), *often),
        Pdo(True, 3, Frame(0x380 + node, tuple(display)), *seldom),
    ]
    whole = Frame(0x180 + node, tuple(fast + velocity))
    if whole.size <= pdo_bytes:
        pdos[2:4] = [Pdo(True, 1, whole, *often)]
    if wish.digital_inputs:
        # As often as a locked joint reports: an active joint's inputs go with its slow report, others with the fast.
        inputs = Frame(0x480 + node, (of(od.DIGITAL_INPUTS),))
        pdos.append(Pdo(True, 4, inputs, *(seldom if often[0] == 1 else often)))
    return tuple(pdos)
