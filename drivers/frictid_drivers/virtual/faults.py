"""Things that go wrong on a bus and in its drives, by a schedule, the same every time.

A robot file's ``options.faults`` lists them, as does the environment variable ``FRICTID_VIRTUAL_FAULTS`` (the same list
as JSON, added to the file's); tests use the classes directly::

    options:
      faults:
        - {kind: drop, frames: tpdo1, joint: "1", at_s: 2.0, count: 3}
        - {kind: stuck_encoder, joint: "1", at_s: 4.5}

===============  ============================================  ===========================================
kind             does                                          fields besides ``at_s`` and ``joint``
===============  ============================================  ===========================================
drop             frames vanish                                 frames, for_s, count
delay            frames come late                              frames, for_s, count, delay_s
duplicate        frames come twice                             frames, for_s, count
reorder          a frame comes after the next of its kind      frames, for_s, count
corrupt          one bit of a frame is inverted                frames, for_s, count
mute             the node neither hears nor speaks             for_s
emcy             the drive warns                               code
fault            the drive faults                              code
reset            the drive resets, as after a power failure
stuck_encoder    the drive reports the same position for ever
blocked          the brake stays closed                        for_s
interlock_open   the interlock input opens (60FDh bit 3)       for_s
missing          the drive has no such object, from the start  index
left_in_fault    the drive is found in fault, as after a run   code
                 that was cut off (8130h unless told)
===============  ============================================  ===========================================

``at_s`` counts from the first SYNC. ``frames`` is ``sync``, ``host_heartbeat``, ``sdo``, ``emcy``, ``heartbeat`` or
``rpdo1`` to ``tpdo4``; without ``joint`` it means that of every joint.
"""

from __future__ import annotations

import heapq
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from frictid_hil.errors import UsageError
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import FD_FRAME
from frictid_hil.simulation.fields import Fields

FRAME_KINDS = ("drop", "delay", "duplicate", "reorder", "corrupt")
DRIVE_KINDS = (
    "mute",
    "emcy",
    "fault",
    "reset",
    "stuck_encoder",
    "blocked",
    "interlock_open",
    "missing",
    "left_in_fault",
)
SERVICES: dict[str, tuple[int, ...]] = {
    "sync": (0x080,),
    "emcy": (0x080,),
    "sdo": (0x600, 0x580),
    "heartbeat": (0x700,),
    "host_heartbeat": (0x700,),
} | {
    f"{direction}pdo{number}": (base + 0x100 * number,)
    for direction, base in (("t", 0x080), ("r", 0x100))
    for number in (1, 2, 3, 4)
}
"""COB-IDs of the predefined connection set, node 0."""

_HOST_NODES = range(0x40, 0x80)
_FOREVER_S = 1e9
_NO_LIMIT = 10**9


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong; see the module's table.

    Attributes:
        kind: what.
        at_s: when, after the first SYNC.
        for_s: how long.
        count: how many frames.
        joints: whose.
        cob_ids: which frames.
        delay_s: how late.
        code: EMCY code.
        index: object.
    """

    kind: str
    at_s: float = 0.0
    for_s: float = _FOREVER_S
    count: int = _NO_LIMIT
    joints: tuple[str, ...] = ()
    cob_ids: frozenset[int] = frozenset()
    delay_s: float = 0.0
    code: int = 0
    index: int = 0


ENVIRONMENT = "FRICTID_VIRTUAL_FAULTS"


def faults_of(setup: RobotSetup) -> tuple[Fault, ...]:
    """The faults of a robot file and of the environment.

    Raises:
        InvalidFields: what is wrong with the robot file's.
        UsageError: the environment's are not JSON.
    """
    text = os.environ.get(ENVIRONMENT, "")
    try:
        further = json.loads(text) if text else None
    except ValueError as error:
        raise UsageError(f"not JSON: {error}", where=ENVIRONMENT) from None
    return read_faults(setup.options.get("faults"), setup) + read_faults(further, setup)


def read_faults(rows: Any, setup: RobotSetup) -> tuple[Fault, ...]:
    """The faults of a robot file.

    Args:
        rows: the list under ``options.faults``; None for none.
        setup: whose joints it names.

    Raises:
        InvalidFields: what is wrong, by ``options.faults.N.KEY``.
    """
    top = Fields({})
    top.path = ("options", "faults")
    faults: list[Fault] = []
    if not isinstance(rows, Sequence | None) or isinstance(rows, str):
        top.problem("", f"expected a list of faults, found {rows!r}")
        rows = None
    for number, row in enumerate(rows or ()):
        fields = Fields(row, ("options", "faults", number), top.problems)
        kind = fields.choice("kind", "", FRAME_KINDS + DRIVE_KINDS)
        names = tuple(joint.name for joint in setup.joints)
        joint = fields.choice("joint", "", ("", *names))
        service = fields.choice("frames", "", ("", *SERVICES))
        if kind in FRAME_KINDS and not service:
            fields.problem("frames", f"is required: one of {', '.join(SERVICES)}")
        joints = (joint,) if joint else names
        faults.append(
            Fault(
                kind=kind,
                at_s=fields.number("at_s", 0.0, low=0.0),
                for_s=fields.number("for_s", _FOREVER_S, low=0.0),
                count=round(fields.number("count", _NO_LIMIT, low=1.0)),
                joints=joints,
                cob_ids=_cob_ids(service, [setup.joint(name).address for name in joints]) if service else frozenset(),
                delay_s=fields.number("delay_s", 0.0, low=0.0),
                code=round(fields.number("code", 0x8130 if kind == "left_in_fault" else 0x5000, low=1.0, high=0xFFFF)),
                index=round(fields.number("index", 0.0, low=0.0, high=0xFFFF)),
            )
        )
        fields.no_others()
    top.finish()
    return tuple(faults)


def _cob_ids(service: str, nodes: list[int]) -> frozenset[int]:
    if service == "sync":
        return frozenset(SERVICES[service])
    if service == "host_heartbeat":
        return frozenset(0x700 + node for node in _HOST_NODES)
    return frozenset(base + node for base in SERVICES[service] for node in nodes)


def missing_objects(faults: Sequence[Fault]) -> Mapping[str, frozenset[int]]:
    """Objects that drives do not have, by joint."""
    found: dict[str, frozenset[int]] = {}
    for fault in faults:
        if fault.kind == "missing":
            for joint in fault.joints:
                found[joint] = found.get(joint, frozenset()) | {fault.index}
    return found


class _FrameFault:
    """One frame fault at work: how many frames it has spoilt, and the one it holds back."""

    def __init__(self, fault: Fault) -> None:
        self.fault = fault
        self.start_ns = round(fault.at_s * 1e9)
        self.end_ns = round(min(fault.at_s + fault.for_s, _FOREVER_S) * 1e9)
        self.done = 0
        self.held: tuple[int, bytes] | None = None


class FrameFaults:
    """What becomes of each frame that passes a point of the wire.

    Args:
        faults: those of frames; others are ignored.
    """

    def __init__(self, faults: Sequence[Fault]) -> None:
        self._faults = [_FrameFault(fault) for fault in faults if fault.kind in FRAME_KINDS]
        plain = {cob_id for state in self._faults for cob_id in state.fault.cob_ids}
        self.cob_ids = frozenset(plain | {cob_id | FD_FRAME for cob_id in plain})

    def through(self, now_ns: int, can_id: int, data: bytes) -> list[tuple[int, int, bytes]]:
        """The frames that come out, each with the time at which it does.

        Args:
            now_ns: time since the first SYNC.
            can_id: of the frame that goes in.
            data: of the frame that goes in.
        """
        frames = [(now_ns, can_id, data)]
        for state in self._faults:
            if can_id & ~FD_FRAME in state.fault.cob_ids:
                frames = [out for frame in frames for out in _spoil(state, frame)]
        return frames


def _spoil(state: _FrameFault, frame: tuple[int, int, bytes]) -> list[tuple[int, int, bytes]]:
    now_ns, can_id, data = frame
    fault = state.fault
    if state.held is not None:
        held, state.held = state.held, None
        return [frame, (now_ns, *held)]
    if not state.start_ns <= now_ns < state.end_ns or state.done >= fault.count:
        return [frame]
    state.done += 1
    if fault.kind == "drop":
        return []
    if fault.kind == "delay":
        return [(now_ns + round(fault.delay_s * 1e9), can_id, data)]
    if fault.kind == "duplicate":
        return [frame, frame]
    if fault.kind == "reorder":
        state.held = (can_id, data)
        return []
    return [(now_ns, can_id, _flipped(data, state.done))]


def _flipped(data: bytes, number: int) -> bytes:
    """One bit inverted, another one each time."""
    if not data:
        return data
    bit = (number * 29) % (8 * len(data))
    spoilt = bytearray(data)
    spoilt[bit // 8] ^= 1 << bit % 8
    return bytes(spoilt)


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
