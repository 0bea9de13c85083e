"""The options of a run. They are kept in its manifest, and restored from there when the run is continued."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import KW_ONLY, MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from frictid_hil.errors import ConfigError, UsageError
from frictid_hil.runs.folder import load_manifest

_ELSEWHERE = frozenset({"robot", "resume", "out", "store", "verb"})
"""Options that are not kept, because the manifest has them elsewhere or because they change no measurement."""


@dataclass(frozen=True, slots=True)
class Options:
    """What a person asked for; a value that is the field's default was not asked for."""

    robot: str = ""  # robot file; "" where a run that is continued knows it
    _: KW_ONLY
    bus: str | None = None
    resume: Path | None = None  # run folder to continue
    out: Path | None = None  # folder to write


Asked = TypeVar("Asked", bound=Options)


def kept_options(options: Options) -> dict[str, Any]:
    """The options as plain values, for the manifest."""
    kept: dict[str, Any] = TypeAdapter(type(options)).dump_python(options, mode="json", exclude=set(_ELSEWHERE))
    return kept


def restored(options: Asked, verbs: Collection[str]) -> Asked:
    """The options that a run began with, where one is continued (``UsageError``: another verb's, or they differ)."""
    run = options.resume
    if run is None:
        if not options.robot:
            raise UsageError("which robot?", next_step="name its file with --robot, or a run to go on with (--resume)")
        return options
    manifest = load_manifest(run)
    if manifest["verb"] not in verbs:
        raise UsageError(f"a run of {manifest['verb']}; this continues those of {', '.join(verbs)}", where=str(run))
    file = Path(manifest["robot_file"])
    robot = options.robot or str(file if file.exists() else run / "config.yaml")
    try:
        began: Asked = TypeAdapter(type(options)).validate_python({**manifest["options"], "robot": robot})
    except (ValidationError, KeyError, TypeError) as error:
        raise ConfigError(f"its options cannot be read: {error}", where=str(run / "manifest.json")) from error
    differs = [
        f"{field.name} is {getattr(options, field.name)!r} now and was {getattr(began, field.name)!r}"
        for field in fields(options)
        if field.name not in _ELSEWHERE
        and field.default is not MISSING
        and getattr(options, field.name) not in (field.default, getattr(began, field.name))
    ]
    if differs:
        raise UsageError(
            f"this run began otherwise: {'; '.join(differs)}",
            where=str(run),
            next_step="leave these options out to go on as it began, or start a new run",
        )
    here = {n: getattr(options, n) or getattr(began, n) for n in ("resume", "out", "store") if hasattr(options, n)}
    return replace(began, **here, **({"verb": manifest["verb"]} if hasattr(options, "verb") else {}))
