"""How many six-joint recordings a second one core takes through Function A.

    python benchmarks/function_a.py [--recordings 100] [--passes 100]

Distinct recordings of 16 s at 1 kHz are held in memory (velocity and torque of six joints on one time axis) and go
through again and again. Processor time of every pass: the best is the machine's, the median that of a busy one.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

from frictid_hil.friction import trajectory
from frictid_hil.friction.identify import function_a
from frictid_hil.friction.trajectory import Procedure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=100)
    parser.add_argument("--passes", type=int, default=100)
    arguments = parser.parse_args()
    procedure = Procedure(math.radians(20.0), math.radians(115.0))
    rng = np.random.default_rng(1)
    time_s = trajectory.sample_times(procedure, 0.001)
    v = trajectory.velocity(procedure, time_s)
    torque = 10 * np.sign(v) + 3 * v
    recordings = []
    for _ in range(arguments.recordings):
        noise = rng.normal(size=(2, 6, time_s.size))
        recordings.append((v + 0.002 * noise[0], torque + 0.3 * noise[1]))
    rates = []
    for _ in range(arguments.passes):
        began = time.process_time()
        for velocities, torques in recordings:
            for joint in range(6):
                function_a(time_s, velocities[joint], torques[joint], procedure)
        rates.append(arguments.recordings / (time.process_time() - began))
    print(
        f"{arguments.recordings} recordings x {arguments.passes} passes, {time_s.size} samples x 6 joints: "
        f"best {max(rates):.0f}, median {np.median(rates):.0f} six-joint recordings per second and core "
        f"({1e6 / max(rates) / 6:.0f} us per joint)"
    )


if __name__ == "__main__":
    main()
