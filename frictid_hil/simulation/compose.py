"""From the bare joint and the effects that exist, one compiled kernel.

``plant.py`` is read as text, its marked lines are replaced by calls of hooks, and the result is written as a module
named by its hash into the user's cache folder: numba's on-disk cache needs a file, and never serves an older effect's
kernel.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import inspect
import logging
import re
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from itertools import accumulate
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from frictid_hil.simulation import plant
from frictid_hil.simulation.effect import Effect
from frictid_hil.simulation.effects import all_effects

_LOG = logging.getLogger(__name__)
_DEFINITION = re.compile(r"^def (?P<name>\w+)\(")
_ENTRIES = ("run", "run_coupled", "steady", "place", "holding_torque", "stand")
"""Functions of ``plant.py`` that stay functions. The others become a part of them: a sub-step takes a fifth less."""
_MARKER = re.compile(r"^(?P<indent> *)# effects at (?P<stage>\w+) (?:transform (?P<name>\w+)|update)$")


@dataclass(frozen=True, slots=True)
class Layout:
    """Where every effect's numbers live in the kernel's flat vectors."""

    parameters: Mapping[str, int]  # first parameter slot by effect
    states: Mapping[str, int]  # first state slot by effect
    curve_at: int  # slot of the rate curve's first knot
    state_size: int  # length of the state vector


@dataclass(frozen=True, slots=True)
class Kernel:
    """The compiled functions of ``plant.py``, effects included; the last eight are pieces for another integrator."""

    run: Callable[..., None]
    run_coupled: Callable[..., None]
    steady: Callable[..., None]
    place: Callable[..., float]
    holding_torque: Callable[..., float]
    begin: Callable[..., None]
    motor_torque: Callable[..., float]
    shaft_torque: Callable[..., float]
    gravity_torque: Callable[..., float]
    friction: Callable[..., tuple[float, float, float]]
    remember: Callable[..., None]
    encoder_angle: Callable[..., float]
    measure: Callable[..., float]


@functools.cache
def layout() -> Layout:
    """The layout of all effects there are."""
    effects = all_effects()
    *parameters, curve_at = accumulate((len(e.parameters) for e in effects.values()), initial=plant.CORE_PARAMETERS)
    *states, state_size = accumulate((e.state_size for e in effects.values()), initial=plant.CORE_STATES)
    first = dict(zip(effects, parameters, strict=True)), dict(zip(effects, states, strict=True))
    return Layout(*first, curve_at, state_size)


@functools.cache
def kernel() -> Kernel:
    """The compiled kernel with every effect there is; the first call on a machine compiles for some seconds."""
    module = _load(kernel_source())
    return Kernel(**{field.name: getattr(module, field.name) for field in fields(Kernel)})


def kernel_source() -> str:
    """The text of the composed module."""
    effects = all_effects()
    where = layout()
    template = Path(plant.__file__).read_text(encoding="utf-8")
    known = _locals_by_stage(template)
    used: dict[str, Callable[..., Any]] = {}
    lines: list[str] = []
    for line in template.splitlines():
        marker = _MARKER.match(line)
        if marker is None:
            if define := _DEFINITION.match(line):
                inline = "never" if define["name"] in _ENTRIES else "always"
                lines.append(f"@njit(error_model='numpy', cache=True, inline={inline!r})")
            lines.append(line)
            continue
        stage = marker["stage"]
        hooks = [(effect, hook) for effect in effects.values() for hook in effect.hooks if hook.stage == stage]
        for effect, hook in sorted(hooks, key=lambda pair: pair[1].order):
            name = f"{effect.name}_{hook.function.__name__}"
            used[name] = hook.function
            call = f"{name}({_arguments(effect, hook.function, where, known[stage])})"
            lines.append(marker["indent"] + (f"{marker['name']} = {call}" if marker["name"] else call))
    imports = ["from numba import njit"]
    for name, function in used.items():
        # The digest makes this text, and with it the file's name, change with the hook.
        imports.append(f"from {function.__module__} import {function.__name__} as _{name}")
        imports.append(f"{name} = njit(error_model='numpy')(_{name})  # {_digest(inspect.getsource(function))}")
    text = "\n".join(["# Composed from plant.py and the effects; do not edit.", *lines, ""])
    return text.replace("import math\n", "\n".join(["import math", *imports, ""]), 1)


def _arguments(effect: Effect, function: Callable[..., Any], where: Layout, known: frozenset[str]) -> str:
    """The call's arguments: each by the name the hook gave it."""
    slots = {parameter.name: where.parameters[effect.name] + k for k, parameter in enumerate(effect.parameters)}
    arguments: list[str] = []
    for name in inspect.signature(function).parameters:
        if name in slots:
            arguments.append(f"parameters[{slots[name]}]")
        elif name == "at":
            arguments.append(str(where.states[effect.name]))
        elif name in known:
            arguments.append(name)
        else:
            raise RuntimeError(
                f"effect {effect.name}: {function.__name__} asks for {name!r}, which is neither one of its parameters "
                f"nor known at its stage ({', '.join(sorted(known))})"
            )
    return ", ".join(arguments)


def _locals_by_stage(template: str) -> dict[str, frozenset[str]]:
    """Names that each stage's hooks may use: arguments and variables of the function that holds the marker."""
    stages: dict[str, frozenset[str]] = {}
    functions = [node for node in ast.parse(template).body if isinstance(node, ast.FunctionDef)]
    lines = template.splitlines()
    ends = [node.lineno for node in functions[1:]] + [len(lines)]
    for node, end in zip(functions, ends, strict=True):
        names = {argument.arg for argument in node.args.args}
        names |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        for line in lines[node.lineno - 1 : end]:
            if marker := _MARKER.match(line):
                stages[marker["stage"]] = frozenset(names)
    return stages


def _load(source: str) -> Any:
    """Import the text as a module from a file named by its hash."""
    name = f"frictid_hil_kernel_{_digest(source)}"
    path = _cache_folder() / f"{name}.py"
    if not path.exists():
        _LOG.info("compiling the simulated joint for this computer, once; a few seconds")
        # Another process may write the same file at this moment: make the complete file appear at once.
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8") as file:
            file.write(source)
        Path(file.name).replace(path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _cache_folder() -> Path:
    """``$XDG_CACHE_HOME/frictid-hil`` or its default; a private temporary folder where that cannot be written."""
    folder = user_cache_path("frictid-hil")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="frictid-hil-"))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
