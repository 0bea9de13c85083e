"""The experiments of the paper's section 4 on the simulated robot, each through bus, driver and scheduler.

    python benchmarks/paper_section4.py [--runs FOLDER] [--docs docs]

Figure 6: torque over velocity of joint 1 for several travels A. Figure 7: curves of every joint for A in 5, 10, 20,
30, 40, 50 deg. Figure 8: E(A, 50) of (15). Figure 9: joint 1 in five postures. V = 115 deg/s, N = 10, c = 0.8. Run
folders that are complete in FOLDER are read, not repeated. The table and the pictures of the page are written.
"""

from __future__ import annotations

import argparse
import csv
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from on_the_bus import V_RAD_S, Variant, calibrated, shipped, variant
from svg import PALETTE, Chart, Line, svg

from frictid_hil.config.profile import JointProfile
from frictid_hil.errors import PlanRefused
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import curve_distance, curve_mean
from frictid_hil.jobs.report import whole_profile
from frictid_hil.recording.read import read

AMPLITUDES = (5, 10, 20, 30, 40, 50)
JOINTS = ("0", "1", "2", "3", "4", "5")
COLOURS = dict(zip(AMPLITUDES, PALETTE, strict=True))
POSTURES = {
    "a": (2.20, 42.0, 6.0),
    "b": (1.60, 24.0, 3.0),
    "c": (2.60, 55.0, 8.0),
    "d": (1.90, 20.0, -34.0),
    "e": (2.40, 8.0, 48.0),
}
"""Inertia [kg m2], gravity_cos and gravity_sin [N m] of joint 1 as the arm beyond it folds and turns."""
HEADS = ("figure", "curve", "joint", "posture", "amplitude_deg", "value", "value_measured_range")
SPEED = np.linspace(0.0, V_RAD_S, 120)


@dataclass(frozen=True, slots=True)
class Run:
    """One joint at one travel.

    Attributes:
        folder: of the run.
        joint: as identified; None where the plan was refused.
        refused: why.
    """

    folder: Path
    joint: JointProfile | None
    refused: str = ""

    def curve(self, *, published: bool) -> FrictionCurve | None:
        """As published (Function A) or aligned; None where there is none."""
        if self.joint is None:
            return None
        if not published:
            return self.joint.curve()
        pairs = self.joint.published
        return (
            None if pairs is None else FrictionCurve.through(np.array(pairs.velocity_rad_s), np.array(pairs.torque_nm))
        )


def measured(robot: Variant, joint: str, amplitude_deg: float, folder: Path) -> Run:
    """Calibrate one joint, unless this folder holds the run already."""
    if not (folder / "profile.yaml").exists():
        try:
            calibrated(
                robot, folder, joints=(joint,), amplitude_rad=math.radians(amplitude_deg), velocity_rad_s=V_RAD_S
            )
        except PlanRefused as refusal:
            return Run(folder, None, refusal.what)
    return Run(folder, whole_profile(folder).joints[joint])


def posture(name: str, *, load_share: float = 0.0) -> dict[str, Any]:
    """The shipped robot with joint 1 as this posture loads it; friction may grow by a share of the load torque."""
    values = shipped()
    inertia, cosine, sine = POSTURES[name]
    joint = values["joints"]["1"]
    joint["simulated"].update(inertia_kg_m2=inertia, gravity_cos_nm=cosine, gravity_sin_nm=sine)
    joint["simulated"]["motor_inertia_share"] *= 2.2 / inertia
    joint["expected"].update(inertia_kg_m2=inertia, gravity_nm=math.hypot(cosine, sine))
    if load_share:
        joint["simulated"]["effects"]["load_dependent_friction"] = {"linear_share": load_share}
    return values


def distances(runs: dict[int, Run], *, published: bool) -> dict[int, float | None]:
    """E(A, 50) of (15) for every travel, N m."""
    last = runs[50].curve(published=published)
    assert last is not None
    found: dict[int, float | None] = {}
    for amplitude, run in runs.items():
        curve = run.curve(published=published)
        found[amplitude] = None if curve is None else curve_distance(curve, last, V_RAD_S).e_nm
    return found


def errors(run: Run, truth: FrictionCurve, *, published: bool) -> tuple[float, float] | None:
    """Percent of the truth's mean over [0, V] and over the measured range."""
    curve = run.curve(published=published)
    if curve is None:
        return None
    far = curve_distance(curve, truth, V_RAD_S)
    return far.e_percent, far.e_percent_measured_range


def line(label: str, curve: FrictionCurve, colour: str, width: float = 1.6) -> Line:
    return Line(label, np.degrees(SPEED), curve.magnitude(SPEED), colour, width)


def figure_6(runs: dict[int, Run]) -> str:
    """Loops and published curves, one panel per travel, gravity's middle removed."""
    charts = []
    for amplitude, run in runs.items():
        curve = run.curve(published=True)
        if curve is None:
            continue
        (samples,) = [samples for samples in read(run.folder, None) if samples.joint == "1"]
        part = samples.during(samples.marked("cycles")[0])
        assert part.torque_nm is not None and part.velocity_rad_s is not None
        middle = (float(np.quantile(part.torque_nm, 0.95)) + float(np.quantile(part.torque_nm, 0.05))) / 2
        every = max(1, part.time_s.size // 2500)
        loop = Line(
            "measured",
            np.degrees(part.velocity_rad_s[::every]),
            part.torque_nm[::every] - middle,
            "#8a8f98",
            0.6,
        )
        both = np.concatenate([-SPEED[:0:-1], [0.0, 0.0], SPEED[1:]])
        torque = np.concatenate(
            [-curve.magnitude(SPEED[:0:-1]), [-curve.coulomb_nm, curve.coulomb_nm], curve.magnitude(SPEED[1:])]
        )
        drawn = Line("identified, as published", np.degrees(both), torque, PALETTE[3], 2.0)
        charts.append(Chart(f"joint 1, A = {amplitude} deg", "velocity [deg/s]", "torque [N m]", (loop, drawn)))
    return svg(charts, columns=3)


def figure_7(runs: dict[str, dict[int, Run]], *, published: bool) -> str:
    charts = []
    for joint, of in runs.items():
        lines = [
            line(f"A = {amplitude} deg", curve, COLOURS[amplitude])
            for amplitude, run in of.items()
            if (curve := run.curve(published=published)) is not None
        ]
        charts.append(Chart(f"joint {joint}", "velocity [deg/s]", "friction [N m]", tuple(lines), from_zero=True))
    return svg(charts, columns=3)


def figure_8(e: dict[str, dict[int, float | None]], e_aligned: dict[str, dict[int, float | None]]) -> str:
    charts = []
    for joint in e:
        lines = []
        for label, of, colour in (("as published", e[joint], PALETTE[0]), ("aligned", e_aligned[joint], PALETTE[3])):
            known = [(amplitude, value) for amplitude, value in of.items() if value is not None]
            x, y = np.array(known, dtype=float).T
            lines.append(Line(label, x, y, colour, marker="dot"))
        refused = np.array([amplitude for amplitude, value in e[joint].items() if value is None], dtype=float)
        if refused.size:
            top = np.full(refused.size, max(float(np.max(line.y)) for line in lines))
            lines.append(Line("× not obtained: refused", refused, top, PALETTE[5], 0.0, "cross"))
        charts.append(Chart(f"joint {joint}", "A [deg]", "E(A, 50) [N m]", tuple(lines), from_zero=True))
    return svg(charts, columns=3)


def figure_9(postures: dict[str, Run], loaded: dict[str, Run]) -> str:
    """Curves of the postures, their distance from the mean curve, and curves where friction grows with the load."""
    charts = [
        _by_posture("as published", postures, published=True),
        _apart("as published", postures),
        _by_posture("friction + 5 % of the load, aligned", loaded, published=False),
    ]
    return svg(charts, columns=3)


def _by_posture(title: str, runs: dict[str, Run], *, published: bool) -> Chart:
    lines = [
        line(f"posture {name}", curve, PALETTE[k])
        for k, (name, run) in enumerate(runs.items())
        if (curve := run.curve(published=published)) is not None
    ]
    return Chart(title, "velocity [deg/s]", "friction [N m]", tuple(lines), from_zero=True)


def _apart(title: str, runs: dict[str, Run]) -> Chart:
    levels = {name: curve.magnitude(SPEED) for name, run in runs.items() if (curve := run.curve(published=True))}
    middle = np.mean(list(levels.values()), axis=0)
    lines = [
        Line(f"posture {name}", np.degrees(SPEED), 100 * (level / middle - 1), PALETTE[k])
        for k, (name, level) in enumerate(levels.items())
    ]
    return Chart(title, "velocity [deg/s]", "from their mean [%]", tuple(lines))


Row = tuple[str, str, str, str, int, str, str]
"""Figure, curve, joint, posture, A [deg], value, value over the measured range."""


def pair(values: tuple[float, float] | None) -> tuple[str, str]:
    return ("refused", "refused") if values is None else (f"{values[0]:.2f}", f"{values[1]:.2f}")


def load_nm(joint: JointProfile, start_rad: float) -> float:
    """What gravity loads the gear with in the windows, on the average, as the profile itself has it."""
    used = joint.procedure
    assert used is not None
    cos, sin, bias = (figure.value for figure in (joint.gravity_cos_nm, joint.gravity_sin_nm, joint.bias_nm))
    assert cos is not None and sin is not None and bias is not None
    turn = np.linspace(-1.0, 1.0, 101) * math.acos(used.ratio)  # abs(v) >= c times its peak
    position = start_rad + used.amplitude_rad / 2 * (1 + np.sin(turn))
    return float(np.mean(np.abs(cos * np.cos(position) + sin * np.sin(position) + bias)))


def loaded_rows(runs: dict[str, Run], truths: dict[str, FrictionCurve], start_rad: float) -> list[Row]:
    """What friction that grows with the load makes of the five postures; prints how much of it is seen."""
    mean_nm = {name: curve_mean(truth, 0.0, V_RAD_S) for name, truth in truths.items()}
    found = {name: curve for name, run in runs.items() if (curve := run.curve(published=False)) is not None}
    found_nm = {name: curve_mean(curve, 0.0, V_RAD_S) for name, curve in found.items()}
    load = {name: load_nm(run.joint, start_rad) for name, run in runs.items() if run.joint is not None}
    share, _ = np.polyfit(list(load.values()), list(found_nm.values()), 1)
    freed = [
        FrictionCurve.through(SPEED[1:], curve.magnitude(SPEED[1:]) - share * load[name])
        for name, curve in found.items()
    ]
    for what, curves in (("truth", truths.values()), ("found", found.values()), ("without load", freed)):
        mean, most = spread_of(list(curves))
        print(f"postures with load, {what}: {mean:.2f} % on average, {most:.2f} % at most")
    print(f"mean friction rises by {100 * share:.1f} % of gravity")
    rows: list[Row] = []
    for name in found:
        error = pair(errors(runs[name], truths[name], published=False))
        rows += [
            ("five postures with load, error to the truth, percent", "aligned", "1", name, 20, *error),
            ("five postures with load, true mean friction [N m]", "truth", "1", name, 20, f"{mean_nm[name]:.2f}", ""),
            ("five postures with load, mean friction [N m]", "aligned", "1", name, 20, f"{found_nm[name]:.2f}", ""),
            ("five postures with load, gravity found [N m]", "aligned", "1", name, 20, f"{load[name]:.1f}", ""),
        ]
    return rows


def joint_rows(runs: dict[str, dict[int, Run]], robot: Variant) -> list[Row]:
    """Every joint at every travel: how far from its curve at 50 deg, and from the truth."""
    rows: list[Row] = []
    for joint in JOINTS:
        truth = robot.truth(joint, math.radians(20.0))
        for name, published in (("as published", True), ("aligned", False)):
            for amplitude, e_nm in distances(runs[joint], published=published).items():
                said = "refused" if e_nm is None else f"{e_nm:.3f}"
                rows.append(("E(A, 50) [N m]", name, joint, "", amplitude, said, ""))
            for amplitude, run in runs[joint].items():
                error = pair(errors(run, truth, published=published))
                rows.append(("error to the truth, percent", name, joint, "", amplitude, *error))
    return rows


def posture_rows(postures: dict[str, Run], truth: FrictionCurve) -> list[Row]:
    """Joint 1 in five postures; prints how far the curves lie apart."""
    rows: list[Row] = []
    for name, published in (("as published", True), ("aligned", False)):
        mean, most = spread(postures, published=published)
        print(f"postures {name}: {mean:.2f} % on average, {most:.2f} % at most")
        for posture_name, run in postures.items():
            error = pair(errors(run, truth, published=published))
            rows.append(("five postures, error to the truth, percent", name, "1", posture_name, 20, *error))
    return rows


def spread(postures: dict[str, Run], *, published: bool) -> tuple[float, float]:
    """Mean and largest distance of the curves from their mean, percent."""
    return spread_of([curve for run in postures.values() if (curve := run.curve(published=published)) is not None])


def spread_of(curves: list[FrictionCurve]) -> tuple[float, float]:
    """Mean and largest distance of these curves from their mean, percent."""
    speeds = np.linspace(0.0, V_RAD_S, 400)[1:]
    middle = FrictionCurve.through(speeds, np.mean([curve.magnitude(speeds) for curve in curves], axis=0))
    level = curve_mean(middle, 0.0, V_RAD_S)
    far = [100 * curve_distance(curve, middle, V_RAD_S).e_nm / level for curve in curves]
    return float(np.mean(far)), float(np.max(far))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path(tempfile.mkdtemp(prefix="section4-")))
    parser.add_argument("--docs", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    arguments = parser.parse_args()
    robot = variant(arguments.runs, "section4")
    runs: dict[str, dict[int, Run]] = {}
    for joint in JOINTS:
        runs[joint] = {}
        for amplitude in AMPLITUDES:
            run = runs[joint][amplitude] = measured(
                robot, joint, amplitude, arguments.runs / f"joint{joint}-{amplitude}deg"
            )
            f_0 = f"F_0 = {run.joint.coulomb_nm.value:.3f} N m" if run.joint else f"refused: {run.refused}"
            print(f"joint {joint} A = {amplitude} deg: {f_0}", flush=True)
    postures = {
        name: measured(
            variant(arguments.runs, f"section4-{name}", posture(name)), "1", 20, arguments.runs / f"posture-{name}"
        )
        for name in POSTURES
    }
    heavy = {
        name: variant(arguments.runs, f"section4-load-{name}", posture(name, load_share=0.05)) for name in POSTURES
    }
    loaded = {name: measured(heavy[name], "1", 20, arguments.runs / f"posture-load-{name}") for name in POSTURES}
    truths = {name: heavy[name].truth("1", math.radians(20.0)) for name in POSTURES}
    start_rad = robot.values["joints"]["1"]["start_position_rad"]
    rows = [
        *joint_rows(runs, robot),
        *posture_rows(postures, robot.truth("1", math.radians(20.0))),
        *loaded_rows(loaded, truths, start_rad),
    ]
    e = {joint: distances(runs[joint], published=True) for joint in JOINTS}
    e_aligned = {joint: distances(runs[joint], published=False) for joint in JOINTS}
    images = arguments.docs / "images"
    images.mkdir(parents=True, exist_ok=True)
    with (arguments.docs / "evidence" / "data" / "paper-section4.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([HEADS, *rows])
    for name, picture in {
        "fig6": figure_6(runs["1"]),
        "fig7-published": figure_7(runs, published=True),
        "fig7-aligned": figure_7(runs, published=False),
        "fig8": figure_8(e, e_aligned),
        "fig9": figure_9(postures, loaded),
    }.items():
        (images / f"paper-{name}.svg").write_text(picture, encoding="utf-8")


if __name__ == "__main__":
    main()
