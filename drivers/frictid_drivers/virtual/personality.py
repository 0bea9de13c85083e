"""Families of real drives for the simulated servo: object lists, access, defaults, units, refusals, delays - as data.

``personalities.yaml`` next to this file has one entry per family, written from public manuals and EDS files; the
joint's option ``personality`` names one. The option ``eds`` makes one of anyone's EDS file: objects that it lacks are
absent, access, ranges, types, mapping and defaults are its own, and what a supplier would set up (encoder, gear, rated
torque, limits) follows the joint. Behind all of them is the same servo: what is not described here is the standard's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from frictid_drivers.virtual.objects import OBJECTS, STANDARD, DataType, Entry, Key, Manner, Record, Value, key
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup

SHIPPED = Path(__file__).with_name("personalities.yaml")
_TURN = 2.0 * math.pi
_RPM = _TURN / 60.0
_KINDS = {kind.name.lower(): kind for kind in DataType}
_SET_UP = frozenset({0x1018_04, 0x2022_01, 0x2022_02, 0x6065_00, 0x6076_00, 0x607D_01, 0x607D_02, 0x6080_00, 0x6084_00,
                     0x6085_00, 0x608F_01, 0x608F_02, 0x6091_01, 0x6091_02, 0x6092_01, 0x6092_02})  # fmt: skip
"""What the supplier of a robot sets up for each joint; the maker's defaults say nothing of it."""


@dataclass(frozen=True, slots=True)
class Personality:
    """One family."""

    records: tuple[Record, ...] = OBJECTS
    manner: Manner = STANDARD
    defaults: Mapping[Key, Value] = field(default_factory=dict)  # values that are the maker's, whatever the joint is
    position_unit_deg: float | None = None  # of 6064h; None for increments, or what 6092h says
    position_unit_of: str = "joint"  # ``joint`` or ``motor`` side
    velocity_per_position: float | None = None  # one unit of velocity in position units per second
    velocity_unit_rad_s: float | None = None  # of the motor; None for both: 60A9h says it
    knows_gear: bool = True  # 6091h is the gear's ratio, else 1:1

    def overrides(self, standard: Mapping[Key, Value]) -> dict[Key, Value]:
        """Power-on values for a joint whose standard servo would have these."""
        found = {**standard, **self.defaults}
        if not self.knows_gear:
            encoder = standard[key(0x608F, 1)], standard[key(0x608F, 2)]
            # A drive whose positions are angles leaves 6092h as the factory has it.
            feed = encoder if self.position_unit_deg is None else (1, 1)
            found |= {key(0x6091, 1): 1, key(0x6091, 2): 1, key(0x6092, 1): feed[0], key(0x6092, 2): feed[1]}
        return found

    def manner_for(self, joint: JointSetup, units_per_joint_turn: float) -> Manner:
        """With the units at this joint."""
        units = velocity = None
        if self.position_unit_deg is not None:
            units = 360.0 / self.position_unit_deg * (joint.gear_ratio if self.position_unit_of == "motor" else 1.0)
        if self.velocity_per_position is not None:
            velocity = self.velocity_per_position * (_TURN / (units or units_per_joint_turn))
        elif self.velocity_unit_rad_s is not None:
            velocity = self.velocity_unit_rad_s / joint.gear_ratio
        return replace(
            self.manner,
            position_units_per_rad=None if units is None else units / _TURN,
            velocity_unit_rad_s=velocity,
        )


def known_personalities() -> dict[str, dict[str, Any]]:
    """All shipped families, as data."""
    plain: dict[str, dict[str, Any]] = yaml.load(SHIPPED.read_text(encoding="utf-8"), yaml.CSafeLoader)["families"]
    return plain


def personality_of(joint: JointSetup, folder: Path | None = None) -> Personality | None:
    """The family of a joint's option ``personality`` or ``eds`` (from the robot file's folder); None: standard.

    ``InvalidFields`` where there is no such family, ``InputFileError`` where the EDS file cannot be read.
    """
    name, eds = joint.options.get("personality"), joint.options.get("eds")
    if name is not None:
        families = known_personalities()
        if name not in families:
            message = f"no personality named {name!r}; known: {', '.join(sorted(families))}"
            raise InvalidFields([FieldProblem(("joints", joint.name, "options", "personality"), message)])
        return from_data(families[name])
    return None if eds is None else from_eds((folder or Path()) / str(eds), joint.address)


def from_data(plain: Mapping[str, Any]) -> Personality:
    """One entry of the file."""
    changes = {_key(at): dict(change) for at, change in plain.get("objects", {}).items()}
    changes |= {key(0x1018, 1): {"default": plain["vendor"]}, key(0x1008): {"default": str(plain["name"])}}
    unit = plain.get("velocity_unit")
    return Personality(
        records=_changed(changes),
        manner=Manner(
            absent=frozenset(entry.key for at in plain.get("absent", ()) for entry in _entries(at)),
            transmission_types=tuple(plain.get("transmission_types", ())),
            **_given(plain, "no_object", "mode_change_s", "power_on_s"),
        ),
        defaults={at: change["default"] for at, change in changes.items() if "default" in change},
        velocity_per_position={"position": 1.0, "tenth position": 0.1}.get(unit) if isinstance(unit, str) else None,
        velocity_unit_rad_s=unit if isinstance(unit, float) else None,
        **_given(plain, "position_unit_deg", "position_unit_of", "knows_gear"),
    )


def from_eds(path: Path, node: int) -> Personality:
    """The family that an EDS file describes, as far as the servo knows its objects."""
    # Late, because the drives' own process has no use for the host otherwise.
    from frictid_drivers.cia402.quirks import dictionary_of, integer_type, variables_of
    from frictid_drivers.cia402.scale import unit_rad

    told = {key(one.index, one.subindex): one for one in variables_of(dictionary_of(path, node))}
    changes: dict[Key, dict[str, Any]] = {}
    defaults: dict[Key, Value] = {}
    absent = set()
    for record in OBJECTS:
        for entry in record.entries:
            found = told.get(entry.key)
            if found is None:
                if record.index >= 0x1006 and not 0x2010 <= record.index < 0x2050:
                    absent.add(entry.key)
                continue
            kind = integer_type(found)
            change = changes[entry.key] = {
                "access": {"rwr": "rw", "rww": "rw"}.get(found.access_type, found.access_type)
            }
            if kind is not None and str(kind) in _KINDS:
                change["type"] = str(kind)
                change |= {"low": found.min, "high": found.max}
            if record.index >= 0x2000:
                change |= {"receive": found.pdo_mappable, "transmit": found.pdo_mappable}
            if isinstance(found.default, int) and not 0x1400 <= record.index < 0x1C00 and entry.key not in _SET_UP:
                defaults[entry.key] = found.default
    unit = defaults.get(key(0x60A8))
    angle = unit_rad(unit) if isinstance(unit, int) else None
    return Personality(
        records=_changed(changes),
        manner=Manner(absent=frozenset(absent)),
        defaults={**defaults, key(0x1008): path.stem},
        position_unit_deg=None if angle is None else math.degrees(angle),
        velocity_per_position=None if key(0x60A9) in told else 1.0,
    )


def _changed(changes: Mapping[Key, Mapping[str, Any]]) -> tuple[Record, ...]:
    return tuple(
        replace(record, entries=tuple(_entry(entry, changes.get(entry.key, {})) for entry in record.entries))
        for record in OBJECTS
    )


def _given(plain: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: plain[name] for name in names if name in plain}


def _entry(entry: Entry, change: Mapping[str, Any]) -> Entry:
    new = _given(change, "access", "default", "low", "high", "receive", "transmit")
    if "type" in change:
        new["kind"] = _KINDS[change["type"]]
    return replace(entry, **new)


def _entries(text: str) -> list[Entry]:
    """``"6072"`` is the whole object, ``"1800:06"`` one sub-index, ``"18xx:06"`` that of every PDO."""
    indices = [f"{n:04X}" for n in range(0x1800, 0x1804)] if text.startswith("18xx") else [text[:4]]
    wanted = {f"{index}{text[4:]}" for index in indices}
    return [
        entry
        for record in OBJECTS
        for entry in record.entries
        if f"{record.index:04X}" in wanted or f"{record.index:04X}:{entry.key & 0xFF:02X}" in wanted
    ]


def _key(text: str) -> Key:
    index, _, sub = text.partition(":")
    return key(int(index, 16), int(sub or "0", 16))
