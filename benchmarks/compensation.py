"""What compensation reaches on the virtual HP3J: every figure of docs/compensation.md comes from here.

    python benchmarks/compensation.py calibrate --out runs/benchmark          # the profile that the rest uses
    python benchmarks/compensation.py hand  --profile runs/benchmark/profile.yaml [--setting paper]
    python benchmarks/compensation.py track --profile runs/benchmark/profile.yaml
    python benchmarks/compensation.py stability --profile runs/benchmark/profile.yaml
    python benchmarks/compensation.py wrong --profile runs/benchmark/profile.yaml
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
from dataclasses import replace
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


def wrong(options: argparse.Namespace) -> None:
    """Wrong profiles: refused by what; forced: stopped by what, at which share of the joint's speed limit."""
    import numpy as np

    from frictid_hil.config.profile import Estimate, FrictionProfile, load_profile
    from frictid_hil.config.robot import load_robot
    from frictid_hil.recording.read import read

    whole, robot = load_profile(options.profile), load_robot(options.robot)
    fresh = {"measured_range_rad_s": None, "slopes_nm_s_per_rad": None}

    def doubled(entry):
        stiffness = Estimate(value=2 * entry.presliding_stiffness_nm_per_rad.value)
        return entry.model_copy(
            update={
                **fresh,
                "torque_nm": tuple(2 * f for f in entry.torque_nm),
                "torque_interval_nm": None,
                "coulomb_nm": Estimate(value=2 * entry.coulomb_nm.value),
                "presliding_stiffness_nm_per_rad": stiffness,
            }
        )

    def gravity_flipped(entry):
        names = ("gravity_cos_nm", "gravity_sin_nm")
        return entry.model_copy(update={name: Estimate(value=-getattr(entry, name).value) for name in names})

    print("| joint | profile | without --force | with --force | fastest, share of the joint's limit |")
    print("|---|---|---|---|---|")
    for joint in options.joint or JOINTS:
        entry = whole.joints[joint]
        other = whole.joints["1" if joint != "1" else "0"]
        kinds = {"doubled": doubled(entry), "gravity negated": gravity_flipped(entry), "another joint's": other}
        for name, changed in kinds.items():
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "wrong.yaml"
                FrictionProfile(robot=whole.robot, joints={joint: changed}, provenance=whole.provenance).save(path)
                told = []
                for force in ((), ("--force",)):
                    run = Path(folder) / f"run{len(force)}"
                    result = call(
                        *("compensate", "--robot", options.robot, "--profile", str(path), "--joint", joint),
                        *("--task", "hand", "--mode", "mop", "--bus", options.bus, "--out", str(run), *force),
                    )
                    told.append(result.get("error", {}).get("what", "ran to its end").split(";")[0])
                fastest = 0.0
                if run.exists():
                    samples = next(one for one in read(run) if one.joint == joint)
                    fastest = float(np.abs(samples.velocity_rad_s).max())
                share = fastest / robot.file.joints[joint].max_velocity_rad_s
                print(f"| {joint} | {name} | {told[0]} | {told[1]} | {share:.2f} |", flush=True)


def stability(options: argparse.Namespace) -> None:
    """Largest R and K at which a joint that was pushed comes to rest, free and under the PD of the track task."""
    from frictid_hil.config.profile import load_profile
    from frictid_hil.friction.compensation import OUR_RATIO, OUR_SHARE_OF_PRESLIDING

    profile = load_profile(options.profile)
    print(f"# pushed to 20 deg/s and let go; still: under 0.01 deg/s rms after 4 s; robot {options.robot}")
    print(
        "| joint | delay [cycles] | R + 0.02, K + 10 %: free | PD hold | largest R | largest K/presliding: free | PD |"
    )
    print("|---|---|---|---|---|---|---|")
    for joint in options.joint or JOINTS:
        if joint not in profile.joints:
            continue
        for delay in (2, 5):
            case = _Stability(options.robot, profile.joints[joint], joint, delay)
            bar = [case.rms_deg_s(OUR_RATIO + 0.02, 1.1 * OUR_SHARE_OF_PRESLIDING, hold) for hold in (False, True)]
            ratio = _largest(lambda r, c=case: c.rms_deg_s(r, OUR_SHARE_OF_PRESLIDING, False) < 0.01, 0.9, 1.3)
            stiffness = [
                _largest(lambda k, c=case, h=hold: c.rms_deg_s(OUR_RATIO, k, h) < 0.01, 0.5, 4.0)
                for hold in (False, True)
            ]
            print(
                f"| {joint} | {delay} | {bar[0]:.4f} deg/s | {bar[1]:.4f} deg/s | {ratio:.2f} "
                f"| {stiffness[0]:.2f} | {stiffness[1]:.2f} |",
                flush=True,
            )


def _largest(good, low: float, high: float) -> float:
    """By bisection; ``high`` where nothing goes wrong below it."""
    if good(high):
        return high
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


class _Stability:
    """One simulated joint under the product's own controller, without the bus: delay counted in whole cycles."""

    def __init__(self, robot: str, entry, joint: str, delay: int) -> None:
        from frictid_hil.config.robot import load_robot
        from frictid_hil.simulation.joint import JointModel

        self.setup = load_robot(robot).to_setup().joint(joint)
        self.entry = entry
        self.model = JointModel.from_mapping(
            self.setup.simulated,
            gear_ratio=self.setup.gear_ratio,
            rated_torque_nm=self.setup.rated_torque_nm,
            max_torque_nm=self.setup.max_torque_nm,
        )
        # One cycle of the delay is the simulated joint's own.
        self.waiting = delay - 1

    def rms_deg_s(self, ratio: float, stiffness_share: float, hold: bool) -> float:
        import math

        import numpy as np

        from frictid_hil.driver import Feedback
        from frictid_hil.jobs.compensation_plan import Wanted, law_of
        from frictid_hil.runner.compensation import Controller
        from frictid_hil.simulation.servo_loop import ServoLoop

        wanted = Wanted("track" if hold else "hand", ("mop",))
        law = law_of(self.entry, self.setup, "mop", wanted, [])
        friction = replace(
            law.friction,
            ratio=ratio,
            stiffness_nm_per_rad=stiffness_share * self.entry.presliding_stiffness_nm_per_rad.value,
        )
        centre = self.setup.start_position_rad + math.radians(10)
        loop = ServoLoop(self.model, period_s=0.001, position_rad=centre)
        loop.brake(False)
        loop.power(True)
        loop.set_mode(10)
        controller = Controller(replace(law, friction=friction), 0.001, law.gravity.torque_nm(centre))
        step_nm = self.setup.rated_torque_nm / 1000.0
        queue = [controller.torque_nm] * self.waiting
        push_nm = 2.0 * friction.coulomb_nm
        report, velocities, pushing = Feedback(valid=True), [], True
        for k in range(5000):
            report.position_rad, report.velocity_rad_s = loop.measured_position_rad, loop.velocity_rad_s
            torque = controller.update(report, (centre, 0.0))
            pushing = pushing and k < 1000 and abs(loop.true_velocity_rad_s) < math.radians(20)
            queue.append(torque + (push_nm if pushing else 0.0))
            loop.advance(0.001, torque_nm=round(queue.pop(0) / step_nm) * step_nm)
            velocities.append(loop.true_velocity_rad_s)
            if abs(loop.true_velocity_rad_s) > 20.0:
                return math.inf
        return math.degrees(float(np.sqrt(np.mean(np.square(velocities[4000:])))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["calibrate", "hand", "track", "stability", "wrong", "cost"])
    parser.add_argument("--robot", default="hp3j.yaml")
    parser.add_argument("--bus", default="virtual:benchmark")
    parser.add_argument("--profile", default="runs/benchmark/profile.yaml")
    parser.add_argument("--out", default="runs/benchmark")
    parser.add_argument("--joint", action="append")
    parser.add_argument("--setting", default="ours")
    parser.add_argument("--speed", default="30deg/s")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    verbs = {"calibrate": calibrate, "hand": hand, "track": track, "stability": stability, "wrong": wrong, "cost": cost}
    verbs[options.what](options)


if __name__ == "__main__":
    main()
