"""Processor time of one control cycle of (24) for six joints in plain Python, and memory over many steps.

python benchmarks/compensation_step.py [--steps 10000000]
"""

from __future__ import annotations

import argparse
import math
import time
import tracemalloc

import numpy as np

from frictid_hil.friction.compensation import Compensation, CompensationSettings
from frictid_hil.friction.curve import FrictionCurve

CYCLES = 20_000


def six_joints(*, gradual: bool) -> list[Compensation]:
    speeds = 0.187 * np.arange(1, 11)
    curve = FrictionCurve.through(speeds, 5.0 + 2.0 * np.tanh(speeds))
    even = tuple((0.05 * speeds).tolist())
    settings = CompensationSettings.of(
        curve, "mop", stiffness_nm_per_rad=9e3, ratio=0.95, asymmetry_nm=even, gradual=gradual
    )
    return [Compensation(settings, 0.001) for _ in range(6)]


def cycle_time_s(joints: list[Compensation], velocities: list[float]) -> float:
    a, b, c, d, e, f = (joint.step for joint in joints)
    began = time.process_time()
    for v in velocities:
        a(0.001 * v, v)
        b(0.001 * v, v)
        c(0.001 * v, v)
        d(0.001 * v, v)
        e(0.001 * v, v)
        f(0.001 * v, v)
    return (time.process_time() - began) / len(velocities)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000_000)
    arguments = parser.parse_args()
    velocities = [1.5 * math.sin(0.003 * k) for k in range(CYCLES)]
    for gradual in (False, True):
        joints = six_joints(gradual=gradual)
        rounds = [cycle_time_s(joints, velocities) for _ in range(25)]
        print(
            f"six joints, springs that yield {'gradually' if gradual else 'at once'}: "
            f"best {1e6 * min(rounds):.2f} us, median {1e6 * float(np.median(rounds)):.2f} us per cycle"
        )
    step = joints[0].step
    for v in velocities:
        step(0.001 * v, v)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    left = arguments.steps
    while left > 0:
        for v in velocities:
            step(0.001 * v, v)
        left -= CYCLES
    grown = tracemalloc.get_traced_memory()[0] - before
    print(f"memory grew by {grown} bytes over {arguments.steps} steps")


if __name__ == "__main__":
    main()
