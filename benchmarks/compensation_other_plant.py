"""Compensation of a joint that was not simulated by this product's own plant (``other_plant``).

    python benchmarks/compensation_other_plant.py [--joint 3] [--seed 0] [--kept runs/other]

Calibrated and compensated by the product, through driver, bus and simulated drive; nothing is told of the plant but
what a robot file says of a real joint (gear, limits, encoder).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from unittest.mock import patch

from compensation_robots import JOINTS, variant
from other_plant import OtherPlant

from frictid_drivers.virtual import joint_drive
from frictid_hil.config.profile import load_profile
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.watch import Silent


@patch.object(joint_drive, "ServoLoop", OtherPlant)  # another plant behind the drive
def calibrated(joint: str, kept: Path, bus: str, seed: int) -> tuple[Path, Path]:
    """(Robot file, profile) of one joint of the other plant, identified by the product unless ``kept`` has them."""
    folder = kept / f"{joint}-seed-{seed}"
    robot, profile = folder / "robot.yaml", folder / "calibration" / "profile.yaml"
    if not profile.exists():
        folder.mkdir(parents=True)
        variant(robot, joints=[joint])
        calibrate(CalibrateOptions(str(robot), out=profile.parent, bus=bus, seed=seed), Silent())
    return robot, profile


@patch.object(joint_drive, "ServoLoop", OtherPlant)  # another plant behind the drive
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--joint", action="append")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bus", default="virtual:other")
    parser.add_argument("--kept", type=Path, help="folder of calibrations, used again where it has them")
    options = parser.parse_args()
    print(f"# LuGre, two masses, Runge-Kutta; setting ours, seed {options.seed}")
    print(
        "| joint | yields | K / presliding | raw | ceiling | inertia removed | V_s change "
        "| mop-reference | ceiling | outcome |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for joint in options.joint or JOINTS:
        with tempfile.TemporaryDirectory() as folder:
            path, profile = calibrated(joint, options.kept or Path(folder), options.bus, options.seed)
            robot, common = str(path), {"bus": options.bus, "seed": options.seed}
            hand, track = (
                compensate(
                    CompensateOptions(robot, profile, joint, wanted, out=Path(folder) / wanted.task, **common), Silent()
                ).to_json()
                for wanted in (Wanted("hand", ("nc", "mop")), Wanted("track", ("nc", "mop-reference")))
            )
            entry = load_profile(profile).joints[joint]
            presliding = entry.presliding_stiffness_nm_per_rad.value or float("nan")
        nc, mop = hand["modes"].get("nc"), hand["modes"].get("mop")
        if not (nc and mop):
            print(f"| {joint} | {entry.presliding_yields} | | | | | | | | {hand.get('error')} |", flush=True)
            continue
        reference = track["modes"].get("mop-reference", {})
        print(
            f"| {joint} | {entry.presliding_yields} | {hand['stiffness_nm_per_rad'] / presliding:.2f} "
            f"| {mop['reduction_percent']:.1f} % "
            f"| {mop['ceiling_percent']:.1f} % | {mop['reduction_inertia_removed_percent']:.1f} % "
            f"| {100 * (mop['velocity_rms_rad_s'] / nc['velocity_rms_rad_s'] - 1):+.1f} % "
            f"| {reference.get('reduction_percent', float('nan')):.1f} % "
            f"| {reference.get('ceiling_percent', float('nan')):.1f} % | {hand['outcome']}, {track['outcome']} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
