"""Three units of every drive family, drawn with different friction and noise: is F_0 found, and do intervals cover it?

    python benchmarks/drive_families.py                   all families (10 min)
    python benchmarks/drive_families.py elmo robstride    these

CiA-402 families are personalities of the simulated servo, the others simulated devices at their own wire. Promised are
F_0 within 5 % of the simulated joint's, and intervals of which nine in ten or more hold the truth.
"""

from __future__ import annotations

import os
import random
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_drivers.virtual.personality import known_personalities
from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.config.search import find
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.watch import Silent
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.steady import true_curve_nm

UNITS = (1, 2, 3)
LIMIT_PERCENT = 5.0
SHORT = {"amplitude_rad": 0.2, "velocity_rad_s": 0.6, "cycles": 4, "ratio": 0.8}
CIA402: dict[str, dict[str, Any]] = {name: {} for name in known_personalities()} | {
    # What the drive cannot tell, a person must.
    "epos4": {"joint": {"position_units_per_revolution": 131_072 * 100}},
    "nanotec": {"joint": {"raise_torque_limit": True}},
    "prbt": {"robot": {"cycle_hz": 125, "procedure": {**SHORT, "amplitude_rad": 0.35}}},
}
MIT: dict[str, dict[str, Any]] = {
    "damiao": {"model": "DM-J4310"},
    "robstride": {"model": "RS00"},
    "robstride-mit": {"model": "RS00", "protocol": "robstride-mit"},
    "cybergear": {"model": "CyberGear"},
    "cubemars": {"model": "AK80-9"},
}
SERVOS = {"feetech": "STS3215", "feetech-scs": "SCS15", "dynamixel": "XL330-M288", "dynamixel-load": "XL430-W250"}
FAMILIES = (*sorted(CIA402), *MIT, *SERVOS)


def _cia402(family: str) -> dict[str, Any]:
    needs = CIA402[family]
    joint = {
        "node": 3, "gear_ratio": 100, "max_velocity_rad_s": 3.0, "max_torque_nm": 60.0, "rated_torque_nm": 40.0,
        "position_min_rad": -2.0, "position_max_rad": 2.0, "start_position_rad": -0.2, "locked_position_rad": 0.0,
        "options": {"personality": family, **needs.get("joint", {})},
        "simulated": {"inertia_kg_m2": 0.3, "friction": {"coulomb_nm": 5.0, "viscous_nm_s_per_rad": 1.5}, "drive": {}},
    }  # fmt: skip
    return {
        "schema": "frictid.robot/1", "name": family, "driver": "virtual", "cycle_hz": 500, "procedure": SHORT,
        "joints": {"0": joint}, **needs.get("robot", {}),
    }  # fmt: skip


def _mit(family: str) -> dict[str, Any]:
    values: dict[str, Any] = yaml.safe_load(find("mit-bench.yaml").read_text(encoding="utf-8"))
    values["joints"]["0"]["options"] |= MIT[family]
    return values


def _servo(family: str) -> dict[str, Any]:
    values: dict[str, Any] = yaml.safe_load(find("so101.yaml").read_text(encoding="utf-8"))
    joint = values["joints"]["shoulder_pan"]
    joint["options"] = {"model": SERVOS[family]}
    if family == "feetech-scs":
        joint |= {"position_min_rad": -1.5, "position_max_rad": 1.5}
    return {**values, "joints": {"0": joint}}


def robot_file(folder: Path, family: str, unit: int) -> Path:
    """One joint of this family; its friction and its torque noise are drawn for this unit."""
    drawn = random.Random(f"{family} {unit}")
    values = _cia402(family) if family in CIA402 else _mit(family) if family in MIT else _servo(family)
    simulated = values["joints"]["0"]["simulated"]
    simulated["friction"] = {name: value * drawn.uniform(0.8, 1.25) for name, value in simulated["friction"].items()}
    usual = simulated["drive"].get("torque_noise_per_mille", 2.0)
    simulated["drive"]["torque_noise_per_mille"] = usual * drawn.uniform(0.5, 2.0)
    values["bus"] = f"virtual:{family}{unit}-{os.getpid()}"
    path = folder / f"{family} {unit}.yaml"
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return path


@dataclass(frozen=True, slots=True)
class Found:
    """One unit.

    Attributes:
        outcome: of the run.
        off_percent: F_0 from the truth.
        half_percent: half the width of its interval.
        covered: the interval of F_0 holds the truth.
        curve_covered: share of the curve's intervals that do.
    """

    outcome: str
    off_percent: float
    half_percent: float
    covered: bool
    curve_covered: float

    @property
    def good(self) -> bool:
        """As promised of one unit."""
        return self.outcome == "ok" and abs(self.off_percent) <= LIMIT_PERCENT


def found(folder: Path, family: str, unit: int) -> Found:
    """Calibrate one unit and compare."""
    path, out = robot_file(folder, family, unit), folder / f"{family} {unit} run"
    result = calibrate(CalibrateOptions(str(path), out=out, seed=unit), Silent()).to_json()
    if result["outcome"] != "ok":
        return Found(f"{result['outcome']}: {result.get('error')}", float("nan"), float("nan"), False, 0.0)
    entry = load_profile(out / "profile.yaml").joint("0")
    model = JointModel.of(load_robot(path).to_setup().joint("0"), "0")
    truth, value_nm = model.friction.coulomb_nm, entry.coulomb_nm.value
    low_nm, high_nm = entry.coulomb_nm.low, entry.coulomb_nm.high
    assert value_nm is not None and low_nm is not None and high_nm is not None, "a calibration has all three"
    curve = true_curve_nm(model, np.array(entry.velocity_rad_s))
    low, high = np.array(entry.torque_interval_nm).T
    return Found(
        outcome="ok",
        off_percent=100.0 * (value_nm / truth - 1.0),
        half_percent=50.0 * (high_nm - low_nm) / truth,
        covered=low_nm <= truth <= high_nm,
        curve_covered=float(np.mean((low <= curve) & (curve <= high))),
    )


def rows(families: Sequence[str]) -> Iterator[tuple[str, list[Found]]]:
    """Family by family."""
    for family in families:
        with tempfile.TemporaryDirectory() as folder:
            yield family, [found(Path(folder), family, unit) for unit in UNITS]


def main(families: Sequence[str]) -> int:
    """Print a line per family; 1 where one fails."""
    os.environ.setdefault("XDG_STATE_HOME", tempfile.mkdtemp())
    good, holds, intervals, curve = True, 0, 0, []
    print(f"{'family':15} {'F_0 off, %':>24} {'interval +-, %':>21} {'covered':>8} {'curve covered':>14}")
    for family, units in rows(families or FAMILIES):
        good &= all(unit.good for unit in units)
        holds += sum(unit.covered for unit in units)
        intervals += len(units)
        curve += [unit.curve_covered for unit in units]
        off = " ".join(f"{unit.off_percent:7.2f}" for unit in units)
        half = " ".join(f"{unit.half_percent:6.2f}" for unit in units)
        share = f"{sum(unit.covered for unit in units)} of {len(units)}"
        print(f"{family:15} {off:>24} {half:>21} {share:>8} {np.mean([u.curve_covered for u in units]):14.0%}", end=" ")
        print("; ".join(unit.outcome for unit in units if unit.outcome != "ok"), flush=True)
    print(f"intervals of F_0 that hold the truth: {holds} of {intervals}; of the curve: {np.mean(curve):.1%}")
    return int(not good or holds < 0.9 * intervals)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
