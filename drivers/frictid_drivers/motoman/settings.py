"""The driver-wide ``options`` of a serial robot file, checked."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, TypeVar

from frictid_drivers.motoman.bsc import BscTiming
from frictid_drivers.motoman.host_control import PROFILES
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.protocol.driver import Timing, unknown_options

_PSEUDO_TERMINALS = "/dev/pts/"
_ASSUMED = Timing(uncertainty_s=0.0005)
_DELAYS: Mapping[str, tuple[float, float]] = {
    **dict.fromkeys(("position_delay_s", "velocity_delay_s", "torque_delay_s"), (-1, 1)),
    "uncertainty_s": (1e-6, 0.1),
}
_Usual = TypeVar("_Usual")


def _choice(usual: str, choices: tuple[str, ...]) -> str:
    return field(default=usual, metadata={"choices": choices})


def _number(usual: _Usual, low: float, high: float) -> _Usual:
    return field(default=usual, metadata={"bounds": (low, high)})


@dataclass(frozen=True, slots=True)
class SerialOptions:
    """What a robot file may say beside its joints; every default is the controller's own or ours where it has none."""

    controller: str = _choice("nx", tuple(PROFILES))  # generation: erc, xrc, nx, dx
    layer: str = _choice("auto", ("auto", "stream", "batch", "host"))  # auto: the best there is; the others insist
    baud: int = _number(19200, 300, 4_000_000)  # of host control (RS032)
    parity: str = _choice("", ("E", "O", "N"))  # (RS033); "" is E on hardware, and N on a pseudo terminal
    stream_baud: int = _number(0, 0, 4_000_000)  # asked of FSTREAM; 0 where the port is no gateway port
    lead_ticks: int = _number(8, 2, 60)  # between a report and when the targets that answer it are due
    silence_ms: float = _number(300.0, 10, 10_000)  # without feedback for so long, the controller counts as lost
    command_delay_ms: float = _number(300.0, 0, 2_000)  # of the motion, where the controller does not tell its own
    watchdog_s: float = _number(5.0, 0.5, 60)  # a batch job stops when it hears nothing from us for so long
    reply_s: float = _number(10.0, 0.1, 120)  # how long the controller may think about a command
    timer_a_s: float = _number(3.0, 0.1, 10)  # RS034
    timer_b_s: float = _number(20.0, 0.1, 25.5)  # RS035
    retry_1: int = _number(10, 0, 30)  # RS036
    retry_2: int = _number(3, 0, 10)  # RS037
    timing: Timing = _ASSUMED  # when reported figures were true

    def parity_on(self, path: str) -> str:
        """The parity of host control on this port: decided by the port's kind, never by trying."""
        return self.parity or ("N" if os.path.realpath(path).startswith(_PSEUDO_TERMINALS) else "E")

    @property
    def link(self) -> BscTiming:
        """Timers and retries of the link."""
        return BscTiming(self.timer_a_s, self.timer_b_s, self.retry_1, self.retry_2)


def serial_options(mapping: Mapping[str, Any]) -> SerialOptions:
    """The options, every one checked (``InvalidFields``); ``emulator`` is read by the emulator only."""
    known = {entry.name: entry for entry in fields(SerialOptions)}
    problems = unknown_options(mapping, {*known, "emulator"}, ("options",), "motoman")
    values = {name: value for name, value in mapping.items() if name in known}
    timing = values.pop("timing", {})
    for name, value in values.items():
        problems += _wrong(("options", name), _problem(value, known[name]))
    if not isinstance(timing, Mapping):
        problems.append(FieldProblem(("options", "timing"), "must be a mapping"))
        timing = {}
    for name, value in timing.items():
        unknown = f"is no delay; there are {', '.join(_DELAYS)}"
        problem = _out_of_bounds(value, *_DELAYS[name]) if name in _DELAYS else unknown
        problems += _wrong(("options", "timing", str(name)), problem)
    if problems:
        raise InvalidFields(problems)
    if "timing" in mapping:
        values["timing"] = replace(_ASSUMED, **timing, source="robot file")
    return SerialOptions(**values)


def _wrong(path: tuple[str, ...], problem: str) -> list[FieldProblem]:
    return [FieldProblem(path, problem)] if problem else []


def _problem(value: Any, option: Field[Any]) -> str:
    choices = option.metadata.get("choices")
    if choices is None:
        return _out_of_bounds(value, *option.metadata["bounds"], whole=option.type == "int")
    return "" if value in choices else f"must be one of {', '.join(choices)}, found {value!r}"


def _out_of_bounds(value: Any, low: float, high: float, *, whole: bool = False) -> str:
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or not math.isfinite(value):
        return f"must be a {'whole ' if whole else ''}number, found {value!r}"
    return "" if low <= value <= high else f"must lie in {low:g}..{high:g}, found {value:g}"
