"""Wrong profiles, joint by joint: refused by what; forced: stopped by what, and how fast the joint got meanwhile.

    python benchmarks/compensation.py calibrate --out runs/benchmark
    python benchmarks/compensation_wrong.py --profile runs/benchmark/profile.yaml [--joint 1] [--task track]

All through the product's own command line, on the simulated bus. ``fastest`` is the largest speed the drive reported in
the whole forced run, moves at 20 deg/s included, as a share of the joint's speed limit. Ends with 1 where a profile was
accepted without --force, or a joint came within a tenth of its limit.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from command_line import call
from compensation_robots import JOINTS

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile, load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.recording.read import read

LONG_AGO = "2020-01-01T00:00:00Z"
_FRICTION = ("coulomb_nm", "presliding_stiffness_nm_per_rad", "presliding_level_nm")
_GRAVITY = ("gravity_cos_nm", "gravity_sin_nm", "bias_nm")


def scaled(entry: JointProfile, factor: float) -> JointProfile:
    """The same joint with all of its friction multiplied."""
    figures: dict[str, Any] = {}
    for name in _FRICTION:
        figure = getattr(entry, name)
        sign = 1.0 if name == "coulomb_nm" else np.sign(factor)
        figures[name] = Estimate(value=sign * factor * figure.value)
    quality = {**entry.quality, "asymmetry_nm": [factor * a for a in entry.quality["asymmetry_nm"]]}
    return entry.model_copy(
        update={
            **figures,
            "torque_nm": tuple(factor * f for f in entry.torque_nm),
            "torque_interval_nm": None,
            "measured_range_rad_s": None,
            "slopes_nm_s_per_rad": None,
            "quality": quality,
        }
    )


def gravity_negated(entry: JointProfile) -> JointProfile:
    """The same joint upside down; one that carries next to nothing is given a constant torque twice its friction."""
    values = {name: -(getattr(entry, name).value or 0.0) for name in _GRAVITY}
    if np.hypot(values["gravity_cos_nm"], values["gravity_sin_nm"]) < entry.curve().coulomb_nm:
        values["bias_nm"] -= 2.0 * entry.curve().coulomb_nm
    return entry.model_copy(update={name: Estimate(value=value) for name, value in values.items()})


def kinds(whole: FrictionProfile, joint: str) -> dict[str, tuple[JointProfile, str]]:
    """By name: the entry, and when it says it was identified."""
    entry, today = whole.joints[joint], whole.provenance.created_utc
    names = list(whole.joints)
    after = names[(names.index(joint) + 1) % len(names)]
    before = names[names.index(joint) - 1]
    return {
        f"joint {after}'s": (whole.joints[after], today),
        f"joint {before}'s": (whole.joints[before], today),
        "friction doubled": (scaled(entry, 2.0), today),
        "friction negated": (scaled(entry, -1.0), today),
        "gravity negated": (gravity_negated(entry), today),
        "stale, friction 1.4 times today's": (scaled(entry, 1.4), LONG_AGO),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="hp3j.yaml")
    parser.add_argument("--bus", default="virtual:wrong")
    parser.add_argument("--profile", default="runs/benchmark/profile.yaml")
    parser.add_argument("--joint", action="append")
    parser.add_argument("--task", default="hand")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    whole, robot = load_profile(options.profile), load_robot(options.robot)
    print(f"# task {options.task}, mode mop, seed {options.seed}, robot {options.robot}")
    print("| joint | profile | without --force | with --force | outcome | fastest, of the joint's limit |")
    print("|---|---|---|---|---|---|")
    bad = 0
    for joint in options.joint or JOINTS:
        for name, (entry, date) in kinds(whole, joint).items():
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "wrong.yaml"
                provenance = whole.provenance.model_copy(update={"created_utc": date})
                FrictionProfile(robot=whole.robot, joints={joint: entry}, provenance=provenance).save(path)
                results = []
                for force in ((), ("--force",)):
                    run = Path(folder) / f"run{len(force)}"
                    results.append(
                        call(
                            *("compensate", "--robot", options.robot, "--profile", str(path), "--joint", joint),
                            *("--task", options.task, "--mode", "mop", "--seed", str(options.seed)),
                            *("--bus", options.bus, "--out", str(run), *force),
                        )
                    )
                fastest = 0.0
                if run.exists():
                    samples = next(one for one in read(run) if one.joint == joint)
                    assert samples.velocity_rad_s is not None
                    fastest = float(np.abs(samples.velocity_rad_s).max())
            share = fastest / robot.file.joints[joint].max_velocity_rad_s
            refused, forced = (result.get("error", {}).get("what", "ran to its end") for result in results)
            bad += results[0]["outcome"] != "refused" or share > 0.9
            print(
                f"| {joint} | {name} | {refused.split(';')[0]} | {forced.split(';')[0]} | {results[1]['outcome']} "
                f"| {share:.2f} |",
                flush=True,
            )
    print(f"{bad} of {6 * len(options.joint or JOINTS)} neither refused nor stopped in time")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
