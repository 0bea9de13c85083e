"""The accuracy of ``calibrate --program``, through bus, driver and scheduler.

    python benchmarks/programmes.py [--programmes quick] [--plants rigid,flexible] [--seeds 0,1,2] [--amplitude 20]

Every cell is the error to the truth over [0, V] / over the curve's own measured range, in percent of the truth's mean
there, for the worst seed. The last column is what ``jobs/programmes.py`` tells its users.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

from on_the_bus import calibrated, distance, plant, profiles, variant

from frictid_hil.jobs.identification.programmes import PROGRAMMES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programmes", default=",".join(PROGRAMMES))
    parser.add_argument("--plants", default="rigid,flexible")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--amplitude", type=float, default=20.0)
    arguments = parser.parse_args()
    amplitude = math.radians(arguments.amplitude)
    with tempfile.TemporaryDirectory() as folder:
        for kind in arguments.plants.split(","):
            robot = variant(Path(folder), f"programmes-{kind}", plant(kind))
            for name in arguments.programmes.split(","):
                programme = PROGRAMMES[name]
                whole: dict[str, list[float]] = {}
                inner: dict[str, list[float]] = {}
                seconds = 0.0
                for seed in map(int, arguments.seeds.split(",")):
                    out = Path(folder) / f"{kind}-{name}-{seed}"
                    result = calibrated(robot, out, program=name, amplitude_rad=amplitude, seed=seed)
                    for joint, profile in profiles(result).items():
                        far = distance(profile, robot.truth(joint, amplitude))
                        whole.setdefault(joint, []).append(far.e_percent)
                        inner.setdefault(joint, []).append(far.e_percent_measured_range)
                    seconds = sum(entry["duration_s"] for entry in result["joints"].values())
                cells = "".join(f"{max(whole[j]):7.2f}/{max(inner[j]):.2f}" for j in inner)
                worst = max(max(values) for values in inner.values())
                print(
                    f"{kind:9}{name:9} {len(programme.shares) or 10:2} speeds {seconds:6.1f} s for six joints {cells}"
                    f"   worst {worst:.2f} %, told {programme.error_percent:g} %",
                    flush=True,
                )


if __name__ == "__main__":
    main()
