"""YAML out, for people and for bytes that repeat: block style, keys in the order given, shortest exact floats.

A list of plain values stays on one line, so that a curve reads as a row; so does a ``Row``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import yaml
import yamlcore


class Row(dict[str, Any]):
    """A mapping that is written on one line: ``{value: .., low: .., high: ..}``."""


class _Writer(yamlcore.CCoreDumper):  # type: ignore[misc]  # yamlcore is untyped
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _on_one_line(value: Any) -> bool:
    scalars = all(not isinstance(item, list | dict) for item in value)
    return scalars or all(isinstance(item, list) and len(item) == 2 and _on_one_line(item) for item in value)


def _represent_list(writer: Any, value: list[Any]) -> Any:
    return writer.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=_on_one_line(value))


def _represent_dict(writer: Any, value: dict[str, Any]) -> Any:
    on_one_line = not value or isinstance(value, Row)
    return writer.represent_mapping("tag:yaml.org,2002:map", value.items(), flow_style=on_one_line)


_Writer.add_representer(list, _represent_list)
_Writer.add_representer(dict, _represent_dict)
_Writer.add_representer(Row, _represent_dict)


def dump(values: Mapping[str, Any]) -> str:
    """The values as YAML text, floats bit for bit (``ValueError``: not finite, or of no plain kind)."""
    style: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "width": 120, "default_flow_style": False}
    return str(yaml.dump(plain(values), Dumper=_Writer, **style))


def plain(value: Any) -> Any:
    """Mappings, sequences and numbers of any library as the plain kinds of YAML and JSON; raises as ``dump``."""
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, Mapping):
        return (Row if isinstance(value, Row) else dict)((str(key), plain(item)) for key, item in value.items())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number; write None and a reason")
    if isinstance(value, int | float):
        return value
    raise ValueError(f"{type(value).__name__} is no plain value")
