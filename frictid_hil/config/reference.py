"""Every file's keys as a page: ``python -m frictid_hil.config.reference docs/reference`` writes it from the schemas.

The lists hold what the loaders enforce: types, limits and defaults come from the models, the words from what is said
beside their fields. The same models give JSON schemas, with which an editor completes and checks a file while it is
typed.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel

from frictid_hil.config.columns import ColumnsFile
from frictid_hil.config.nominal import NominalFile
from frictid_hil.config.profile import FrictionProfile
from frictid_hil.config.robot import RobotFile

FILES: Mapping[str, tuple[str, type[BaseModel]]] = {
    "robot": ("Robot file", RobotFile),
    "profile": ("Friction profile", FrictionProfile),
    "columns": ("Column map", ColumnsFile),
    "nominal": ("nominal.yaml of an experiment set", NominalFile),
}
_HEAD = """# Files

Every file is YAML and names its kind by `schema:`, except `nominal.yaml`. A number is in the unit that ends its key:
rad, rad/s, N m, s, m. An unknown key is an error that names the nearest known one, with file, line and column; in
`nominal.yaml` only where it looks like a known one, and `gap diagnose` lists the others as `not_read`. Brackets
hold a key's type and what it is unless given; a key with neither that nor *required* may be left out.

For completion in an editor, write the JSON schema of a kind and name it in the file's first line:

    python -m frictid_hil.config.reference --json robot > robot.schema.json
    # yaml-language-server: $schema=robot.schema.json

This page is generated from the schemas by `python -m frictid_hil.config.reference docs/reference`.
"""


def page() -> str:
    """The whole page as Markdown."""
    sections = [_HEAD]
    for title, model in FILES.values():
        sections += [f"## {title}\n", *_lists(model)]
    return "\n".join(sections)


def schema(model: type[BaseModel]) -> dict[str, Any]:
    """JSON schema of a file, with what is said of each model and key: an editor shows it."""
    whole = model.model_json_schema(by_alias=True)
    classes = _classes(model)
    for name, definition in ((model.__name__, whole), *whole.get("$defs", {}).items()):
        if name not in classes:
            continue
        definition["description"], meanings = _documented(classes[name])
        for key, field in definition.get("properties", {}).items():
            field.setdefault("description", "")
            field["description"] = meanings.get(key, field["description"])
    return whole


def _lists(model: type[BaseModel]) -> Iterator[str]:
    """The keys of a model, then those of the models that it holds, each once."""
    whole = schema(model)
    of = model.__name__.lower()
    yield _list(whole, of)
    for name, definition in whole.get("$defs", {}).items():
        if "properties" in definition:
            yield f"### {name} {{ #{of}-{name.lower()} }}\n"
            yield _list(definition, of)


def _list(definition: Mapping[str, Any], of: str) -> str:
    required = definition.get("required", ())
    rows = [f"{definition['description']}\n"]
    for key, field in definition["properties"].items():
        default = "required" if key in required else _default(field.get("default"))
        said = ", ".join(part for part in (_type(field, of), default) if part)
        rows.append(f"- `{key}` ({said}): {field['description']}")
    return "\n".join(rows) + "\n"


def _type(field: Mapping[str, Any], of: str) -> str:
    """A field's type and limits in words."""
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        return f"[{name}](#{of}-{name.lower()})"
    if "anyOf" in field:
        return " or ".join(_type(option, of) for option in field["anyOf"] if option.get("type") != "null")
    if "enum" in field or "const" in field:
        return ", ".join(f"`{value}`" for value in field.get("enum", [field.get("const")]))
    if field.get("type") == "object":
        values = field.get("additionalProperties")
        return f"mapping of {_type(values, of)}" if isinstance(values, Mapping) and values else "mapping"
    if field.get("type") == "array":
        return "list"
    limits = [
        f"{sign} {field[key]:g}"
        for key, sign in (("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<="))
        if key in field
    ]
    return " ".join([str(field.get("type", "any")), ", ".join(limits)]).strip()


def _default(value: Any) -> str:
    if value is None or isinstance(value, Mapping):
        return ""
    return f"`{json.dumps(value)}` unless given"


def _documented(model: type[BaseModel]) -> tuple[str, dict[str, str]]:
    """A model's docstring, and what is said of each field: beside it, or in the lines above it where it is long."""
    said: dict[str, str] = {}
    above: list[str] = []
    for line in inspect.getsource(model).splitlines():
        if line.startswith("    # "):
            above.append(line[6:])
        elif field := re.match(r"    (\w+): .*?(?:  # (.*))?$", line):
            words = " ".join(above) or field[2] or ""
            said[field[1].rstrip("_")] = _as_markdown(words if words.endswith(".") else f"{words}." if words else "")
            above = []
    return _as_markdown(" ".join((inspect.getdoc(model) or "").split())), said


def _as_markdown(words: str) -> str:
    return re.sub(r"``([^`]*)``", r"`\1`", words)


def _classes(kind: Any) -> dict[str, type[BaseModel]]:
    """The models that a model or an annotation holds, at any depth, by name."""
    if not (inspect.isclass(kind) and issubclass(kind, BaseModel)):
        return {name: found for part in get_args(kind) for name, found in _classes(part).items()}
    inner = [_classes(field.annotation) for field in kind.model_fields.values()]
    return {kind.__name__: kind} | {name: found for part in inner for name, found in part.items()}


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--json", kind] if kind in FILES:
            print(json.dumps(schema(FILES[kind][1]), indent=1))
        case [folder]:
            (Path(folder) / "files.md").write_text(page(), encoding="utf-8")
        case _:
            sys.exit(__doc__)
