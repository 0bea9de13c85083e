"""Things that go wrong on a bus and in its drives, by a schedule, the same every time: their one list and its schema.

A robot file's ``options.faults`` lists them, as does the environment variable ``FRICTID_VIRTUAL_FAULTS`` (the same list
as JSON, added to the file's); tests use the classes directly. In front of any other bus, a real one too, it is
``bus: faulty:socketcan:can0`` that reads ``options.faults`` (``faulty_bus``)::

    options:
      faults:
        - {kind: drop, frames: tpdo1, joint: "1", at_s: 2.0, count: 3}
        - {kind: lag, quantity: torque, delay_s: 0.006}

===============  ============================================  ===========================================
kind             does                                          fields besides ``at_s`` and ``joint``
===============  ============================================  ===========================================
on any bus: frames
-----------------------------------------------------------------------------------------------------------
drop             frames vanish                                 frames, for_s, count, after
delay            frames come late                              frames, for_s, count, after, delay_s
duplicate        frames come twice                             frames, for_s, count, after
reorder          a frame comes after the next of its kind      frames, for_s, count, after
corrupt          one bit of a frame is inverted                frames, for_s, count, after
truncate         a frame ends after ``level`` bytes            frames, for_s, count, after, level
misaddress       the next node seems to have sent it           frames, for_s, count, after
foreign          another sender repeats after each frame what  frames, for_s, count, after
                 was in the first
abort            the drive's SDO answers are aborts            for_s, count, after, code
mute             the node neither hears nor speaks             for_s
reset            the drive resets, as after a power failure
emcy             the drive warns, ``count`` times at once      code, count
on any bus: what drives report
-----------------------------------------------------------------------------------------------------------
freeze           the same figure for ever                      quantity, for_s
invert           the figure's sign is wrong                    quantity, for_s
lag              the figure is late                            quantity, for_s, delay_s
clip             the figure stays within +-``level``           quantity, for_s, level
scale            the figure times ``factor``                   quantity, for_s, factor
jump             the figure plus ``level``                     quantity, for_s, level
flap             every second statusword says: no power        for_s
on any bus: what the host's own interface does
-----------------------------------------------------------------------------------------------------------
send_error       ``send`` raises                               error, for_s, count, after
receive_error    ``recv`` raises                               error, for_s, count, after
bus_off          an error frame, then only errors              for_s
stall            the host stands still before a frame          delay_s, count, after
occupied         frames need time on a wire of ``level`` bit/s level
in simulated drives
-----------------------------------------------------------------------------------------------------------
fault            the drive faults                              code
stuck_encoder    the drive's own encoder stands for ever
blocked          the brake stays closed                        for_s
interlock_open   the interlock input opens (60FDh bit 3)       for_s
drift            the drives' clocks go ``factor`` times as     factor
                 fast as the host's
missing          the drive has no such object, from the start  index
left_in_fault    the drive is found in fault, as after a run   code
                 that was cut off (8130h unless told)
===============  ============================================  ===========================================

``at_s`` counts from the first SYNC; without it a fault is there from the beginning (those of drives: from the first
SYNC). ``after`` lets so many frames or calls pass first. ``frames`` is ``sync``, ``host_heartbeat``, ``sdo``, ``emcy``,
``heartbeat`` or ``rpdo1`` to ``tpdo4``; without ``joint`` (or ``node``, its number) it means that of every joint.
An occupied wire means something on the wall clock; in lock-step a frame that takes any time comes a cycle later.
``quantity`` is ``position``, ``velocity`` or ``torque``, and ``level`` of it is in the drive's own units. ``error`` is
``can``, ``os``, ``runtime`` or ``value``.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from frictid_hil.errors import UsageError
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.simulation.fields import Fields

FRAME_KINDS = ("drop", "delay", "duplicate", "reorder", "corrupt", "truncate", "misaddress", "foreign")
NODE_KINDS = ("abort", "mute", "reset", "emcy")
REPORT_KINDS = ("freeze", "invert", "lag", "clip", "scale", "jump", "flap")
HOST_KINDS = ("send_error", "receive_error", "bus_off", "stall", "occupied")
DRIVE_KINDS = ("fault", "stuck_encoder", "blocked", "interlock_open", "drift", "missing", "left_in_fault")
KINDS = FRAME_KINDS + NODE_KINDS + REPORT_KINDS + HOST_KINDS + DRIVE_KINDS
QUANTITIES = {"position": 0x6064, "velocity": 0x606C, "torque": 0x6077, "status": 0x6041}
"""What drives report, and the object that it is."""
ERRORS = ("can", "os", "runtime", "value")
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

FOREVER_S = 1e9
_HOST_NODES = range(0x40, 0x80)
_NO_LIMIT = 10**9


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong; see the module's table."""

    kind: str
    at_s: float | None = None  # when, after the first SYNC; None from the beginning
    for_s: float = FOREVER_S
    count: int = _NO_LIMIT  # how many frames or calls
    after: int = 0  # how many frames or calls pass first
    joints: tuple[str, ...] = ()
    nodes: tuple[int, ...] = ()  # of these joints
    frames: str = ""  # which, by name
    cob_ids: frozenset[int] = frozenset()  # and by identifier, where these are CANopen's
    delay_s: float = 0.0
    code: int = 0
    index: int = 0
    quantity: int = 0  # object of the report
    level: float = 0.0  # of the report, in the drive's units; bytes that are left; bit/s of the wire
    factor: float = 1.0  # of the report, or of the drives' clocks
    error: str = "can"

    @property
    def begin_s(self) -> float:
        """When, where it cannot be before the first SYNC."""
        return self.at_s or 0.0

    @property
    def times(self) -> int:
        """How often, where once is usual."""
        return 1 if self.count == _NO_LIMIT else self.count


ENVIRONMENT = "FRICTID_VIRTUAL_FAULTS"


def faults_of(
    setup: RobotSetup, *, kinds: tuple[str, ...] = KINDS, frames: tuple[str, ...] = tuple(SERVICES)
) -> tuple[Fault, ...]:
    """Faults of robot file and environment, of these kinds and frames; ``InvalidFields``, ``UsageError`` (no JSON)."""
    text = os.environ.get(ENVIRONMENT, "")
    try:
        further = json.loads(text) if text else None
    except ValueError as error:
        raise UsageError(f"not JSON: {error}", where=ENVIRONMENT) from None
    nodes = {joint.name: joint.address for joint in setup.joints}
    return tuple(
        fault
        for rows in (setup.options.get("faults"), further)
        for fault in read_faults(rows, nodes, kinds=kinds, frames=frames)
    )


def read_faults(
    rows: Any, nodes: Mapping[str, int], *, kinds: tuple[str, ...] = KINDS, frames: tuple[str, ...] = tuple(SERVICES)
) -> tuple[Fault, ...]:
    """The list under ``options.faults``, or None, of these joints, kinds and frames; ``InvalidFields`` by its keys."""
    top = Fields({})
    top.path = ("options", "faults")
    faults: list[Fault] = []
    if not isinstance(rows, Sequence | None) or isinstance(rows, str):
        top.problem("", f"expected a list of faults, found {rows!r}")
        rows = None
    for number, row in enumerate(rows or ()):
        fields = Fields(row, ("options", "faults", number), top.problems)
        faults.append(_fault(fields, nodes, kinds, frames))
        fields.no_others()
    top.finish()
    return tuple(faults)


def _fault(fields: Fields, known: Mapping[str, int], kinds: tuple[str, ...], frames: tuple[str, ...]) -> Fault:
    kind = fields.choice("kind", "", kinds)
    joint = fields.choice("joint", "", ("", *known))
    node = round(fields.number("node", 0.0, low=1.0, high=127.0)) if "node" in fields else 0
    service = fields.choice("frames", "", ("", *frames))
    quantity = fields.choice("quantity", "", ("", *QUANTITIES))
    if kind in FRAME_KINDS and not service:
        fields.problem("frames", f"is required: one of {', '.join(frames)}")
    if kind in REPORT_KINDS and kind != "flap" and not quantity:
        fields.problem("quantity", f"is required: one of {', '.join(QUANTITIES)}")
    if kind == "occupied" and fields.number("level", 0.0) < 1.0:
        fields.problem("level", "is required: bit/s of the wire")
    names = (joint,) if joint else tuple(name for name, number in known.items() if node in (0, number))
    nodes = tuple(known[name] for name in names) or ((node,) if node else tuple(range(1, 128)))
    usual_code = {"left_in_fault": 0x8130, "abort": 0x08000020}.get(kind, 0x5000)
    return Fault(
        kind=kind,
        at_s=fields.number("at_s", 0.0, low=0.0) if "at_s" in fields else None,
        for_s=fields.number("for_s", FOREVER_S, low=0.0),
        count=round(fields.number("count", 1 if kind in ("emcy", "stall") else _NO_LIMIT, low=1.0)),
        after=round(fields.number("after", 0.0, low=0.0)),
        joints=names,
        nodes=nodes,
        frames=service,
        cob_ids=_cob_ids(service, nodes) if service in SERVICES else frozenset(),
        delay_s=fields.number("delay_s", 0.0, low=0.0),
        code=round(fields.number("code", usual_code, low=1.0, high=0xFFFFFFFF)),
        index=round(fields.number("index", 0.0, low=0.0, high=0xFFFF)),
        quantity=QUANTITIES["status"] if kind == "flap" else QUANTITIES.get(quantity, 0),
        level=fields.number("level", 0.0),
        factor=fields.number("factor", 1.0, low=0.01 if kind == "drift" else -math.inf),
        error=fields.choice("error", "can", ERRORS),
    )


def _cob_ids(service: str, nodes: Sequence[int]) -> frozenset[int]:
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
