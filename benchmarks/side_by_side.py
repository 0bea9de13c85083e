"""The procedure beside what a user would pick instead, on the same simulated joint, noise, torque and travel limit.

    python benchmarks/side_by_side.py [--joints 1,4] [--plants rigid,flexible,load] [--amplitudes 20,5] [--docs docs]

Plants: rigid; flexible (link resonance 28 Hz); load (friction grows by 5 % of the load torque). The servo loop is
advanced without a bus, cycle by cycle, so that every method meets exactly the same joint. Prints every row, those that
we lose included, and writes ``evidence/data/side-by-side.csv`` into the folder of ``--docs``.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import estimators
import numpy as np
from other_methods import TORQUE_SHARE, Outcome, Task, constant_velocity, fourier, torque_sine

from frictid_hil.errors import FrictidError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.friction.quality import gates
from frictid_hil.friction.recording import CycleRecording
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.identification.programmes import PROGRAMMES

V_RAD_S = math.radians(115.0)
PLANTS = {"rigid": "rigid", "flexible": "flexible, 28 Hz", "load": "5 % load-dependent friction"}


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    method: str
    ours: bool
    outcome: Outcome
    error_percent: float
    inner_percent: float

    def cells(self) -> list[str]:
        """As the table of every method holds it, in the order of ``COLUMNS``."""
        out = self.outcome
        low, high = np.degrees(out.speeds_rad_s)
        found = out.curve is not None
        return [
            self.method,
            "yes" if self.ours else "no",
            f"{self.error_percent:.2f}" if found else "",
            f"{self.inner_percent:.2f}" if found else "",
            f"{out.time_s:.1f}" if out.time_s else "",
            f"{math.degrees(out.travel_rad):.1f}" if out.travel_rad else "",
            f"{low:.1f}" if found else "",
            f"{high:.1f}" if found else "",
            "; ".join(part for part in (out.setting, out.remark) if part),
        ]


def row(task: Task, method: str, outcome: Outcome, *, ours: bool = False) -> Row:
    error = inner = math.inf
    if outcome.curve is not None:
        far = curve_distance(outcome.curve, task.truth, task.velocity_rad_s)
        error, inner = far.e_percent, far.e_percent_measured_range
    return Row(method, ours, outcome, error, inner)


def our_rows(task: Task) -> Iterable[Row]:
    """Every estimator on the N cycles, and the short programmes; at a lower V where V needs too much torque."""
    most = math.sqrt(max(task.spare_torque_nm, 0.0) * task.amplitude_rad / (2 * task.model.inertia_kg_m2))
    velocity = min(task.velocity_rad_s, most)
    remark = (
        ""
        if velocity == task.velocity_rad_s
        else (
            f"V lowered to {math.degrees(velocity):.0f} deg/s: at 115 deg/s the plan needs more than "
            f"{100 * TORQUE_SHARE:.0f} % of the torque limit"
        )
    )
    thorough = Procedure(task.amplitude_rad, velocity)
    recording = estimators.record(task.model, task.start_rad, thorough, seed=task.seed)
    for method in ("function-a", "aligned", "least-squares"):
        yield _ours(task, method if method != "function-a" else "function-a (as published)", recording, method, remark)
    for name in ("standard", "quick"):
        shares = PROGRAMMES[name].shares
        procedure = Procedure(task.amplitude_rad, velocity, len(shares), shares=shares)
        short = estimators.record(task.model, task.start_rad, procedure, seed=task.seed, again=len(shares) // 2 + 1)
        yield _ours(task, f"least-squares, --program {name}", short, "least-squares", remark)


def _ours(task: Task, name: str, recording: CycleRecording, method: str, remark: str) -> Row:
    travel = float(np.ptp(recording.position_rad))
    time_s = recording.procedure.duration_s
    try:
        found = estimate(recording, method)
        curve: FrictionCurve | None = found.curve
        failed = ", ".join(gate.name for gate in gates(recording, found) if not gate.passed)
        remark = "; ".join(part for part in (remark, f"flagged: {failed}" if failed else "") if part)
    except FrictidError as problem:
        return row(task, name, Outcome("", None, time_s, travel, (0.0, 0.0), problem.what), ours=True)
    assert curve is not None
    return row(task, name, Outcome("", curve, time_s, travel, curve.measured_range_rad_s, remark), ours=True)


def others_rows(task: Task) -> Iterable[Row]:
    yield row(task, "constant velocity", constant_velocity(task))
    yield row(task, "Fourier + Coulomb/viscous", fourier(task))
    yield row(task, "torque sine", torque_sine(task))


def lost(rows: list[Row], kind: str, amplitude_deg: float) -> Iterable[str]:
    """Who is ahead of our default, who of all of ours, and why."""
    default = next(entry for entry in rows if entry.method == "aligned").error_percent
    top = min(entry.error_percent for entry in rows if entry.ours)
    for entry in rows:
        if not entry.ours and entry.error_percent < default:
            why = LOADED if kind == "load" and amplitude_deg < 10 else WHY[entry.method]
            whom = "all of ours" if entry.error_percent < top else "`aligned`, behind our best"
            yield f"{entry.method} is ahead of {whom}, because {why}"


WHY = {
    "constant velocity": "its acceleration, feed-forward and settling time were chosen by the truth, and its first "
    "speed happens to continue the Stribeck dip by a better line",
    "Fourier + Coulomb/viscous": "its two parameters, chosen by the truth, nearly make a line of this curve",
    "torque sine": "its torque was chosen by the truth",
}
LOADED = "the link's own acceleration loads the gear and raises its friction within our windows; a plateau has none"

TOLD = "error_percent_over_0_v"
COLUMNS = [
    "plant",
    "amplitude_deg",
    "joint",
    "method",
    "ours",
    TOLD,
    "error_percent_over_measured_range",
    "time_s",
    "travel_deg",
    "lowest_speed_deg_s",
    "highest_speed_deg_s",
    "setting_remark",
]


def by_case(cells: Sequence[Sequence[str]]) -> dict[tuple[str, ...], dict[str, dict[str, str]]]:
    """The rows of each plant, travel and joint, by method."""
    cases: dict[tuple[str, ...], dict[str, dict[str, str]]] = {}
    for entry in cells:
        row = dict(zip(COLUMNS, entry, strict=True))
        cases.setdefault(tuple(entry[:3]), {})[row["method"]] = row
    return cases


def ahead(cells: Sequence[Sequence[str]], method: str) -> str:
    """In how many cases a method of ours is ahead of all others."""
    cases = by_case(cells).values()
    wins = [
        all(float(case[method][TOLD]) < float(row[TOLD] or math.inf) for row in case.values() if row["ours"] == "no")
        for case in cases
    ]
    return f"{sum(wins)} of {len(wins)} cases"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joints", default="1,4")
    parser.add_argument("--plants", default=",".join(PLANTS))
    parser.add_argument("--amplitudes", default="20,5")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--docs", type=Path, help="Folder whose evidence/data/side-by-side.csv is written.")
    arguments = parser.parse_args()
    models = estimators.joints()
    cells: list[list[str]] = []
    losses: dict[str, list[str]] = {}
    for kind in arguments.plants.split(","):
        for amplitude in map(float, arguments.amplitudes.split(",")):
            for joint in arguments.joints.split(","):
                base, start = models[joint]
                model = estimators.plant(kind, base)
                procedure = Procedure(math.radians(amplitude), V_RAD_S)
                truth = estimators.truth(model, procedure, start)
                task = Task(model, start, procedure.amplitude_rad, V_RAD_S, truth, arguments.seed)
                rows = [*our_rows(task), *others_rows(task)]
                rows.sort(key=lambda entry: entry.error_percent)
                here = [[PLANTS[kind], f"{amplitude:g}", joint, *entry.cells()] for entry in rows]
                print(*(" | ".join(entry) for entry in here), sep="\n", flush=True)
                cells += here
                for said in lost(rows, kind, amplitude):
                    losses.setdefault(said, []).append(f"{PLANTS[kind]}, A = {amplitude:g} deg, joint {joint}")
    for what, where in losses.items():
        print(f"{what}: {'; '.join(where)}")
    for method in ("least-squares", "aligned"):
        print(f"{method}: ahead of every method of others in {ahead(cells, method)}")
    if arguments.docs:
        with (arguments.docs / "evidence" / "data" / "side-by-side.csv").open(
            "w", newline="", encoding="utf-8"
        ) as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *cells])


if __name__ == "__main__":
    main()
