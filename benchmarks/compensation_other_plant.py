"""Compensation of a joint that was not simulated by this product's own plant (``other_plant``).

    python benchmarks/compensation_other_plant.py [--joint 3] [--seed 0]

Calibrated and compensated by the product, through driver, bus and simulated drive; nothing is told of the plant but
what a robot file says of a real joint (gear, limits, encoder).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from compensation_robots import variant
from other_plant import OtherPlant

from frictid_drivers.virtual import joint_drive
from frictid_hil.config.profile import load_profile
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.watch import Silent

JOINTS = ("0", "1", "2", "3", "4", "5")


def calibrated(joint: str, folder: Path, bus: str, seed: int) -> tuple[Path, Path]:
    """(Robot file, profile) of one joint of the other plant, identified by the product."""
    joint_drive.ServoLoop = OtherPlant  # type: ignore[attr-defined,assignment]
    robot = variant(folder / "robot.yaml", joints=[joint])
    result = calibrate(CalibrateOptions(str(robot), out=folder / "cal", bus=bus, seed=seed), Silent())
    return robot, Path(result["profile"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--joint", action="append")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bus", default="virtual:other")
    options = parser.parse_args()
    print(f"# LuGre, two masses, Runge-Kutta; setting ours, seed {options.seed}")
    print(
        "| joint | yields | K / presliding | raw | ceiling | inertia removed | V_s change "
        "| mop-reference | ceiling | outcome |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for joint in options.joint or JOINTS:
        with tempfile.TemporaryDirectory() as folder:
            path, profile = calibrated(joint, Path(folder), options.bus, options.seed)
            robot, common = str(path), {"bus": options.bus, "seed": options.seed}
            asked = CompensateOptions(robot, profile, joint, "hand", ("nc", "mop"), out=Path(folder) / "hand", **common)
            hand = compensate(asked, Silent())
            asked = CompensateOptions(
                robot, profile, joint, "track", ("nc", "mop-reference"), out=Path(folder) / "track", **common
            )
            track = compensate(asked, Silent())
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
