"""The diagnosis on real machines: fitted on some recordings, judged on others, both ways.

Prints one line per set and direction: verdict, causes, and every effect's held-out change. The recordings are named by
FRICTID_REAL_DATA; see their README for origin and licences.
"""

from __future__ import annotations

import ast
import gzip
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import scipy.io
import yaml

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal

EMPS = {"mass_kg": 95.1089, "viscous_n_s_per_m": 203.5034, "coulomb_n": 20.3935, "offset_n": -3.1648}
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
        if "pulses_N" in data:
            # The pulses are an added force: the drive did not deliver it.
            force = force + data["pulses_N"].ravel()
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


def double_pendulum(folder: Path, prefix: str, joint: int, odd_judged: bool) -> ExperimentSet:
    """One joint of the double pendulum; the two-link model gives the rigid-body torque."""
    root = folder / "double_pendulum"
    p = yaml.safe_load((root / "a0_model_parameters.yml").read_text())
    experiments = []
    for order, path in enumerate(sorted(root.glob(f"{prefix}_*.csv.gz"))):
        with gzip.open(path, "rt") as file:
            names = file.readline().strip().split(",")
            table = np.loadtxt(file, delimiter=",")
        columns = {name: table[:, k] for k, name in enumerate(names)}
        measured = "pos_meas1" in columns
        time = columns["time"]
        q = [columns[f"pos_meas{k}" if measured else f"pos{k}"] for k in (1, 2)]
        torque = columns[f"tau_meas{joint}" if measured else f"tau{joint}"]
        keep = np.concatenate([[True], np.diff(time) > 1e-5])
        step = float(np.median(np.diff(time[keep])))
        even = np.arange(time[keep][0], time[keep][-1], step)
        q1, q2 = (np.interp(even, time[keep], x[keep]) for x in q)
        rigid = _two_link(p, q1, q2, step)[joint - 1]
        experiments.append(
            Experiment(
                name=path.name.removesuffix(".csv.gz"),
                validation=(order % 2 == 1) == odd_judged,
                payload=False,
                run_order=order,
                time_s=even,
                position_rad=(q1, q2)[joint - 1],
                torque_nm=np.interp(even, time[keep], torque[keep]),
                rigid_body_torque_nm=rigid,
            )
        )
    return ExperimentSet(f"double_pendulum {prefix} joint {joint}", Nominal(), tuple(experiments))


def _two_link(p: dict[str, float], q1: np.ndarray, q2: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Torques of the two-link model (inertias about the joints, angle 0 hanging down)."""
    v1, v2 = np.gradient(q1, step), np.gradient(q2, step)
    a1, a2 = np.zeros_like(q1), np.zeros_like(q2)
    a1[1:-1] = (q1[2:] - 2 * q1[1:-1] + q1[:-2]) / step**2
    a2[1:-1] = (q2[2:] - 2 * q2[1:-1] + q2[:-2]) / step**2
    coupling = p["m2"] * p["l1"] * p["r2"]
    m11 = p["I1"] + p["I2"] + p["m2"] * p["l1"] ** 2 + 2 * coupling * np.cos(q2)
    m12 = p["I2"] + coupling * np.cos(q2)
    centrifugal = coupling * np.sin(q2)
    outer = p["m2"] * p["g"] * p["r2"] * np.sin(q1 + q2)
    inner = p["m1"] * p["g"] * p["r1"] * np.sin(q1) + p["m2"] * p["g"] * p["l1"] * np.sin(q1)
    first = m11 * a1 + m12 * a2 - centrifugal * (2 * v1 * v2 + v2**2) + inner + outer
    second = m12 * a1 + p["I2"] * a2 + centrifugal * v1**2 + outer
    return first, second


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
    for prefix, joint in (("a0", 1), ("a0", 2), ("c1", 1), ("c1", 2)):
        for odd in (True, False):
            half = "odd" if odd else "even"
            yield f"{prefix} joint {joint}, judged on {half} logs", double_pendulum(folder, prefix, joint, odd)
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


def main() -> int:
    """Print the table."""
    folder = real_data()
    if folder is None:
        print("no recordings: set FRICTID_REAL_DATA", file=sys.stderr)
        return 1
    for name, experiments in cases(folder):
        print(row(name, diagnose(experiments)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
