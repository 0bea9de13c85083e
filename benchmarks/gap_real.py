"""The diagnosis on real machines: fitted on some recordings, judged on others, both ways; every set, right or wrong.

Prints one line per set; ``--write-docs`` puts them into ``docs/evidence/data/gap-real.csv`` and the counts into
``gap-real.md``. The recordings are named by FRICTID_REAL_DATA and FRICTID_REAL_MORE_DATA; see their READMEs for origin,
licences and how the truth was found.
"""

from __future__ import annotations

import ast
import csv
import functools
import gzip
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.io
import yaml
from scipy import signal

from frictid_hil.errors import FrictidError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal

EMPS = {"mass_kg": 95.1089, "viscous_n_s_per_m": 203.5034, "coulomb_n": 20.3935, "offset_n": -3.1648}
MOTION_HZ = 8.0
"""Band of the pendulum's motion that its rigid-body torque is formed in."""
DOCS_PAGE = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "gap-real.md"
BEGIN, END = "<!-- written by benchmarks/gap_real.py -->", "<!-- end of what it wrote -->"
FALSE_CLEAR = 3.0
"""Gap over floor from which ``none`` is a false all-clear."""
SO101_JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")


def real_data(variable: str = "FRICTID_REAL_DATA", name: str = "real") -> Path | None:
    """Folder of the recordings, or None."""
    named = os.environ.get(variable)
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data" / name
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
                torque_demand_nm=_emps_demand(data, q, step),
                rigid_body_torque_nm=EMPS["mass_kg"] * acceleration + EMPS["offset_n"],
            )
        )
    return ExperimentSet("emps", Nominal(curve=curve), tuple(experiments))


def _emps_demand(data: Mapping[str, np.ndarray], position_m: np.ndarray, step_s: float) -> np.ndarray:
    """The law kv (kp e - v), in newtons by the drive's gain; ``pulses_N`` is in volts and added to it."""
    velocity = np.gradient(position_m, step_s)
    volts = data["kv"].item() * (data["kp"].item() * (data["qg"].ravel() - position_m) - velocity)
    if "pulses_N" in data:
        volts = volts + data["pulses_N"].ravel()
    newtons: np.ndarray = data["gtau"].item() * volts
    return newtons


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
    logs = swings(folder, prefix)
    judged = [(order % 2 == 1) == odd_judged for order in range(len(logs))]
    parts = [two_link(log, joint) for log in logs]
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


def swings(folder: Path, prefix: str) -> list[_Swing]:
    """All logs of one design of the double pendulum."""
    return [_swing(path) for path in sorted((folder / "double_pendulum").glob(f"{prefix}_*.csv.gz"))]


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


def two_link(log: _Swing, joint: int) -> np.ndarray:
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


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of a set's gap, whatever the diagnosis says.

    Attributes:
        accept: names (or verdicts) that are right first.
        floors: gap over the floor of machine and noise; None where nobody measured it.
        certainty: ``certain``, ``likely``, ``not_none`` or ``control``.
    """

    accept: tuple[str, ...]
    floors: float | None
    certainty: str


@dataclass(frozen=True, slots=True)
class Found:
    """One set, its diagnosis (or why there is none), and what is known."""

    name: str
    known: Known
    diagnosis: Diagnosis | None
    refused: str = ""

    @property
    def first(self) -> str:
        """The first cause, else the verdict."""
        d = self.diagnosis
        return "refused" if d is None else d.causes[0].effect if _names(d) else d.verdict

    @property
    def right(self) -> bool:
        """The first answer is right, or the diagnosis says that it can't tell it from a right one."""
        d = self.diagnosis
        if self.first in self.known.accept:
            return True
        return d is not None and _names(d) and bool(set(self.known.accept) & set(d.causes[0].confusable_with))

    @property
    def false_clear(self) -> bool:
        """``none`` beside a gap of three floors."""
        return self.first == "none" and (self.known.floors or 0.0) >= FALSE_CLEAR


def _names(d: Diagnosis) -> bool:
    return d.verdict in ("explained", "ambiguous") and bool(d.causes)


def cases(folder: Path | None, more: Path | None) -> Iterator[tuple[str, str, Known, Callable[[], ExperimentSet]]]:
    """(machine, set, what is known, how to load it), both ways where there are two."""
    if folder is not None:
        asymmetric = Known(("direction_asymmetry",), None, "likely")
        for pulses in (True, False):
            name = f"EMPS, judged on {'pulses' if pulses else 'the first'}"
            yield "EMPS, a linear axis", name, asymmetric, functools.partial(emps, folder, pulses)
        named = {("a0", 1): "load_dependent_friction", ("a0", 2): "presliding_hysteresis", ("c1", 1): "", ("c1", 2): ""}
        for (prefix, number), cause in named.items():
            known = Known((cause or "none", "unknown"), None, "likely" if cause else "control")
            for odd in (True, False):
                name = f"{prefix} joint {number}, judged on {'odd' if odd else 'even'} logs"
                make = functools.partial(double_pendulum, folder, prefix, number, odd)
                yield "Double pendulum", name, known, make
        late = Known(("torque_delay",), None, "likely")
        motions = sorted(path.name for path in (folder / "so101").iterdir() if path.is_dir())
        for joint in SO101_JOINTS:
            for judged in (motions[::2], motions[1::2]):
                name = f"{joint}, judged on {', '.join(judged)}"
                yield "SO-101, command and position", name, late, functools.partial(so101, folder, joint, judged)
    for path in sorted((more / "cases").glob("*/nominal.yaml")) if more is not None else ():
        case = path.parent.name
        truth = yaml.safe_load((path.parents[2] / "truth" / f"{case}.yaml").read_text())
        control = ["none", "unknown"] if truth["certainty"] == "control" else []
        accept = tuple(dict.fromkeys([*truth["accept"], *truth["expected"], *control]))
        known = Known(accept, truth["gap_over_floor"], truth["certainty"])
        yield str(truth["machine"]), case, known, functools.partial(ExperimentSet.load, path.parent)


def diagnosed(name: str, known: Known, make: Callable[[], ExperimentSet]) -> Found:
    """One set through the diagnosis; a refusal is an answer too, and a wrong one."""
    try:
        return Found(name, known, diagnose(make()))
    except FrictidError as error:
        return Found(name, known, None, str(error))


def page(found: Mapping[str, Sequence[Found]]) -> str:
    """The counts, and every set that was answered wrongly; all sets are in the table beside the page."""
    every = [f for group in found.values() for f in group]
    sure = [f for f in every if f.known.certainty == "certain"]
    gaps = [f for f in every if (f.known.floors or 0.0) >= FALSE_CLEAR]
    parts = [
        "| of all sets | count |",
        "|---|---|",
        f"| right first, or tied with what is right | {sum(f.right for f in every)} of {len(every)} |",
        f"| ... where the cause is certain | {sum(f.right for f in sure)} of {len(sure)} |",
        f"| `none` beside {FALSE_CLEAR:g} floors or more | {sum(f.false_clear for f in gaps)} of {len(gaps)} |",
        f"| refused | {sum(f.diagnosis is None for f in every)} of {len(every)} |",
        "",
        "Answered wrongly:",
        "",
        *(f"- {f.name}: known is {_cells(f)[2]}, answered was {_cells(f)[3]}" for f in every if not f.right),
    ]
    return "\n".join(parts)


HEADS = ("machine", "set", "floors", "known", "answer", "closes", "judged")


def _cells(f: Found) -> tuple[str, ...]:
    """Set, floors, what is known, the answer, how much of the gap it closes, and whether it is right."""
    known = f"{' or '.join(f.known.accept)} ({f.known.certainty.replace('_', ' ')})"
    floors = "-" if f.known.floors is None else f"{f.known.floors:.3g}"
    mark = "right" if f.right else "false all-clear" if f.false_clear else "wrong"
    if f.diagnosis is None:
        return f.name, floors, known, f"refused: {f.refused}", "", mark
    d = f.diagnosis
    told = "; ".join(
        f"{c.effect} {c.confidence:.2f}{' (or ' + ', '.join(c.confusable_with) + ')' if c.confusable_with else ''}"
        for c in d.causes
    )
    pair = (d.before.inverse_nm, d.after.inverse_nm)
    if pair[0] is None:
        pair = (d.before.forward_position_rad, d.after.forward_position_rad)
    closes = "-" if pair[0] is None or pair[1] is None or pair[0] == 0.0 else f"{100 * (1 - pair[1] / pair[0]):.0f} %"
    return f.name, floors, known, f"{d.verdict}{': ' + told if told else ''}", closes, mark


def main() -> int:
    """Print a line per set; with ``--write-docs`` put the counts into the docs page, and every set into its table."""
    folder, more = real_data(), real_data("FRICTID_REAL_MORE_DATA", "real-more")
    if folder is None and more is None:
        print("no recordings: set FRICTID_REAL_DATA, FRICTID_REAL_MORE_DATA", file=sys.stderr)
        return 1
    found: dict[str, list[Found]] = {}
    for machine, name, known, make in cases(folder, more):
        begin = time.process_time()
        found.setdefault(machine, []).append(diagnosed(name, known, make))
        print(*_cells(found[machine][-1]), f"{time.process_time() - begin:.1f} s", sep=" | ", flush=True)
    if "--write-docs" in sys.argv:
        before, rest = DOCS_PAGE.read_text().split(BEGIN, 1)
        DOCS_PAGE.write_text(f"{before}{BEGIN}\n\n{page(found)}\n\n{END}{rest.split(END, 1)[1]}")
        with (DOCS_PAGE.parent / "data" / "gap-real.csv").open("w", newline="", encoding="utf-8") as file:
            rows = [(machine, *_cells(f)) for machine, group in found.items() for f in group]
            csv.writer(file, lineterminator="\n").writerows([HEADS, *rows])
    return 0


if __name__ == "__main__":
    sys.exit(main())
