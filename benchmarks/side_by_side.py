"""The procedure beside what a user would pick instead, on the same simulated joint, noise, torque and travel limit.

    python benchmarks/side_by_side.py [--joints 1,4] [--plants rigid,flexible,load] [--amplitudes 20,5] [--docs docs]

Plants: rigid; flexible (link resonance 28 Hz); load (friction grows by 5 % of the load torque). The servo loop is
advanced without a bus, cycle by cycle, so that every method meets exactly the same joint. Prints every row, those that
we lose included, and writes the page into the folder of ``--docs``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import estimators
import numpy as np
import why_lost
from other_methods import TORQUE_SHARE, Outcome, Task, constant_velocity, fourier, torque_sine

from frictid_hil.config.provenance import git_revision
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
        """As the table shows it."""
        out = self.outcome
        low, high = np.degrees(out.speeds_rad_s)
        found = out.curve is not None
        return [
            f"**{self.method}**" if self.ours else self.method,
            f"{self.error_percent:.2f}" if found else "-",
            f"{self.inner_percent:.2f}" if found else "-",
            f"{out.time_s:.1f}" if out.time_s else "-",
            f"{math.degrees(out.travel_rad):.1f}" if out.travel_rad else "-",
            f"{low:.1f} .. {high:.1f}" if found else "-",
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


def lost(rows: list[Row], kind: str, amplitude_deg: float) -> str:
    """Who is ahead of our default, who of all of ours, and why."""
    default = next(entry for entry in rows if entry.method == "aligned").error_percent
    top = min(entry.error_percent for entry in rows if entry.ours)
    told = []
    for entry in rows:
        if not entry.ours and entry.error_percent < default:
            why = LOADED if kind == "load" and amplitude_deg < 10 else WHY[entry.method]
            whom = "all of ours" if entry.error_percent < top else "aligned, behind our best"
            told.append(f"{entry.method} is ahead of {whom} ({why})")
    return "; ".join(told)


WHY = {
    "constant velocity": "acceleration, feed-forward and settling time were chosen by the truth, and its first speed "
    "happens to continue the Stribeck dip by a better line",
    "Fourier + Coulomb/viscous": "its two parameters, chosen by the truth, nearly make a line of this curve",
    "torque sine": "its torque was chosen by the truth",
}
LOADED = "the link's own acceleration loads the gear and raises its friction within our windows; a plateau has none"

HEADINGS = [
    "method",
    "error, [0, V] [%]",
    "error, measured range [%]",
    "time [s]",
    "travel [deg]",
    "speeds [deg/s]",
    "setting, remark",
]


PAGE = """# Side by side with what one would pick instead

The same simulated joints of `hp3j.yaml`, servo loop, noise, torque limit and travel for everybody; V = 115 deg/s; the
error of the identified curve to the joint's own, in percent of its mean, over [0, V] and over the curve's own measured
range; time without the moves to and from the start. Rows in bold are this tool's, sorted by the error over [0, V].

- **Our rows have one setting**, the default of the tool. **The others had their settings chosen by the error to the
  truth**, which no user could do, and the true inertia and gravity for feed-forward and gravity compensation.
- Constant velocity: ten speeds n V / 10 to and fro, trapezoidal; accelerations 3 to 80 rad/s2 as far as torque allows,
  with and without feed-forward, 5 to 80 ms to settle.
- Fourier: five harmonics of 0.1 to 2 Hz, three draws, 16 s, scaled to the travel, V and the torque limit; Coulomb and
  viscous friction, inertia, gravity and bias by least squares; speeds below 0.02, 0.1 or 0.3 rad/s left out.
- Torque sine: 0.5 to 4 Hz, six sizes, begun gently in the middle of the travel, perfect gravity compensation; it ends
  where the joint leaves the travel.

Written by `python benchmarks/side_by_side.py --docs docs` at commit {commit}. No bus here: every method meets exactly
the same joint, cycle by cycle. What the bus adds to ours is shown in [the paper's section 4](paper-section4.md). Why a
row is ahead of ours is said below its table, and tested at the end of the page by taking the cause away.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joints", default="1,4")
    parser.add_argument("--plants", default=",".join(PLANTS))
    parser.add_argument("--amplitudes", default="20,5")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--docs", type=Path, help="Folder to write side-by-side.md to.")
    arguments = parser.parse_args()
    models = estimators.joints()
    text: list[str] = []
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
                block = [f"### {PLANTS[kind]}, A = {amplitude:g} deg, joint {joint}", ""]
                block += ["| " + " | ".join(HEADINGS) + " |", "|" + "---|" * len(HEADINGS)]
                block += ["| " + " | ".join(entry.cells()) + " |" for entry in rows]
                said = lost(rows, kind, amplitude)
                block += ["", f"Lost: {said}." if said else "Lost: nothing.", ""]
                print("\n".join(block), flush=True)
                text += block
    if arguments.docs:
        page = "\n".join([PAGE.format(commit=git_revision()[:7]), *text, why_lost.text()])
        (arguments.docs / "evidence" / "side-by-side.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
