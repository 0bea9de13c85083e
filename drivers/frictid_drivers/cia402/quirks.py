"""What is known of a family of drives that no object of theirs tells: access, refusals, units, delays - as data.

``quirks.yaml`` next to this file ships what is known; a ``quirks.yaml`` beside the robot file is read after it and adds
to it. An entry applies by vendor, and by product and revision where it names them (1018:01 to 1018:03); of several that
apply the later and closer ones win, key by key::

    schema: frictid.quirks/1
    drives:
    - name: My drive                     # printed by `check`
      source: manual 4711, page 12
      vendor: 0x26C
      product: 0x1234                    # optional, as is `revision`
      interpolation_exponent: -3         # the only power of ten that 60C2:02 takes
      transmission_types: [1, 253, 255]  # the only ones that PDOs take
      any_device_type: true              # 1000 does not say 402
      read_only: ["60C2:02", "6072:00"]
      not_mappable: ["603F:00"]
      limits: {"60C2:01": [0, 100]}      # values that an object takes
      types: {"60B2:00": i32}            # where it differs from CiA 402
      position_unit_deg: 0.001           # of 6064, of the joint, where 60A8 does not tell
      velocity_unit: position            # of 606C where 60A9 does not tell: `position` (units per second), `tenth
                                         # position`, `rpm`, or a number: rad/s, both of the motor
      torque_unit_mnm: 1.0               # of 6077 on the motor side, where it is not per mille of 6076
      mode_when_enabled: true            # 6061 shows the mode only once power is on
      sdo_timeout_s: 2.0                 # how long an answer may take

An EDS file says access, limits, types and what can be mapped too; the joint's option ``eds`` names it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import canopen
import yaml
from canopen.objectdictionary import ODVariable

from frictid_drivers.cia402.objects import IntegerType, Object
from frictid_hil.errors import InputFileError

SCHEMA = "frictid.quirks/1"
SHIPPED = Path(__file__).with_name("quirks.yaml")
_SIGNED = {0x02: 8, 0x03: 16, 0x04: 32, 0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
_UNSIGNED = {0x01: 1, 0x05: 8, 0x06: 16, 0x07: 32, 0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
_INTEGERS = {
    code: IntegerType(signed, bits) for signed, of in ((True, _SIGNED), (False, _UNSIGNED)) for code, bits in of.items()
}
"""CiA 301 data types."""

Address = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Quirks:
    """See the head of this file; ``names`` are those of the entries that applied."""

    names: tuple[str, ...] = ()
    interpolation_exponent: int | None = None
    transmission_types: tuple[int, ...] | None = None
    any_device_type: bool = False
    read_only: frozenset[Address] = frozenset()
    not_mappable: frozenset[Address] = frozenset()
    limits: Mapping[Address, tuple[int, int]] = field(default_factory=dict)
    types: Mapping[Address, IntegerType] = field(default_factory=dict)
    position_unit_deg: float | None = None
    velocity_unit: float | str | None = None
    torque_unit_mnm: float | None = None
    mode_when_enabled: bool = False
    sdo_timeout_s: float | None = None

    def refusal(self, item: Object, value: int) -> str:
        """Why the drive is known not to take this value; "" where nothing speaks against it."""
        at = (item.index, item.sub)
        if at in self.read_only:
            return "it is read-only"
        low, high = self.limits.get(at, (value, value))
        if not low <= value <= high:
            return f"it takes {low}..{high}"
        if item.index == 0x60C2 and item.sub == 2 and self.interpolation_exponent not in (None, value):
            return f"it takes {self.interpolation_exponent} only"
        if 0x1400 <= item.index < 0x1C00 and not item.index & 0x200 and item.sub == 2 and not self.sends_on(value):
            return f"it takes {', '.join(map(str, self.transmission_types or ()))}"
        return ""

    def sends_on(self, transmission_type: int) -> bool:
        """PDOs take this transmission type, as far as is known."""
        return self.transmission_types is None or transmission_type in self.transmission_types

    def maps(self, item: Object) -> bool:
        """The object can be mapped into a PDO, as far as is known."""
        return (item.index, item.sub) not in self.not_mappable

    def typed(self, item: Object) -> Object:
        """The object with the type that it has in this drive."""
        kind = self.types.get((item.index, item.sub), item.type)
        return item if kind == item.type else replace(item, type=kind)


NO_QUIRKS = Quirks()


class Catalogue:
    """All entries of the shipped file, and of one beside the robot file; ``InputFileError`` names file and entry."""

    def __init__(self, folder: Path | None = None) -> None:
        files = [SHIPPED] + ([own] if folder and (own := folder / "quirks.yaml").is_file() else [])
        self._entries = [entry for path in files for entry in _entries(path)]

    def of(self, vendor: int, product: int, revision: int) -> Quirks:
        """What applies to a drive."""
        told = {"vendor": vendor, "product": product, "revision": revision}
        fitting = [
            (matched, quirks)
            for match, quirks in self._entries
            if (matched := sum(told[key] == value for key, value in match.items())) == len(match)
        ]
        found = Quirks()
        for _, quirks in sorted(fitting, key=lambda one: one[0]):
            found = merged(found, quirks)
        return found


def merged(first: Quirks, second: Quirks) -> Quirks:
    """Both; where they differ, the second."""
    changes: dict[str, Any] = {}
    blank = Quirks()
    for one in fields(Quirks):
        a, b = getattr(first, one.name), getattr(second, one.name)
        if isinstance(b, frozenset):
            changes[one.name] = a | b
        elif isinstance(b, Mapping):
            changes[one.name] = {**a, **b}
        elif one.name == "names":
            changes[one.name] = (*a, *b)
        else:
            changes[one.name] = a if b == getattr(blank, one.name) else b
    return Quirks(**changes)


def _entries(path: Path) -> list[tuple[dict[str, int], Quirks]]:
    try:
        plain = yaml.load(path.read_text(encoding="utf-8"), yaml.CSafeLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from error
    if not isinstance(plain, dict) or plain.get("schema") != SCHEMA or not isinstance(plain.get("drives"), list):
        raise InputFileError(f"is no file of `schema: {SCHEMA}` with a list of `drives`", where=str(path))
    return [_entry(path, number, entry) for number, entry in enumerate(plain["drives"])]


def _entry(path: Path, number: int, plain: Any) -> tuple[dict[str, int], Quirks]:
    where = f"{path}: drives[{number}]"
    known = {one.name for one in fields(Quirks)} - {"names"}
    if not isinstance(plain, dict) or not isinstance(plain.get("vendor"), int):
        raise InputFileError("expected a mapping with at least `name` and `vendor` (a number)", where=where)
    unknown = set(plain) - known - {"name", "source", "vendor", "product", "revision"}
    if unknown:
        raise InputFileError(f"unknown key {min(unknown)!r}; known: {', '.join(sorted(known))}", where=where)
    values: dict[str, Any] = {key: value for key, value in plain.items() if key in known}
    try:
        for key in ("read_only", "not_mappable"):
            values[key] = frozenset(map(address, values.get(key, ())))
        values["limits"] = {address(at): (int(low), int(high)) for at, (low, high) in values.get("limits", {}).items()}
        values["types"] = {address(at): IntegerType.parse(kind) for at, kind in values.get("types", {}).items()}
        if "transmission_types" in values:
            values["transmission_types"] = tuple(map(int, values["transmission_types"]))
        for key in ("position_unit_deg", "torque_unit_mnm", "sdo_timeout_s"):
            if key in values and not float(values[key]) > 0.0:
                raise ValueError(f"{key}: expected a number above 0")
        unit = values.get("velocity_unit")
        positive = isinstance(unit, int | float) and unit > 0
        if not positive and unit not in (None, "position", "tenth position", "rpm"):
            raise ValueError("velocity_unit: expected position, tenth position, rpm, or rad/s")
    except (TypeError, ValueError, AttributeError) as error:
        raise InputFileError(f"cannot be used: {error}", where=where) from error
    match = {key: int(plain[key]) for key in ("vendor", "product", "revision") if key in plain}
    return match, Quirks(names=(str(plain.get("name", "unnamed")),), **values)


def address(text: str) -> Address:
    """``"60C2:02"`` to index and sub-index; ``ValueError`` for another form."""
    index, colon, sub = str(text).partition(":")
    if not colon:
        raise ValueError(f"{text!r}: expected an object such as '60C2:02', in quotes")
    return int(index, 16), int(sub, 16)


# -- EDS files -------------------------------------------------------------------------------------------------------


def dictionary_of(path: Path, node: int) -> canopen.ObjectDictionary:
    """The object dictionary of an EDS or DCF file; ``InputFileError`` where it cannot be read."""
    try:
        return canopen.import_od(_text_of(path), node)
    except OSError as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from error
    except Exception as error:  # the parser raises whatever configparser and int() do
        raise InputFileError(f"is no EDS or DCF file: {error}", where=str(path)) from error


def quirks_of_eds(path: Path, node: int) -> Quirks:
    """What an EDS file says of access, limits, types and mapping; ``InputFileError`` where it cannot be read."""
    read_only, not_mappable = set(), set()
    limits: dict[Address, tuple[int, int]] = {}
    types: dict[Address, IntegerType] = {}
    for variable in variables_of(dictionary_of(path, node)):
        at = (variable.index, variable.subindex)
        if variable.access_type in ("ro", "const"):
            read_only.add(at)
        if variable.index >= 0x2000 and not variable.pdo_mappable:
            not_mappable.add(at)
        kind = integer_type(variable)
        if kind is not None:
            types[at] = kind
            if variable.min is not None or variable.max is not None:
                limits[at] = (
                    kind.low if variable.min is None else int(variable.min),
                    kind.high if variable.max is None else int(variable.max),
                )
    return Quirks((path.name,), None, None, False, frozenset(read_only), frozenset(not_mappable), limits, types)


def variables_of(dictionary: canopen.ObjectDictionary) -> list[ODVariable]:
    """All variables of an object dictionary, those inside of records and arrays too."""
    found: list[ODVariable] = []
    for item in dictionary.values():
        found += [item] if isinstance(item, ODVariable) else item.values()
    return found


def integer_type(variable: ODVariable) -> IntegerType | None:
    """The type of a whole number; None for all else."""
    return _INTEGERS.get(variable.data_type or 0)


def _text_of(path: Path) -> io.StringIO:
    """A file of vendors' tools: UTF-8, or what Windows writes in Western Europe."""
    data = path.read_bytes()
    try:
        text = io.StringIO(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        text = io.StringIO(data.decode("cp1252", "replace"))
    text.name = path.name  # by its ending the parser knows the format
    return text
