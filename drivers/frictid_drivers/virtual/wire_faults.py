"""What becomes of the frames that pass a point of the wire: lost, late, twice, spoilt, foreign, or with wrong figures.

A point may be in front of the drives or in front of the host; frames of both directions pass it, and the identifier
says which way they go. What a report carries, and where, is learnt from the SDO traffic that maps it or reads it back.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Sequence

from frictid_drivers.virtual.faults import FOREVER_S, FRAME_KINDS, REPORT_KINDS, SERVICES, Fault
from frictid_hil.protocol.can_load import frame_bits
from frictid_hil.protocol.driver import FD_FRAME

SYNC_ID = 0x080
_SDO_ANSWER, _SDO_REQUEST = 0x580, 0x600
_WITHOUT_POWER = 0x21  # state bits of a statusword: ready to switch on

Passed = tuple[int, int, bytes]  # when a frame comes out, its identifier and its data


class FaultAtWork:
    """One fault of frames or calls: whether it is its turn."""

    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self._start_ns = -math.inf if fault.at_s is None else round(fault.at_s * 1e9)
        self._end_ns = round(min(fault.begin_s + fault.for_s, FOREVER_S) * 1e9)
        self._passed = 0
        self.done = 0  # how many frames or calls it has spoilt
        self.held: tuple[int, bytes] | None = None  # the frame that it holds back, or repeats

    def strikes(self, elapsed_ns: float) -> bool:
        """Whether the frame or call that comes now is spoilt; it is counted."""
        if not self._start_ns <= elapsed_ns < self._end_ns or self.done >= self.fault.count:
            return False
        if self._passed < self.fault.after:
            self._passed += 1
            return False
        self.done += 1
        return True


class WireFaults:
    """What becomes of each frame at a point of the wire, by faults of frames and reports; others are ignored."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self._frames = [(FaultAtWork(fault), _ids(fault)) for fault in faults if fault.kind in (*FRAME_KINDS, "abort")]
        self._reports = [WrongFigure(fault) for fault in faults if fault.kind in REPORT_KINDS]
        self._mapping = ReportMapping()
        plain = {cob_id for _, cob_ids in self._frames for cob_id in cob_ids}
        bases = (_SDO_ANSWER, _SDO_REQUEST, *(base for n in "1234" for base in SERVICES[f"tpdo{n}"]))
        plain |= {base + node for report in self._reports for node in report.fault.nodes for base in bases}
        foreign = {c for state, cob_ids in self._frames if state.fault.kind == "foreign" for c in cob_ids}
        self.foreign = frozenset(foreign | {cob_id | FD_FRAME for cob_id in foreign})
        self.cob_ids = frozenset(plain | {cob_id | FD_FRAME for cob_id in plain})

    def hear(self, can_id: int, data: bytes) -> None:
        """A frame that passes elsewhere, and may tell what reports carry."""
        if self._reports:
            self._mapping.learn(can_id & ~FD_FRAME, data)

    def through(self, now_ns: int, elapsed_ns: float, can_id: int, data: bytes) -> list[Passed]:
        """What comes out, each frame with its time on the caller's clock; ``elapsed_ns`` since first SYNC, or -1."""
        plain = can_id & ~FD_FRAME
        if self._reports:
            self._mapping.learn(plain, data)
            for report in self._reports:
                for place in self._mapping.places(plain, report.fault):
                    data = report.in_report(place, plain & 0x7F, now_ns, elapsed_ns, data)
        frames = [(now_ns, can_id, data)]
        for state, cob_ids in self._frames:
            if plain in cob_ids:
                frames = [out for frame in frames for out in spoil(state, elapsed_ns, frame)]
        return frames


def _ids(fault: Fault) -> frozenset[int]:
    return frozenset(_SDO_ANSWER + node for node in fault.nodes) if fault.kind == "abort" else fault.cob_ids


def spoil(state: FaultAtWork, elapsed_ns: float, frame: Passed) -> list[Passed]:
    """What becomes of a frame that this fault of kind ``FRAME_KINDS`` or ``abort`` concerns."""
    now_ns, can_id, data = frame
    fault = state.fault
    if fault.kind == "reorder" and state.held is not None:
        held, state.held = state.held, None
        return [frame, (now_ns, *held)]
    if not state.strikes(elapsed_ns):
        return [frame]
    match fault.kind:
        case "drop":
            return []
        case "duplicate":
            return [frame, frame]
        case "reorder":
            state.held = (can_id, data)
            return []
        case "foreign":
            state.held = state.held or (can_id, data)
            return [frame, (now_ns, *state.held)]
        case "delay":
            now_ns += round(fault.delay_s * 1e9)
        case "truncate":
            data = data[: round(fault.level)]
        case "misaddress":
            can_id += 1
        case "abort":
            data = b"\x80" + data[1:4] + fault.code.to_bytes(4, "little")
        case _:
            data = _flipped(data, state.done)
    return [(now_ns, can_id, data)]


def _flipped(data: bytes, number: int) -> bytes:
    """One bit inverted, another one each time."""
    if not data:
        return data
    bit = (number * 29) % (8 * len(data))
    spoilt = bytearray(data)
    spoilt[bit // 8] ^= 1 << bit % 8
    return bytes(spoilt)


class ReportMapping:
    """Where drives' figures stand in their reports, as the SDO traffic tells."""

    def __init__(self) -> None:
        self._cob_ids: dict[tuple[int, int], int] = {}
        self._entries: dict[tuple[int, int], dict[int, int]] = {}

    def learn(self, can_id: int, data: bytes) -> None:
        """An expedited download or the answer to an upload; anything else tells nothing."""
        node, service = can_id & 0x7F, can_id & 0x780
        if len(data) != 8 or service not in (_SDO_ANSWER, _SDO_REQUEST):
            return
        if data[0] & 0xE2 != (0x22 if service == _SDO_REQUEST else 0x42):
            return
        index, subindex = int.from_bytes(data[1:3], "little"), data[3]
        value = int.from_bytes(data[4:8], "little")
        if index & 0xFE00 == 0x1800 and subindex == 1 and not value >> 31:
            self._cob_ids[node, index & 0x1FF] = value & 0x7FF
        elif index & 0xFE00 == 0x1A00:
            entries = self._entries.setdefault((node, index & 0x1FF), {})
            entries[subindex] = value & 0xFF if subindex == 0 else value

    def places(self, can_id: int, fault: Fault) -> list[slice]:
        """The bytes of a fault's object in a report; empty where it is not there, or the node is not concerned."""
        found: list[slice] = []
        if can_id & 0x7F not in fault.nodes or not 0x180 <= can_id < 0x580:
            return found
        for (node, number), entries in self._entries.items():
            if self._cob_ids.get((node, number)) != can_id or can_id & 0x7F != node:
                continue
            bit = 0
            for subindex in range(1, entries.get(0, 0) + 1):
                entry = entries.get(subindex, 0)
                if entry >> 16 == fault.quantity:
                    found.append(slice(bit // 8, (bit + (entry & 0xFF)) // 8))
                bit += entry & 0xFF
        return found


class WrongFigure:
    """One figure that drives report, gone wrong."""

    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self._work = FaultAtWork(fault)
        self._before: dict[int, deque[tuple[int, float]]] = {}
        self._turn = False

    def applied(self, node: int, now_ns: int, elapsed_ns: float, value: float) -> float:
        """The figure as a node reports it; times as in ``WireFaults.through``."""
        before = self._before.setdefault(node, deque())
        before.append((now_ns, value))
        if self._work.strikes(elapsed_ns):
            return self._wrong(before, now_ns, value)
        if self.fault.kind != "lag":
            before.clear()
        return value

    def _wrong(self, before: deque[tuple[int, float]], now_ns: int, value: float) -> float:
        level = self.fault.level
        match self.fault.kind:
            case "freeze":
                return before[0][1]
            case "invert":
                return -value
            case "clip":
                return max(-level, min(level, value))
            case "scale":
                return value * self.fault.factor
            case "jump":
                return value + level
            case "flap":
                self._turn = not self._turn
                return int(value) & ~0x6F | _WITHOUT_POWER if self._turn else value
        due_ns = now_ns - round(self.fault.delay_s * 1e9)
        while len(before) > 1 and before[1][0] <= due_ns:
            before.popleft()
        return before[0][1]

    def in_report(self, place: slice, node: int, now_ns: int, elapsed_ns: float, data: bytes) -> bytes:
        """A report with the figure at a place of it gone wrong."""
        signed = self.fault.kind != "flap"
        value = int.from_bytes(data[place], "little", signed=signed)
        wrong = round(self.applied(node, now_ns, elapsed_ns, value))
        size: int = place.stop - place.start
        most = (1 << 8 * size - signed) - 1
        wrong = max(-most if signed else 0, min(most, wrong))
        before: bytes = data[: place.start]
        return before + wrong.to_bytes(size, "little", signed=signed) + data[place.stop :]


class OccupiedWire:
    """A wire on which frames, with the most stuff bits, take time; the lowest identifier that waits goes first."""

    def __init__(self, bits_per_s: float) -> None:
        self._bits_per_s = bits_per_s
        self._waiting: list[tuple[int, int, int, Callable[[], None]]] = []
        self._free_ns = 0

    @property
    def next_ns(self) -> float:
        """When the next frame has passed; infinite where none waits."""
        return self._passed()[0] if self._waiting else math.inf

    def put(self, now_ns: int, can_id: int, data: bytes, deliver: Callable[[], None]) -> None:
        """A frame that wants to pass."""
        bits = frame_bits(min(8, len(data))).worst
        self._waiting.append((now_ns, can_id, round(1e9 * bits / self._bits_per_s), deliver))

    def run(self, now_ns: int) -> None:
        """Deliver what has passed by now."""
        while self._waiting and (passed := self._passed())[0] <= now_ns:
            self._free_ns, at = passed
            self._waiting.pop(at)[3]()

    def _passed(self) -> tuple[int, int]:
        """When the frame that goes next has passed, and which it is."""
        begin_ns = max(self._free_ns, min(frame[0] for frame in self._waiting))
        ready = [at for at, frame in enumerate(self._waiting) if frame[0] <= begin_ns]
        first = min(ready, key=lambda at: self._waiting[at][1])
        return begin_ns + self._waiting[first][2], first


class Late:
    """Frames that wait for their time, in order."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    def put(self, due_ns: int, action: Callable[[], None]) -> None:
        """Do this then."""
        self._count += 1
        heapq.heappush(self._heap, (due_ns, self._count, action))

    @property
    def next_ns(self) -> float:
        """When the first is due; infinite where none is."""
        return self._heap[0][0] if self._heap else math.inf

    def run(self, now_ns: int) -> None:
        """Do all that is due."""
        while self._heap and self._heap[0][0] <= now_ns:
            heapq.heappop(self._heap)[2]()
