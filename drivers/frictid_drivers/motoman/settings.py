"""The driver-wide ``options`` of a serial robot file, checked."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from frictid_drivers.motoman.bsc_block import BscTiming
from frictid_drivers.motoman.host_control import PROFILES
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.protocol.driver import Timing, unknown_options

_PSEUDO_TERMINALS = "/dev/pts/"
_ASSUMED = Timing(uncertainty_s=0.0005)
LAYERS = ("auto", "stream", "batch", "host")


@dataclass(frozen=True, slots=True)
class SerialOptions:
    """What a robot file may say beside its joints; every default is the controller's own or ours where it has none.

    Attributes:
        controller: generation: erc, xrc, nx, dx.
        layer: auto takes the best that the controller knows; stream, batch or host insist.
        baud: of host control (RS032).
        parity: E, O or N (RS033); "" is E on hardware and N on a pseudo terminal, which can do nothing else.
        stream_baud: asked of FSTREAM; 0 where the port is no gateway port.
        lead_ticks: how far ahead of the report that they answer targets are due; what the host may be late by.
        silence_ms: without feedback for so long, the controller counts as lost.
        command_delay_ms: what the controller may delay the motion by where it does not say how much it averages.
        watchdog_s: a batch job stops when it hears nothing from us for so long.
        reply_s: how long the controller may think about a command.
        timer_a_s: RS034.
        timer_b_s: RS035.
        retry_1: RS036.
        retry_2: RS037.
        timing: when reported figures were true.
    """

    controller: str = "nx"
    layer: str = "auto"
    baud: int = 19200
    parity: str = ""
    stream_baud: int = 0
    lead_ticks: int = 8
    silence_ms: float = 300.0
    command_delay_ms: float = 300.0
    watchdog_s: float = 5.0
    reply_s: float = 10.0
    timer_a_s: float = 3.0
    timer_b_s: float = 20.0
    retry_1: int = 10
    retry_2: int = 3
    timing: Timing = _ASSUMED

    def parity_on(self, path: str) -> str:
        """The parity of host control on this port: decided by the port's kind, never by trying."""
        return self.parity or ("N" if os.path.realpath(path).startswith(_PSEUDO_TERMINALS) else "E")

    @property
    def link(self) -> BscTiming:
        """Timers and retries of the link."""
        return BscTiming(self.timer_a_s, self.timer_b_s, self.retry_1, self.retry_2)


_CHOICES: Mapping[str, tuple[str, ...]] = {
    "controller": tuple(PROFILES),
    "layer": LAYERS,
    "parity": ("E", "O", "N"),
}
_BOUNDS: Mapping[str, tuple[float, float]] = {
    "baud": (300, 4_000_000),
    "stream_baud": (0, 4_000_000),
    "lead_ticks": (2, 60),
    "silence_ms": (10, 10_000),
    "command_delay_ms": (0, 2_000),
    "watchdog_s": (0.5, 60),
    "reply_s": (0.1, 120),
    "timer_a_s": (0.1, 10),
    "timer_b_s": (0.1, 25.5),
    "retry_1": (0, 30),
    "retry_2": (0, 10),
}
_DELAYS: Mapping[str, tuple[float, float]] = {
    "position_delay_s": (-1, 1),
    "velocity_delay_s": (-1, 1),
    "torque_delay_s": (-1, 1),
    "uncertainty_s": (1e-6, 0.1),
}
_OTHERS = frozenset({"emulator"})
"""Read by the emulator only."""


def serial_options(mapping: Mapping[str, Any]) -> SerialOptions:
    """The options, every one checked.

    Raises:
        InvalidFields: an unknown option, or a value that is not possible.
    """
    types = {entry.name: entry.type for entry in fields(SerialOptions)}
    problems = unknown_options(mapping, {*types, *_OTHERS}, ("options",), "motoman")
    values: dict[str, Any] = {}
    for name, value in mapping.items():
        if name not in types:
            continue
        if name == "timing":
            values[name] = _timing(value, problems)
            continue
        problem = _problem(name, value, types)
        if problem:
            problems.append(FieldProblem(("options", name), problem))
        else:
            values[name] = value
    if problems:
        raise InvalidFields(problems)
    return SerialOptions(**values)


def _timing(value: Any, problems: list[FieldProblem]) -> Timing:
    path = ("options", "timing")
    if not isinstance(value, Mapping):
        problems.append(FieldProblem(path, "must be a mapping"))
        return Timing()
    for name in value.keys() - _DELAYS.keys():
        problems.append(FieldProblem((*path, str(name)), f"is no delay; there are {', '.join(_DELAYS)}"))
    wrong = [(name, _out_of_bounds(value[name], *bounds)) for name, bounds in _DELAYS.items() if name in value]
    problems += [FieldProblem((*path, name), problem) for name, problem in wrong if problem]
    if any(problem for _, problem in wrong) or value.keys() - _DELAYS.keys():
        return Timing()
    return replace(_ASSUMED, **value, source="robot file")


def _problem(name: str, value: Any, types: Mapping[str, Any]) -> str:
    if name in _CHOICES:
        return "" if value in _CHOICES[name] else f"must be one of {', '.join(_CHOICES[name])}, found {value!r}"
    return _out_of_bounds(value, *_BOUNDS[name], whole=types[name] == "int")


def _out_of_bounds(value: Any, low: float, high: float, *, whole: bool = False) -> str:
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or not math.isfinite(value):
        return f"must be a {'whole ' if whole else ''}number, found {value!r}"
    return "" if low <= value <= high else f"must lie in {low:g}..{high:g}, found {value:g}"
