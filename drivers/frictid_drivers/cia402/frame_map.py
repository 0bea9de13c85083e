"""Which frame carries what: the one description by which live frames and logged frames are decoded alike.

A ``FrameMap`` is compiled from the mapping that was read back from the drives and travels as plain values in the
manifest of a run; for a log of other origin it is written by hand::

    schema: frictid.frames/1
    sync_cob_id: 128
    joints:
      "1":
        node: 2
        position_rad_per_unit: 4.793689960306688e-07
        velocity_rad_s_per_unit: 1.0471975511965977e-06
        torque_nm_per_unit: 0.2131
        reports:
        - cob_id: 386
          objects: ["6041:00 u16", "6064:00 i32", "6077:00 i16"]
        - cob_id: 642
          objects: ["606C:00 i32", "2401:00 i16 external_torque"]
        commands:
        - cob_id: 514
          objects: ["6040:00 u16", "607A:00 i32", "60B2:00 i16"]

Objects of CiA 402 have their meaning by index; any other takes the meaning that follows its type, and without one it
is skipped. Factors are on the joint side of the gear and carry the joint's direction as their sign.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from frictid_drivers.cia402.objects import FIGURES, Entry, IntegerType
from frictid_drivers.cia402.scale import Scale
from frictid_drivers.cia402.settings import JointSettings
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup

SCHEMA = "frictid.frames/1"


@dataclass(frozen=True, slots=True)
class Frame:
    """One PDO: identifier and what is in it, in order."""

    cob_id: int
    entries: tuple[Entry, ...]

    @property
    def types(self) -> tuple[IntegerType, ...]:
        """Types of the entries."""
        return tuple(entry.type for entry in self.entries)

    @property
    def meanings(self) -> tuple[str, ...]:
        """Meanings of the entries."""
        return tuple(entry.meaning for entry in self.entries)

    @property
    def size(self) -> int:
        """Data bytes."""
        return (sum(entry.type.bits for entry in self.entries) + 7) // 8


@dataclass(frozen=True, slots=True)
class JointFrames:
    """The frames of one joint and what their integers are worth."""

    name: str
    node: int  # CANopen node id; its EMCY and heartbeat are those of this joint
    position_rad_per_unit: float  # of 6064 and 607A
    velocity_rad_s_per_unit: float = math.nan  # of 606C and 60FF
    torque_nm_per_unit: float = math.nan  # of 6077, 6071 and 60B2
    external_torque_nm_per_unit: float = math.nan
    temperature_c_per_unit: float = math.nan
    reports: tuple[Frame, ...] = ()
    commands: tuple[Frame, ...] = ()


def joint_frames(
    joint: JointSetup, scale: Scale, settings: JointSettings, reports: Sequence[Frame], commands: Sequence[Frame]
) -> JointFrames:
    """The frames of a joint of the robot file."""
    figures = (scale.position_rad, scale.velocity_rad_s, scale.torque_nm)
    sensors = (settings.external_torque_nm_per_unit, settings.temperature_c_per_unit)
    return JointFrames(joint.name, joint.address, *figures, *sensors, tuple(reports), tuple(commands))


@dataclass(frozen=True, slots=True)
class FrameMap:
    """All frames of a robot."""

    joints: tuple[JointFrames, ...]  # in the order of the robot file
    # Identifier of SYNC, which begins a row; None: a row begins where a report comes a second time.
    sync_cob_id: int | None = 0x80
    window_ns: int = 0  # a report that comes later than this after SYNC belongs to the next row; 0: no such bound
    host_node: int = 0  # node id of the host's own heartbeat; 0 where unknown

    def to_mapping(self) -> dict[str, Any]:
        """Plain values for YAML or JSON; ``from_mapping`` gives back an equal map."""
        return {
            "schema": SCHEMA,
            "sync_cob_id": self.sync_cob_id,
            "window_ns": self.window_ns,
            "host_node": self.host_node,
            "joints": {joint.name: _joint_mapping(joint) for joint in self.joints},
        }

    @staticmethod
    def from_mapping(mapping: Mapping[str, Any]) -> FrameMap:
        """Read plain values, from a manifest or written by hand; ``InvalidFields`` with every field that is wrong."""
        return _Reader().frame_map(mapping)


def _joint_mapping(joint: JointFrames) -> dict[str, Any]:
    plain: dict[str, Any] = {"node": joint.node}
    for key in FIGURES.values():
        factor = getattr(joint, key)
        if not math.isnan(factor):
            plain[key] = factor
    for key, frames in (("reports", joint.reports), ("commands", joint.commands)):
        plain[key] = [{"cob_id": frame.cob_id, "objects": [str(entry) for entry in frame.entries]} for frame in frames]
    return plain


class _Reader:
    """Collects every problem of a mapping instead of stopping at the first."""

    def __init__(self) -> None:
        self._problems: list[FieldProblem] = []

    def frame_map(self, mapping: Mapping[str, Any]) -> FrameMap:
        self._known_keys((), mapping, {"schema", "sync_cob_id", "window_ns", "host_node", "joints"})
        if mapping.get("schema") != SCHEMA:
            self._problem(("schema",), f"expected {SCHEMA}, found {mapping.get('schema')!r}")
        if (sync := mapping.get("sync_cob_id", 0x80)) is not None:
            sync = self._integer(("sync_cob_id",), sync, 0, 0x7FF)
        window_ns = self._integer(("window_ns",), mapping.get("window_ns", 0), 0, 2**63)
        host_node = self._integer(("host_node",), mapping.get("host_node", 0), 0, 127)
        joints = mapping.get("joints")
        if not isinstance(joints, Mapping) or not joints:
            self._problem(("joints",), "expected at least one joint")
            joints = {}
        read = tuple(self._joint(str(name), joint) for name, joint in joints.items())
        seen: dict[int, str] = {}
        for joint in read:
            ids = [frame.cob_id for frame in (*joint.reports, *joint.commands)]
            for cob_id in ids:
                other = seen.setdefault(cob_id, joint.name)
                if other != joint.name or ids.count(cob_id) > 1:
                    self._problem(("joints", joint.name), f"COB-ID {cob_id:#05x} is described twice (joint {other})")
        if self._problems:
            raise InvalidFields(self._problems)
        return FrameMap(read, sync, window_ns, host_node)

    def _joint(self, name: str, mapping: Any) -> JointFrames:
        path = ("joints", name)
        if not isinstance(mapping, Mapping):
            self._problem(path, "expected a mapping with node, factors, reports and commands")
            return JointFrames(name, 1, 1.0)
        self._known_keys(path, mapping, {"node", "reports", "commands", *FIGURES.values()})
        if "position_rad_per_unit" not in mapping:
            self._problem((*path, "position_rad_per_unit"), "missing: radians of the joint per unit of 6064")
        factors = {
            key: self._factor((*path, key), mapping[key]) for key in FIGURES.values() if mapping.get(key) is not None
        }
        factors.setdefault("position_rad_per_unit", 1.0)
        reports = self._frames((*path, "reports"), mapping.get("reports", ()))
        for meaning in (meaning for frame in reports for meaning in frame.meanings):
            key = FIGURES.get(meaning)
            if key and key not in factors:
                self._problem((*path, key), f"missing: what a unit of the reported {meaning} is worth")
        return JointFrames(
            name=name,
            node=self._integer((*path, "node"), mapping.get("node"), 1, 127),
            reports=reports,
            commands=self._frames((*path, "commands"), mapping.get("commands", ())),
            **factors,
        )

    def _frames(self, path: tuple[str | int, ...], value: Any) -> tuple[Frame, ...]:
        if not isinstance(value, Sequence) or isinstance(value, str):
            self._problem(path, "expected a list of frames, each with cob_id and objects")
            return ()
        frames = []
        for at, item in enumerate(value):
            here = (*path, at)
            if not isinstance(item, Mapping) or set(item) != {"cob_id", "objects"}:
                self._problem(here, "expected exactly cob_id and objects")
                continue
            entries = []
            texts = item["objects"] if isinstance(item["objects"], Sequence) else ()
            for entry_at, text in enumerate(texts):
                try:
                    entries.append(Entry.parse(str(text)))
                except ValueError as error:
                    self._problem((*here, "objects", entry_at), str(error))
            frame = Frame(self._integer((*here, "cob_id"), item["cob_id"], 1, 0x7FF), tuple(entries))
            if not 1 <= frame.size <= 64:
                self._problem((*here, "objects"), f"{frame.size} bytes; a PDO carries 1..8, as a CAN FD frame 1..64")
            frames.append(frame)
        return tuple(frames)

    def _integer(self, path: tuple[str | int, ...], value: Any, low: int, high: int) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self._problem(path, f"expected a whole number {low}..{high}, found {value!r}")
            return low
        return value

    def _factor(self, path: tuple[str | int, ...], value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value == 0:
            self._problem(path, f"expected a finite factor other than 0, found {value!r}")
            return 1.0
        return float(value)

    def _known_keys(self, path: tuple[str | int, ...], mapping: Mapping[str, Any], known: set[str]) -> None:
        for key in mapping:
            if key not in known:
                self._problem((*path, str(key)), f"unknown key; known: {', '.join(sorted(known))}")

    def _problem(self, path: tuple[str | int, ...], message: str) -> None:
        self._problems.append(FieldProblem(path, message))
