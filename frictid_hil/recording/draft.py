"""A first column map for a file that nobody has described: by the names of its columns, and by what physics proves.

Names tell which column is which and often in what unit (``pos_deg``, ``time [ms]``). Where they do not, the step of the
time, the travel and the factor between velocity and differenced position do. What was guessed is said.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.recording.proofs import travelled
from frictid_hil.recording.table import Table, unwrapped

_WORDS: dict[str, str] = {
    "position_command": r"soll(wert|winkel|lage|position)?|"
    r"(pos|position|angle|q|joint)?_?(cmd|command|commanded|des|desired|target|ref|reference|goal|"
    r"goal_position|setpoint|action|con)_?(pos|position|positions|dof_pos|q|angle)?",
    "velocity": r"(joint_?)?(actual_?|meas_?|measured_?)?(vel|velocity|velocities|qd|dq|speed|omega|qdot|dof_vel|"
    r"drehzahl|geschwindigkeit)_?(meas|measured|act|actual)?",
    "torque": r"(joint_?|motor_?)?(actual_?|meas_?|measured_?)?(tau|torque|torques|trq|effort|efforts|current|currents|"
    r"force|i|iq|dof_tor|moment|drehmoment|strom|kraft)_?(meas|measured|act|actual)?",
    "position": r"(joint_?)?(actual_?|meas_?|measured_?)?(pos|position|positions|q|angle|theta|encoder|dof_pos|state|"
    r"observation\.state|phi|winkel|lage)_?(meas|measured|act|actual)?",
    "time": r"(time|t|stamp|timestamp|times|zeit)",
    "temperature": r"(temp|temperature)",
}
UNITS = {
    "deg/s": "deg/s", "deg": "deg", "rad/s": "rad/s", "rad": "rad", "rpm": "rpm", "nm": "N m", "n_m": "N m",
    "n m": "N m", "mnm": "mNm", "ms": "ms", "us": "us", "ns": "ns", "s": "s", "a": "A", "ma": "mA", "grad": "deg",
    "degree": "deg", "degrees": "deg", "deg_s": "deg/s", "rad_s": "rad/s", "dps": "deg/s", "sec": "s", "msec": "ms",
    "mm": "mm", "m": "m", "n": "N", "mm/s": "mm/s", "m/s": "m/s",
    "1/min": "rpm", "u/min": "rpm", "min-1": "rpm", "min^-1": "rpm", "r/min": "rpm",
    "°": "deg", "°/s": "deg/s", "degps": "deg/s", "radps": "rad/s",
}  # fmt: skip
_FITTING = {
    "time": ("s", "ms", "us", "ns"),
    "position": ("rad", "deg", "m", "mm"),
    "position_command": ("rad", "deg", "m", "mm"),
    "velocity": ("rad/s", "deg/s", "rpm", "m/s", "mm/s"),
    "torque": ("N m", "mNm", "A", "mA", "N"),
}


@dataclass(frozen=True, slots=True)
class Guess:
    """What one column holds, and whose it is; joint and unit are "" where its name does not say."""

    quantity: str
    joint: str
    column: str
    unit: str


@dataclass(frozen=True, slots=True)
class Draft:
    """A column map, ready for YAML; how its units were found and what a person must say; columns left out."""

    document: Mapping[str, object]
    findings: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def guessed(name: str) -> Guess | None:
    """What a column's name says; None where it says nothing."""
    text, unit = without_unit(name)
    best: tuple[int, Guess] | None = None
    for quantity, words in _WORDS.items():
        form = rf"(?:(?P<before>.+?)[ _./:-]+)?(?P<word>{words})(?:[ _./:-]*(?P<after>\d+|(?<=[ _./:-]).+))?"
        match = re.fullmatch(form, text, re.IGNORECASE)
        if match is None:
            continue
        joint = "_".join(part for part in (match["before"], match["after"]) if part)
        score = len(match["word"])
        if best is None or score > best[0]:
            best = score, Guess(quantity, joint, name, unit if unit in _FITTING.get(quantity, ()) else "")
    return best[1] if best else None


def without_unit(name: str) -> tuple[str, str]:
    """The name without its unit, and the unit: ``pos [deg]``, ``pos_deg``, ``tau(Nm)``."""
    bracket = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*", name)
    if bracket and bracket[2].lower() in UNITS:
        return bracket[1].strip(), UNITS[bracket[2].lower()]
    lowered = name.lower()
    for unit in sorted(UNITS, key=len, reverse=True):
        if lowered.endswith("_" + unit.replace("/", "_")) and len(name) > len(unit) + 1:
            return name[: -len(unit) - 1], UNITS[unit]
    return name, ""


def draft(table: Table, name: str) -> Draft:
    """A column map for a table; ``InputFileError`` with the columns there are where none is of a position."""
    guesses = [guess for column in table.names if (guess := guessed(column)) is not None]
    times = [guess for guess in guesses if guess.quantity == "time"]
    of_joint: dict[str, dict[str, Guess]] = {}
    for guess in guesses:
        if guess.quantity not in ("time", "temperature"):
            of_joint.setdefault(guess.joint, {}).setdefault(guess.quantity, guess)
    joints = {joint: columns for joint, columns in of_joint.items() if "position" in columns}
    whole = {joint: columns for joint, columns in joints.items() if {"torque", "position_command"} & set(columns)}
    joints = whole or joints
    if not joints:
        raise InputFileError(
            f"no column that is named like a position; the file has {', '.join(table.names)[:300]}",
            where=str(table.path),
            next_step="write the column map by hand: docs/guides/your-own-log.md shows one",
        )
    findings = list(table.told)
    time_s, time_document = _time(table, times, findings)
    documents = {
        joint or "0": _joint(table, joint or "0", columns, time_s, findings) for joint, columns in joints.items()
    }
    used = {guess.column for columns in joints.values() for guess in columns.values()} | {t.column for t in times[:1]}
    left = tuple(column for column in table.names if column not in used)
    document = {"schema": "frictid.columns/1", "name": name, "time": time_document, "joints": documents}
    return Draft(document, tuple(findings), left)


def _time(table: Table, times: list[Guess], findings: list[str]) -> tuple[Array, dict[str, object]]:
    if not times:
        findings.append("no column of time: say the rate (`time: {rate_hz: ...}`); 100 Hz is only a place holder")
        return np.zeros(0), {"rate_hz": 100.0}
    guess = times[0]
    (time,) = table.numbers([guess.column])
    step = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    unit, how = guess.unit, "its name says so"
    if not unit:
        unit = next((u for u, least in (("ns", 1e5), ("us", 100.0), ("ms", 0.5)) if step >= least), "s")
        how = f"it steps by {step:.6g}"
    findings.append(f"time: {guess.column} in {unit} ({how})")
    scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    return (time - time[0]) * scale, {"column": guess.column, "unit": unit}


def _joint(
    table: Table, joint: str, columns: Mapping[str, Guess], time_s: Array, findings: list[str]
) -> dict[str, object]:
    (position,) = table.numbers([columns["position"].column])
    unit = columns["position"].unit
    velocity = columns.get("velocity")
    speeds = table.numbers([velocity.column])[0] if velocity else None
    if not unit:
        travel = float(np.nanmax(position) - np.nanmin(position))
        unit = "deg" if travel > 4 * math.pi else "rad"
        findings.append(f"{joint}: position {columns['position'].column} taken as {unit}: it travels {travel:.4g}")
    document: dict[str, object] = {"position": {"column": columns["position"].column, "unit": unit}}
    if velocity is not None and speeds is not None:
        found = velocity.unit or _velocity_unit(joint, time_s, position, unit, speeds, findings)
        if found:
            document["velocity"] = {"column": velocity.column, "unit": found}
    if torque := columns.get("torque"):
        is_current = torque.unit in ("A", "mA") or re.search(
            r"current|strom|^i(q)?_?\d*$", torque.column, re.IGNORECASE
        )
        document["torque"] = {"column": torque.column, "unit": torque.unit or ("A" if is_current else "N m")}
        if is_current:
            document["torque"] |= {"torque_constant_nm_per_a": 1.0, "gear_ratio": 1.0}  # type: ignore[operator]
            findings.append(f"{joint}: torque {torque.column} looks like a current: say the motor's torque constant")
        elif not torque.unit:
            findings.append(f"{joint}: torque {torque.column} taken as N m on the joint's side of the gear")
    if command := columns.get("position_command"):
        document["position_command"] = {"column": command.column, "unit": command.unit or unit}
        (asked,) = table.numbers([command.column])
        if asked.size == position.size and time_s.size and (shift := _lag_s(time_s, asked, position)) is not None:
            findings.append(f"{joint}: the position follows the command by {1e3 * shift:.3g} ms")
    if "torque" not in document and "position_command" not in document:
        findings.append(f"{joint}: neither torque nor command was found: add one of them")
    return document


def _velocity_unit(
    joint: str, time_s: Array, position: Array, unit: str, speeds: Array, findings: list[str]
) -> str | None:
    """The unit in which the velocity is the differenced position; None where none fits."""
    if not time_s.size:
        return "rad/s"
    angle = unwrapped(np.deg2rad(position) if unit == "deg" else position)[0]
    moved, summed = travelled(time_s, angle, speeds)
    square = float(moved @ moved)
    if square <= 0.0:
        return "rad/s"
    factor = float(moved @ summed) / square
    correlation = factor * math.sqrt(square / max(float(summed @ summed), 1e-300))
    units = {"rad/s": 1.0, "deg/s": 180 / math.pi, "rpm": 30 / math.pi}
    best = min(units, key=lambda u: abs(math.log(max(abs(factor), 1e-12) / units[u])))
    if abs(correlation) < 0.9 or abs(factor / units[best] - 1.0) > 0.15:
        findings.append(
            f"{joint}: the velocity is left out: {factor:.4g} times the differenced position in rad "
            f"(correlation {correlation:.2f}), which is no unit of it"
        )
        return None
    findings.append(f"{joint}: velocity in {best}: it is {factor:.4g} times the differenced position in rad")
    return best


def _lag_s(time_s: Array, command: Array, position: Array) -> float | None:
    """How much later the position is than the command: where their speeds differ least; None where nothing moves."""
    step = float(np.median(np.diff(time_s)))
    if step <= 0.0 or time_s.size < 50:
        return None
    even = np.arange(0.0, min(float(time_s[-1]), 60.0), step)
    a, b = (_speed(np.interp(even, time_s, column)) for column in (command, position))
    most = min(even.size // 4, max(3, round(0.5 / step)))
    if not a.any() or not b.any():
        return None
    score = [-float(np.mean((b[k:] - a[: a.size - k]) ** 2)) for k in range(most - 1)]
    best = int(np.argmax(score))
    if 0 < best < most - 2:
        left, mid, right = score[best - 1 : best + 2]
        best_at = best + 0.5 * (left - right) / (left - 2 * mid + right) if left - 2 * mid + right else best
        return float(best_at * step)
    return best * step


def _speed(column: Array) -> Array:
    """The steps of a column, single jumps cut off."""
    steps = np.diff(column)
    most = float(np.quantile(np.abs(steps), 0.99))
    return np.clip(steps, -most, most)
