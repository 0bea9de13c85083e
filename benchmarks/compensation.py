"""What compensation reaches on the virtual HP3J: every figure of docs/compensation.md comes from here.

    python benchmarks/compensation.py calibrate --out runs/benchmark          # the profile that the rest uses
    python benchmarks/compensation.py hand  --profile runs/benchmark/profile.yaml [--setting paper]
    python benchmarks/compensation.py track --profile runs/benchmark/profile.yaml
    python benchmarks/compensation.py cost

All through the product's own command line, on the simulated bus, with the drives' torque steps, encoder counts and two
cycles of delay. No law ever sees a parameter of the simulated joints.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

JOINTS = ("0", "1", "2", "3", "4", "5")


def call(*arguments: str) -> dict:
    """One call of the command line, its JSON."""
    command = [sys.executable, "-m", "frictid_hil.cli.app", *arguments, "--json", "--yes"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not done.stdout.strip():
        raise SystemExit(done.stderr)
    return json.loads(done.stdout)


def calibrate(options: argparse.Namespace) -> None:
    result = call(
        "calibrate", "--robot", options.robot, "--seed", str(options.seed), "--bus", options.bus, "--out", options.out
    )
    print(f"profile {result['profile']} seed {options.seed} outcome {result['outcome']}")


def hand(options: argparse.Namespace) -> None:
    print(f"# hand 0.5 Hz +-20 deg, setting {options.setting}, seed {options.seed}, robot {options.robot}")
    print("| joint | K [N m/rad] | R | raw | ceiling | inertia removed | V_s change | outcome |")
    print("|---|---|---|---|---|---|---|---|")
    for joint in options.joint or JOINTS:
        result = compensation(options, joint, "hand", "nc,mop", "--setting", options.setting)
        nc, mop = (result.get("modes", {}).get(mode, {}) for mode in ("nc", "mop"))
        if not mop:
            print(f"| {joint} | | | | | | | {result['outcome']}: {result['error']['what']} |")
            continue
        change = 100 * (mop["velocity_rms_rad_s"] / nc["velocity_rms_rad_s"] - 1)
        print(
            f"| {joint} | {result['stiffness_nm_per_rad']:.0f} | {result['compensation_ratio']:g} "
            f"| {mop['reduction_percent']:.1f} % | {mop['ceiling_percent']:.1f} % "
            f"| {mop['reduction_inertia_removed_percent']:.1f} % | {change:+.1f} % | {result['outcome']} |",
            flush=True,
        )


def track(options: argparse.Namespace) -> None:
    print(f"# track {options.speed} +-10 deg, setting {options.setting}, seed {options.seed}, robot {options.robot}")
    print("| joint | nc [deg] | mo | mol | mop | mop-reference | ordered | outcome |")
    print("|---|---|---|---|---|---|---|---|")
    for joint in options.joint or JOINTS:
        result = compensation(
            options,
            joint,
            "track",
            "nc,mo,mol,mop,mop-reference",
            "--setting",
            options.setting,
            "--speed",
            options.speed,
        )
        modes = result.get("modes", {})
        if len(modes) < 5:
            print(f"| {joint} | | | | | | | {result['outcome']}: {result['error']['what']} |")
            continue
        error = {mode: modes[mode]["tracking_rms_rad"] for mode in modes}
        ordered = error["nc"] > error["mo"] > error["mol"] and error["mop"] <= 1.02 * error["mol"]
        cells = " | ".join(
            f"{modes[mode]['reduction_percent']:.1f} %" for mode in ("mo", "mol", "mop", "mop-reference")
        )
        print(
            f"| {joint} | {error['nc'] * 57.29578:.3f} | {cells} "
            f"| {'yes' if ordered else 'no'} | {result['outcome']} |",
            flush=True,
        )


def compensation(options: argparse.Namespace, joint: str, task: str, modes: str, *more: str) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        return call(
            *("compensate", "--robot", options.robot, "--profile", options.profile, "--joint", joint),
            *("--task", task, "--mode", modes, "--seed", str(options.seed), "--bus", options.bus),
            *("--out", str(Path(folder) / "run"), *more),
        )


def cost(_options: argparse.Namespace) -> None:
    from frictid_hil.friction.compensation import Compensation, CompensationSettings
    from frictid_hil.friction.curve import FrictionCurve

    speeds = tuple(0.2 * n for n in range(1, 11))
    curve = FrictionCurve(speeds, tuple(5.0 + 2.0 * v**0.7 for v in speeds))
    settings = CompensationSettings.of(curve, "mop", stiffness_nm_per_rad=8000.0, ratio=0.95)
    steps = [Compensation(settings, 0.001).step for _ in JOINTS]
    velocities = [1.9 * (k % 200 - 100) / 100 for k in range(1000)]
    best = float("inf")
    for _ in range(20):
        begun = time.perf_counter()
        for velocity in velocities:
            for step in steps:
                step(1e-3 * velocity, velocity)
        best = min(best, (time.perf_counter() - begun) / len(velocities))
    print(f"six joints of (24): {best * 1e6:.2f} us per cycle (best of 20 x 1000 cycles, call and loop included)")
    step = steps[0]
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(10_000_000 // len(velocities)):
        for velocity in velocities:
            step(1e-3 * velocity, velocity)
    print(f"memory growth over 10^7 steps: {tracemalloc.get_traced_memory()[0] - before} bytes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["calibrate", "hand", "track", "cost"])
    parser.add_argument("--robot", default="hp3j.yaml")
    parser.add_argument("--bus", default="virtual:benchmark")
    parser.add_argument("--profile", default="runs/benchmark/profile.yaml")
    parser.add_argument("--out", default="runs/benchmark")
    parser.add_argument("--joint", action="append")
    parser.add_argument("--setting", default="ours")
    parser.add_argument("--speed", default="30deg/s")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    {"calibrate": calibrate, "hand": hand, "track": track, "cost": cost}[options.what](options)


if __name__ == "__main__":
    main()
