"""The diagnosis on real machines: fitted on some recordings, judged on others, both ways.

Prints one line per set and direction: verdict, causes, and every effect's held-out change; ``--write-docs`` puts the
tables into ``docs/evidence/gap-real.md``. The recordings are named by
FRICTID_REAL_DATA; see their README for origin and licences.
"""

from __future__ import annotations

import ast
import gzip
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
from scipy import signal

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.simulation.effects import all_effects

EMPS = {"mass_kg": 95.1089, "viscous_n_s_per_m": 203.5034, "coulomb_n": 20.3935, "offset_n": -3.1648}
MOTION_HZ = 8.0
"""Band of the pendulum's motion that its rigid-body torque is formed in."""
DOCS_PAGE = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "gap-real.md"
BEGIN, END = "<!-- written by benchmarks/gap_real.py -->", "<!-- end of what it wrote -->"
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
SO101_JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")


def real_data() -> Path | None:
    """Folder of the recordings, or None."""
    named = os.environ.get("FRICTID_REAL_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data" / "real"
    return folder if folder.is_dir() else None


def emps(folder: Path, judge_pulses: bool) -> ExperimentSet:
    """The EMPS axis with its published parameters; metres and newtons in the places of radians and N m."""
    speeds = np.array([0.05, 0.1])
    curve = FrictionCurve.through(speeds, EMPS["coulomb_n"] + EMPS["viscous_n_s_per_m"] * speeds)
    experiments = []
    for order, name in enumerate(("DATA_EMPS", "DATA_EMPS_PULSES")):
        data = scipy.io.loadmat(folder / "emps" / f"{name}.mat")
        q, t = data["qm"].ravel(), data["t"].ravel()
        step = float(np.median(np.diff(t)))
        acceleration = np.zeros_like(q)
        acceleration[1:-1] = (q[2:] - 2 * q[1:-1] + q[:-2]) / step**2
        force = data["gtau"].item() * data["vir"].ravel()
        # `pulses_N` is left alone: fitted as a force, its share is 0.00, so the drive's own force holds it already.
        experiments.append(
            Experiment(
                name=name.lower(),
                validation=(order == 1) == judge_pulses,
                payload=False,
                run_order=order,
                time_s=t,
                position_rad=q,
                torque_nm=force,
                rigid_body_torque_nm=EMPS["mass_kg"] * acceleration + EMPS["offset_n"],
            )
        )
    return ExperimentSet("emps", Nominal(curve=curve), tuple(experiments))


@dataclass(frozen=True, slots=True)
class _Swing:
    """One log of the double pendulum on a uniform clock; arrays of shape (n,), per joint."""

    name: str
    time_s: np.ndarray
    position_rad: tuple[np.ndarray, np.ndarray]
    torque_nm: tuple[np.ndarray, np.ndarray]


def double_pendulum(folder: Path, prefix: str, joint: int, odd_judged: bool) -> ExperimentSet:
    """One joint of the double pendulum; a two-link model fitted on the identification logs gives its rigid part.

    The published parameters are of design A.0 and of no use for C.1, whose links are others; so both are identified.
    """
    logs = [_swing(path) for path in sorted((folder / "double_pendulum").glob(f"{prefix}_*.csv.gz"))]
    judged = [(order % 2 == 1) == odd_judged for order in range(len(logs))]
    parts = [_two_link(log, joint) for log in logs]
    known = [k for k, unseen in enumerate(judged) if not unseen]
    columns = np.concatenate([_filtered(_with_friction(parts[k], logs[k], joint), logs[k]) for k in known])
    torque = np.concatenate([_filtered(logs[k].torque_nm[joint - 1][:, None], logs[k])[:, 0] for k in known])
    scale = np.maximum(np.max(np.abs(columns), axis=0), 1e-9)
    weights = np.linalg.lstsq(columns / scale, torque, rcond=1e-8)[0] / scale
    experiments = [
        Experiment(
            name=log.name,
            validation=unseen,
            payload=False,
            run_order=order,
            time_s=log.time_s,
            position_rad=log.position_rad[joint - 1],
            torque_nm=log.torque_nm[joint - 1],
            rigid_body_torque_nm=part @ weights[: part.shape[1]],
        )
        for order, (log, part, unseen) in enumerate(zip(logs, parts, judged, strict=True))
    ]
    return ExperimentSet(f"double_pendulum {prefix} joint {joint}", Nominal(), tuple(experiments))


def _swing(path: Path) -> _Swing:
    with gzip.open(path, "rt") as file:
        names = file.readline().strip().split(",")
        table = np.loadtxt(file, delimiter=",")
    columns = {name: table[:, k] for k, name in enumerate(names)}
    kind = "_meas" if "pos_meas1" in columns else ""
    time = columns["time"]
    keep = np.concatenate([[True], np.diff(time) > 1e-5])
    even = np.arange(time[keep][0], time[keep][-1], float(np.median(np.diff(time[keep]))))
    position = [np.interp(even, time[keep], columns[f"pos{kind}{k}"][keep]) for k in (1, 2)]
    torque = [np.interp(even, time[keep], columns[f"tau{kind}{k}"][keep]) for k in (1, 2)]
    return _Swing(path.name.removesuffix(".csv.gz"), even, (position[0], position[1]), (torque[0], torque[1]))


def _two_link(log: _Swing, joint: int) -> np.ndarray:
    """Columns of the two-link model, linear in its five base parameters (angle 0 hanging down), shape (n, 5).

    The encoder's step of 0.38 mrad makes noise of 1 rad/s2 at 20 Hz: positions pass 8 Hz before they are
    differentiated.
    """
    step = float(log.time_s[1] - log.time_s[0])
    b, a = signal.butter(2, MOTION_HZ * 2.0 * step)
    q1, q2 = (signal.filtfilt(b, a, q) for q in log.position_rad)
    v1, v2 = np.gradient(q1, step), np.gradient(q2, step)
    a1, a2 = np.gradient(v1, step), np.gradient(v2, step)
    cos, sin, none = np.cos(q2), np.sin(q2), np.zeros_like(q1)
    outer = np.sin(q1 + q2)
    if joint == 1:
        coupled = cos * (2.0 * a1 + a2) - sin * (2.0 * v1 * v2 + v2**2)
        return np.stack([a1, a2, coupled, np.sin(q1), outer], axis=1)
    return np.stack([none, a1 + a2, cos * a1 + sin * v1**2, none, outer], axis=1)


def _with_friction(columns: np.ndarray, log: _Swing, joint: int) -> np.ndarray:
    """Beside Coulomb, viscous friction and an offset, so that these do not bend the rigid part."""
    step = float(log.time_s[1] - log.time_s[0])
    b, a = signal.butter(2, MOTION_HZ * 2.0 * step)
    velocity = np.gradient(signal.filtfilt(b, a, log.position_rad[joint - 1]), step)
    friction = np.stack([np.tanh(velocity / 0.05), velocity, np.ones_like(velocity)], axis=1)
    return np.concatenate([columns, friction], axis=1)


def _filtered(columns: np.ndarray, log: _Swing) -> np.ndarray:
    step = float(log.time_s[1] - log.time_s[0])
    b, a = signal.butter(2, 10.0 * 2.0 * step)
    every = max(1, round(1.0 / (60.0 * step)))
    filtered: np.ndarray = signal.filtfilt(b, a, columns, axis=0)[30:-30:every]
    return filtered


def so101(folder: Path, joint: str, judged: Sequence[str], only: Sequence[str] = ()) -> ExperimentSet:
    """One joint of the SO-101 arm: command and position."""
    experiments = []
    for order, motion in enumerate(sorted(path for path in (folder / "so101").iterdir() if path.is_dir())):
        if only and motion.name not in only:
            continue
        command_time, command = _so101_column(motion / "control.csv.gz", joint)
        time, position = _so101_column(motion / "state_motor.csv.gz", joint)
        start, end = max(time[0], command_time[0]), min(time[-1], command_time[-1])
        even = np.arange(start, end, float(np.median(np.diff(time))))
        followed = np.interp(even, command_time, command)
        if np.ptp(followed) < 0.05:
            continue
        experiments.append(
            Experiment(
                name=motion.name,
                validation=motion.name in judged,
                payload=False,
                run_order=order,
                time_s=even - start,
                position_rad=np.interp(even, time, position),
                position_command_rad=followed,
            )
        )
    return ExperimentSet(f"so101 {joint}", Nominal(), tuple(experiments))


def _so101_column(path: Path, joint: str) -> tuple[np.ndarray, np.ndarray]:
    names = (path.parent / "joint_list.txt").read_text().split()
    times, values = [], []
    with gzip.open(path, "rt") as file:
        header = file.readline().strip().split(",")
        at = {name: k for k, name in enumerate(header)}
        for row in _rows(file):
            times.append(float(row[at["timestamp"]]) * 1e-6)
            values.append(ast.literal_eval(row[at["positions"]])[names.index(joint)])
    time, order = np.unique(np.asarray(times), return_index=True)
    return time, np.asarray(values, dtype=np.float64)[order]


def _rows(file: object) -> Iterator[list[str]]:
    import csv

    yield from csv.reader(file)  # type: ignore[arg-type]


def cases(folder: Path) -> Iterator[tuple[str, ExperimentSet]]:
    """Every set with its name, both ways where there are two."""
    for pulses in (True, False):
        yield f"EMPS, judged on {'pulses' if pulses else 'the first'}", emps(folder, pulses)
    for prefix, number in (("a0", 1), ("a0", 2), ("c1", 1), ("c1", 2)):
        for odd in (True, False):
            half = "odd" if odd else "even"
            yield f"{prefix} joint {number}, judged on {half} logs", double_pendulum(folder, prefix, number, odd)
    motions = sorted(path.name for path in (folder / "so101").iterdir() if path.is_dir())
    for joint in SO101_JOINTS:
        for judged in (motions[::2], motions[1::2]):
            yield f"SO-101 {joint}, judged on {', '.join(judged)}", so101(folder, joint, judged)
    yield "SO-101 Elbow, backlash_detection alone", so101(folder, "Elbow", (), ("backlash_detection",))


def row(name: str, d: Diagnosis) -> str:
    """One line of the table."""
    causes = ", ".join(f"{c.effect} {c.confidence:.2f} ({'/'.join(c.confusable_with)})" for c in d.causes)
    held_out = " ".join(f"{effect} {value:+.0f}%" for effect, value in sorted(d.held_out.items(), key=lambda x: x[1]))
    return f"{name} | {d.verdict} | {causes} | {held_out}"


GROUPS = {"EMPS": "EMPS, a linear axis", "a0": "Double pendulum, design A.0", "c1": "Double pendulum, design C.1"}
"""Headings by the beginning of a set's name; the rest is the SO-101 arm."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What was expected of some sets before they were diagnosed.

    Attributes:
        text: as a person says it.
        sets: beginning of the sets' names.
        holds: whether one diagnosis is as expected.
    """

    text: str
    sets: str
    holds: Callable[[Diagnosis], bool]


def _first(effect: str) -> Callable[[Diagnosis], bool]:
    return lambda d: bool(d.causes) and d.causes[0].effect == effect


def _largest(effect: str) -> Callable[[Diagnosis], bool]:
    return lambda d: bool(d.held_out) and min(d.held_out, key=lambda name: d.held_out[name]) == effect


def _flagged(effect: str, partner: str) -> Callable[[Diagnosis], bool]:
    return lambda d: any(c.effect == effect and partner in c.confusable_with for c in d.causes)


def _play_with_its_partner(d: Diagnosis) -> bool:
    found = [c for c in d.causes if c.effect in ("backlash", "stiction_breakaway")]
    return bool(found) and {"backlash", "stiction_breakaway"} & set(found[0].confusable_with) != set()


EXPECTED = (
    Expected("EMPS: direction asymmetry named first", "EMPS", _first("direction_asymmetry")),
    Expected("EMPS: direction asymmetry with the largest held-out change", "EMPS", _largest("direction_asymmetry")),
    Expected(
        "EMPS: presliding flagged as its partner", "EMPS", _flagged("direction_asymmetry", "presliding_hysteresis")
    ),
    Expected("A.0, first joint: load-dependent friction first", "a0 joint 1", _first("load_dependent_friction")),
    Expected("A.0, second joint: presliding hysteresis first", "a0 joint 2", _first("presliding_hysteresis")),
    Expected("C.1, both joints: none", "c1", lambda d: d.verdict == "none"),
    Expected("SO-101: torque delay named first", "SO-101", _first("torque_delay")),
    Expected("SO-101: then play or stiction, the other one flagged", "SO-101", _play_with_its_partner),
    Expected("SO-101, one log of one joint: ambiguous", "SO-101 Elbow, backlash", lambda d: d.verdict == "ambiguous"),
)


def page(found: Mapping[str, Diagnosis]) -> str:
    """The tables of ``docs/evidence/gap-real.md``."""
    parts = ["## What was expected, and what came\n", "| expected | sets as expected |", "|---|---|"]
    for expected in EXPECTED:
        chosen = {name: d for name, d in found.items() if name.startswith(expected.sets)}
        held = [name for name, d in chosen.items() if expected.holds(d)]
        parts.append(f"| {expected.text} | {len(held)} of {len(chosen)} |")
    for prefix, title in (*GROUPS.items(), ("SO-101", "SO-101, a hobby arm: command and position only")):
        parts += ["", f"## {title}", "", *_group({n: d for n, d in found.items() if n.startswith(prefix)})]
    return "\n".join(parts)


def _group(found: Mapping[str, Diagnosis]) -> list[str]:
    unit = "rad" if all(d.before.inverse_nm is None for d in found.values()) else "N m"
    lines = [
        f"| set | verdict | causes (confidence; confusable with) | gap before, after [{unit}] |",
        "|---|---|---|---|",
    ]
    for letter, (name, d) in zip(LETTERS, found.items(), strict=False):
        causes = "; ".join(
            f"{c.effect} ({c.confidence:.2f}{'; ' + ', '.join(c.confusable_with) if c.confusable_with else ''})"
            for c in d.causes
        )
        before, after = (f.inverse_nm if unit == "N m" else f.forward_position_rad for f in (d.before, d.after))
        lines.append(f"| {letter}: {name} | {d.verdict} | {causes} | {before:.3g}, {after:.3g} |")
    effects = sorted({effect for d in found.values() for effect in d.held_out})
    lines += [
        "",
        "Change of the held-out RMS when an effect alone is added:"
        if unit == "rad"
        else "Change of the held-out RMS when an effect alone is added (negative: better on logs that did not fit it):",
        "",
        f"| effect | {' | '.join(LETTERS[: len(found)])} |",
        f"|---{'|---' * len(found)}|",
    ]
    for effect in effects:
        changes = (d.held_out.get(effect) for d in found.values())
        cells = ("-" if change is None else f"{change:+.1f} %" for change in changes)
        lines.append(f"| {effect} | {' | '.join(cells)} |")
    absent = sorted(set(all_effects()) - set(effects))
    lines += ["", f"Cannot be formed on these recordings: {', '.join(absent)}.", ""]
    reasons = {subject: why for d in found.values() for subject, why in d.reasons.items()}
    lines += [f"- {subject}: {why}" for subject, why in sorted(reasons.items())]
    return lines


def main() -> int:
    """Print a line per set; with ``--write-docs`` put the tables into the docs page."""
    folder = real_data()
    if folder is None:
        print("no recordings: set FRICTID_REAL_DATA", file=sys.stderr)
        return 1
    found = {}
    for name, experiments in cases(folder):
        found[name] = diagnose(experiments)
        print(row(name, found[name]), flush=True)
    if "--write-docs" in sys.argv:
        before, rest = DOCS_PAGE.read_text().split(BEGIN, 1)
        DOCS_PAGE.write_text(f"{before}{BEGIN}\n\n{page(found)}\n\n{END}{rest.split(END, 1)[1]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
