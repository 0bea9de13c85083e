"""The practice joints, their torque smoothed by a script before it is handed on: does the diagnosis keep its word?

Run: python benchmarks/gap_smoothed.py [--hertz 8] [--order 4] [--every 1]

The torque of every log passes a Butterworth low-pass forwards and backwards. Counted are joints whose first answer is
right (one of their causes, ``none`` of a healthy joint, ``unknown`` of an effect that has no name), as recorded and
smoothed, with the controller that the set states and with none; of those smoothed also what is wrong with 0.9 or more.
Joints without a torque, or with a gap that does not show, do not count.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy import signal

sys.path.insert(0, str(Path(__file__).resolve().parent))

from gap_sensitivity import right
from gap_time import practice

from frictid_hil.errors import FrictidError
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet

SURE = 0.9
WORLDS = {"narrow": "gap-practice", "wide": "gap-practice-wide"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hertz", type=float, default=8.0, help="edge of the low-pass")
    parser.add_argument("--order", type=int, default=4, help="its order, of each of the two passes")
    parser.add_argument("--every", type=int, default=1, help="take one joint in so many")
    options = parser.parse_args()

    def smoothed(joint: ExperimentSet) -> ExperimentSet:
        return replace(joint, experiments=tuple(passed(e, options.hertz, options.order) for e in joint.experiments))

    ways: dict[str, Callable[[ExperimentSet], ExperimentSet]] = {
        "as recorded": lambda joint: joint,
        "smoothed": smoothed,
        "as recorded, no controller": unknown_controller,
        "smoothed, no controller": lambda joint: smoothed(unknown_controller(joint)),
    }
    for world, folder in WORLDS.items():
        paths = sorted((practice() / folder / "cases").iterdir())[:: options.every]
        told = [(path, yaml.safe_load((path.parents[1] / "truth" / f"{path.name}.yaml").read_text())) for path in paths]
        joints = [
            (ExperimentSet.load(path), truth) for path, truth in told if truth["kind"] == "none" or truth["visible"]
        ]
        joints = [(joint, truth) for joint, truth in joints if all(e.torque_nm is not None for e in joint.experiments)]
        for way, changed in ways.items():
            answers = [answered(changed(joint), truth) for joint, truth in joints]
            good, sure = sum(a == "right" for a in answers), sum(a == "sure and wrong" for a in answers)
            print(f"{world}, {way}: {good} of {len(answers)} right, {sure} sure and wrong", flush=True)


def passed(e: Experiment, hertz: float, order: int) -> Experiment:
    """A log whose torque was low-passed without lag."""
    assert e.torque_nm is not None
    rate_hz = 1.0 / float(np.median(np.diff(e.time_s)))
    sections = signal.butter(order, hertz, fs=rate_hz, output="sos")
    return replace(e, torque_nm=signal.sosfiltfilt(sections, e.torque_nm))


def unknown_controller(joint: ExperimentSet) -> ExperimentSet:
    """The same joint of a user who does not know its controller."""
    return replace(joint, nominal=replace(joint.nominal, controller=None))


def answered(joint: ExperimentSet, truth: dict[str, Any]) -> str:
    """``right``, ``sure and wrong`` or ``wrong``."""
    try:
        told = diagnose(joint)
    except FrictidError:
        return "wrong"
    named = told.causes if told.verdict in ("explained", "ambiguous") else ()
    if (named[0].effect if named else told.verdict) in right(truth):
        return "right"
    return "sure and wrong" if named and named[0].confidence >= SURE else "wrong"


if __name__ == "__main__":
    main()
