"""Sixty simulated nights of ``recalibrate``: one joint's friction drifts by 15 %, another is broken on night 40.

    python benchmarks/recalibrate_60_nights.py [NIGHTS] [--seed SEED]

Six joints of the shipped robot with a short procedure (A = 0.2 rad, V = 1.5 rad/s, 3 cycles), other noise every night,
friction (Coulomb, viscous) that wanders by 1 % from night to night on every joint, ambient and gear as the robot file
has them. Printed: the first night on which the drift was flagged against the first on which the truth, (15) between the
simulated joint's own curves of that night and of the first, passed the policy's threshold; false flags on the other
joints; what became of the broken night; and the CPU time of it all. Another seed draws other noise and other wander.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from contextlib import AbstractContextManager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.jobs.compare import true_curve
from frictid_hil.jobs.recalibrate import RecalibrateOptions, recalibrate
from frictid_hil.jobs.watch import Silent
from frictid_hil.profiles.store import ProfileStore

DRIFTING, BROKEN, BROKEN_NIGHT = "2", "4", 40
DRIFT, WANDER, THRESHOLD_PERCENT = 0.15, 0.01, 10.0
VELOCITY_RAD_S = 1.5


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("nights", nargs="?", type=int, default=60)
    asked.add_argument("--seed", type=int, default=1, help="of the noise and of the wander")
    options = asked.parse_args()
    nights, seed = options.nights, options.seed
    random = np.random.default_rng(seed)
    flagged: dict[str, list[int]] = {}
    passed: int | None = None
    broken: dict[str, Any] = {}
    failures: dict[int, str] = {}
    began, cpu = time.monotonic(), time.process_time()
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        first: FrictionCurve | None = None
        for night in range(1, nights + 1):
            factors = {name: 1.0 + WANDER * random.standard_normal() for name in load_robot("hp3j").joint_names}
            factors[DRIFTING] *= 1.0 + DRIFT * (night - 1) / max(1, nights - 1)
            if night == BROKEN_NIGHT:
                factors[BROKEN] *= 2.0
            robot = robot_file(place, factors, seed)
            truth = true_curve(load_robot(robot), DRIFTING, VELOCITY_RAD_S)
            first = first or truth
            truth_percent = curve_distance(truth, first, VELOCITY_RAD_S).e_percent
            if passed is None and truth_percent > THRESHOLD_PERCENT:
                passed = night
            before = active(place)
            run = place / f"run-{night}"
            with dated(night):
                noise = 1000 * (seed - 1) + night
                result = recalibrate(RecalibrateOptions(robot, store=place / "store", seed=noise, out=run), Silent())
            shutil.rmtree(run)
            for name in result["drifted"]:
                flagged.setdefault(name, []).append(night)
            if night == BROKEN_NIGHT:
                broken = {**result, "kept": result["active"] == before}
            elif not result["promoted"]:
                failures[night] = result["reason"]
            distance = result["drift"][DRIFTING]["distance_percent"] or 0.0
            print(
                f"night {night:2d}: truth {truth_percent:5.1f} %, measured "
                f"{distance:5.1f} %, drifted {result['drifted']}, promoted {result['promoted']}",
                file=sys.stderr,
            )
    meant = {DRIFTING: range(nights + 1), BROKEN: [BROKEN_NIGHT]}
    others = {
        name: false for name, seen in flagged.items() if (false := [n for n in seen if n not in meant.get(name, ())])
    }
    wall_s, cpu_s = time.monotonic() - began, time.process_time() - cpu
    seen = flagged.get(DRIFTING, ["never"])[0]
    print(f"{nights} nights, six joints, seed {seed}: {wall_s:.0f} s, {cpu_s:.0f} s of one core")
    print(f"truth passes {THRESHOLD_PERCENT:g} % on night {passed}; flagged first on night {seen}")
    print(f"false flags on the other five joints: {others or 'none'}")
    if broken:
        print(f"broken night: {broken['outcome']}, old profile kept: {broken['kept']}; {broken['reason']}")
    print(f"healthy nights that were not promoted: {failures or 'none'}")


def robot_file(place: Path, factors: dict[str, float], seed: int) -> str:
    values = load_robot("hp3j").values()
    values |= {"name": "nights", "bus": f"virtual:sixty-nights-{seed}"}
    values["procedure"] = {"amplitude_rad": 0.2, "velocity_rad_s": VELOCITY_RAD_S, "cycles": 3, "ratio": 0.8}
    values["policy"] = {"drift_percent": THRESHOLD_PERCENT, "warm_up": {"fixed_s": 0.0}}
    for name, joint in values["joints"].items():
        joint["locked_position_rad"] = joint["start_position_rad"]
        for key in ("coulomb_nm", "viscous_nm_s_per_rad"):
            joint["simulated"]["friction"][key] *= factors[name]
    path = place / "nights.yaml"
    path.write_text(dump(values))
    return str(path)


def active(place: Path) -> str | None:
    store = ProfileStore(place / "store")
    last = store.active("nights")
    return None if last is None else str(store.path("nights", last.id).resolve())


def dated(night: int) -> AbstractContextManager[object]:
    """One night per simulated day, where profiles take their date from."""
    day = datetime(2026, 1, 1, 2, 30, tzinfo=UTC) + timedelta(days=night - 1)
    return patch("frictid_hil.jobs.calibrate.utc_now", lambda: day.strftime("%Y-%m-%dT%H:%M:%SZ"))


if __name__ == "__main__":
    main()
