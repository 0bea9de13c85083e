"""From a document to a validated model: all problems at once, in words a person can act on.

Models forbid unknown keys, refuse text where a number belongs, and accept finite numbers only. What pydantic finds is
re-told with the file's own places, the value found, and the nearest known key where one was misspelt.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from frictid_hil.config.yaml import Document, KeyPath, Node
from frictid_hil.errors import ConfigError, FieldProblem, UsageError
from frictid_hil.units import parse_quantity


class Strict(BaseModel):
    """Base of everything that comes from a file: no unknown keys, no coercion, finite numbers, immutable."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Strict)


def as_tuple(value: Any) -> Any:
    """Lists (as files hold them) and arrays (as the mathematics returns them) alike."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    return tuple(value) if isinstance(value, list) else value


Numbers = Annotated[tuple[float, ...], BeforeValidator(as_tuple)]
Pair = Annotated[tuple[float, float], BeforeValidator(as_tuple)]
Triple = Annotated[tuple[float, float, float], BeforeValidator(as_tuple)]
Names = Annotated[tuple[str, ...], BeforeValidator(as_tuple)]


def schema_version(document: Document, kind: str, newest: int) -> int:
    """The major of ``schema: <kind>/<major>`` (``ConfigError``: no schema, of another kind, or newer than we know)."""
    declared = document.root.content.get("schema")
    expected = f"{kind}/{newest}"
    if declared is None:
        raise ConfigError(
            f"the file does not say what it is; expected `schema: {expected}`",
            where=str(document.root.place),
            next_step=f"add the line `schema: {expected}` if it is one",
        )
    where = str(declared.place)
    found_kind, _, major = str(declared.content).partition("/")
    if found_kind != kind:
        wanted = f"give a file that starts with `schema: {kind}/...`"
        raise ConfigError(f"this is a {declared.content}, not a {kind}", where=where, next_step=wanted)
    if not major.isascii() or not major.isdigit() or int(major) < 1:
        raise ConfigError(f"schema: expected {expected}, found {declared.content!r}", where=where)
    if int(major) > newest:
        raise ConfigError(
            f"schema: {declared.content} is newer than this program, which knows {expected}",
            where=where,
            next_step="update frictid-hil",
        )
    return int(major)


def validated(document: Document, model: type[Model], data: Mapping[str, Any] | None = None) -> Model:
    """The document, or ``data`` made of its values, as a model (``ConfigError``: all wrong fields, their places)."""
    try:
        return model.model_validate(document.data if data is None else data)
    except ValidationError as invalid:
        errors = invalid.errors(include_url=False)
    unknown = {
        path: _nearest(model, path)
        for path in (_existing(document, error["loc"]) for error in errors if error["type"] == "extra_forbidden")
    }
    # A misspelt key is one mistake, though it is also a missing one.
    meant = {(*path[:-1], near) for path, near in unknown.items() if near}
    problems = [FieldProblem(path, _unknown(model, path, near)) for path, near in unknown.items()]
    messages: dict[KeyPath, list[str]] = {}
    for error in errors:
        path = _existing(document, error["loc"])
        if error["type"] != "extra_forbidden" and not (error["type"] == "missing" and path in meant):
            message = _missing(document, model, path) if error["type"] == "missing" else _message(path, error)
            messages.setdefault(path, []).append(message)
    problems += [FieldProblem(path, _either(each)) for path, each in messages.items()]
    raise document.error(problems, at_key=unknown)


def _nearest(model: type[Strict], path: KeyPath) -> str | None:
    near = difflib.get_close_matches(str(path[-1]), _known_keys(model, path[:-1]), n=1, cutoff=0.5)
    return near[0] if near else None


def _unknown(model: type[Strict], path: KeyPath, near: str | None) -> str:
    known = ", ".join(_known_keys(model, path[:-1]))
    return f"unknown key; did you mean {near}?" if near else f"unknown key; known here: {known}"


def _missing(document: Document, model: type[Strict], path: KeyPath) -> str:
    beside, _ = document.deepest(path[:-1])
    strangers = [str(key) for key in beside.content if key not in _known_keys(model, path[:-1])]
    near = difflib.get_close_matches(str(path[-1]), strangers, n=1, cutoff=0.7)
    return f"missing; did you write it as {near[0]}?" if near else "missing"


def _message(path: KeyPath, error: ErrorDetails) -> str:
    kind = error["type"]
    message = error["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
    if kind in ("value_error", "assertion_error"):
        return message
    return f"{message}, found {_shown(error['input'])}{_unit_hint(path, error['input'])}"


def _either(messages: Sequence[str]) -> str:
    """One message of all kinds of value that a field takes."""
    wanted = [message.partition(", found ")[0].removeprefix("expected ") for message in messages]
    _, found, value = messages[0].partition(", found ")
    return f"expected {' or '.join(wanted)}{found}{value}" if found and len(messages) > 1 else "; ".join(messages)


def _existing(document: Document, loc: tuple[int | str, ...]) -> KeyPath:
    """``loc`` without the words pydantic adds (names of validators and of union members)."""
    node, found = document.deepest(loc)
    return loc[: len(found) + isinstance(node.content, dict)]


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    return "nothing" if value is None else repr(value)[:60]


_DIMENSIONS = {
    "_rad_s": "angular velocity",
    "_rad": "angle",
    "_m_s": "speed",
    "_nm_per_rad": "stiffness",
    "_nm": "torque",
    "_n": "force",
    "_hz": "frequency",
    "_s": "duration",
    "_m": "length",
}


def _dimension(key: str) -> str | None:
    """What a key holds, by the unit that ends it."""
    found = next((dimension for suffix, dimension in _DIMENSIONS.items() if key.endswith(suffix)), None)
    return None if "_per_" in key and found != "stiffness" else found


def _unit_hint(path: KeyPath, value: Any) -> str:
    """For ``20deg`` typed at ``start_position_rad``: the number that belongs there."""
    name = next((key for key in reversed(path) if isinstance(key, str)), "")
    dimension = _dimension(name)
    if dimension is None or not isinstance(value, str) or not re.search(r"\d", value):
        return ""
    try:
        return f"; write {parse_quantity(value, dimension)!r}"
    except UsageError as error:
        return f"; {error.what}"


def in_si(document: Document) -> Document:
    """The document with every ``150deg`` or ``115deg/s`` in the unit that ends its key; other text stays."""

    def converted(node: Node, key: str) -> Node:
        if isinstance(node.content, dict):
            children = {
                name: converted(child, key if node.is_list else str(name)) for name, child in node.content.items()
            }
            return node._replace(content=children)
        dimension = _dimension(key)
        if dimension is None or not isinstance(node.content, str):
            return node
        try:
            return node._replace(content=parse_quantity(node.content, dimension))
        except UsageError:
            return node

    return replace(document, root=converted(document.root, ""))


def _known_keys(model: type[Strict], path: KeyPath) -> list[str]:
    """The keys a mapping at ``path`` may hold."""
    kind: Any = model
    for key in path:
        kind = _inside(kind)
        if _is_model(kind):
            field = kind.model_fields.get(str(key))
            kind = field.annotation if field else None
        else:
            kind = get_args(kind)[-1] if get_args(kind) else None
    kind = _inside(kind)
    return [field.alias or name for name, field in kind.model_fields.items()] if _is_model(kind) else []


def _inside(kind: Any) -> Any:
    """The first model or container inside an optional or annotated type."""
    while get_origin(kind) in (Union, UnionType, Annotated):
        kind = next(option for option in get_args(kind) if option is not type(None))
    return kind


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
