"""Does a drive that reports its torque late change the result, when it says by how much?

    python benchmarks/declared_skew.py [--joints 0,1,4] [--amplitudes 20,10,5] [--delays-ms 0,1,2,4]

The simulated drives get a low-pass on their reported torque (object 2022h:02), as real ones have; the driver reads it
and declares the delay; `calibrate` runs through bus, driver and scheduler as always. Every cell is the error of
`aligned` over [V_1, V_N] in percent of the truth's mean, and in brackets that of Function A as published on the same
samples. The last line is the largest change against the same joint and travel without the filter.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import numpy as np
from on_the_bus import Variant, calibrated, distance, profiles, shipped, variant

from frictid_hil.config.profile import JointProfile
from frictid_hil.errors import PlanRefused
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import curve_distance


def filtered(folder: Path, delay_ms: float) -> Variant:
    """The shipped robot, its drives with a low-pass on the torque that they report."""
    values = shipped()
    for joint in values["joints"].values():
        joint["simulated"]["drive"]["torque_filter_s"] = delay_ms * 1e-3
    return variant(folder, f"declared-skew-{delay_ms:g}", values)


def errors(joint: JointProfile, truth: FrictionCurve) -> tuple[float, float]:
    """Of the chosen curve and of the published one over the measured range, percent."""
    assert joint.published is not None and joint.procedure is not None
    published = FrictionCurve.through(np.array(joint.published.velocity_rad_s), np.array(joint.published.torque_nm))
    far = curve_distance(published, truth, joint.procedure.velocity_rad_s)
    return distance(joint, truth).e_percent_measured_range, far.e_percent_measured_range


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--joints", default="0,1,4")
    parser.add_argument("--amplitudes", default="20,10,5")
    parser.add_argument("--delays-ms", default="0,1,2,4")
    arguments = parser.parse_args()
    delays = [float(delay) for delay in arguments.delays_ms.split(",")]
    print("| joint | A [deg] | " + " | ".join(f"{delay:g} ms" for delay in delays) + " |")
    print("|---|---|" + "---|" * len(delays))
    worst = 0.0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        robots = {delay: filtered(folder, delay) for delay in delays}
        for name in arguments.joints.split(","):
            for amplitude in map(float, arguments.amplitudes.split(",")):
                radians, cells, ours = math.radians(amplitude), [], []
                for delay, robot in robots.items():
                    out = folder / f"{name}-{amplitude:g}-{delay:g}"
                    try:
                        result = calibrated(robot, out, joints=(name,), amplitude_rad=radians)
                    except PlanRefused:
                        cells.append("refused")
                        continue
                    aligned, published = errors(profiles(result)[name], robot.truth(name, radians))
                    ours.append(aligned)
                    cells.append(f"{aligned:.2f} ({published:.1f})")
                worst = max([worst, *(abs(value - ours[0]) for value in ours)])
                print(f"| {name} | {amplitude:g} | " + " | ".join(cells) + " |", flush=True)
    print(f"\nlargest change against {delays[0]:g} ms: {worst:.2f} points")


if __name__ == "__main__":
    main()
