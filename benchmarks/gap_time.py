"""How long does a diagnosis take on one core: a full set of drawn joints, and one log alone?

Run: OMP_NUM_THREADS=1 python benchmarks/gap_time.py [--every 1] [--repeats 3] [--json]

The practice joints below ``FRICTID_GAP_PRACTICE`` (``../shared/data`` beside the repository unless given). Whole joints
are those of the narrow world, eight experiments each, and of the wide one. A single log is the experiment
``sines_large`` of a narrow joint, or the first log of a wide joint that was recorded in a user's own way; it is
diagnosed as if there were no other.
Seconds are of the process, so that other work beside it counts little; each joint is answered ``--repeats`` times, one
round after the other, and the spread is that of the rounds' medians. The first answer, which compiles, is not counted.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import ExperimentSet

ASKED_S = {"whole": 5.0, "single": 2.0}  # median seconds a joint that docs/evidence/gap-check.md asks for
SINES, OWN = "sines_large", "excitation"  # an experiment of the procedure, and a log of a user's own


def practice() -> Path:
    """Folder of the practice joints."""
    named = os.environ.get("FRICTID_GAP_PRACTICE")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"


def sines_alone(joint: ExperimentSet) -> ExperimentSet:
    """One experiment of eight."""
    return replace(joint, experiments=tuple(e for e in joint.experiments if e.name == SINES))


def first_alone(joint: ExperimentSet) -> ExperimentSet:
    """The first log that is not kept for validation."""
    return replace(joint, experiments=next((e,) for e in joint.experiments if not e.validation))


KINDS: dict[str, tuple[str, str, Callable[[ExperimentSet], ExperimentSet]]] = {
    "narrow, whole joint": ("gap-practice", "whole", lambda joint: joint),
    "wide, whole joint": ("gap-practice-wide", "whole", lambda joint: joint),
    "narrow, one log": ("gap-practice", "single", sines_alone),
    "wide, one log": ("gap-practice-wide", "single", first_alone),
}


def seconds(joints: Sequence[ExperimentSet]) -> float:
    """Median of the process's seconds a joint."""
    taken = []
    for joint in joints:
        start = time.process_time()
        diagnose(joint)
        taken.append(time.process_time() - start)
    return statistics.median(taken)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=1, help="take one joint in so many")
    parser.add_argument("--repeats", type=int, default=3, help="rounds over all joints")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")
    options = parser.parse_args()
    found: dict[str, dict[str, float]] = {}
    for kind, (folder, size, chosen) in KINDS.items():
        paths = sorted((practice() / folder / "cases").iterdir())[:: options.every]
        whole = [ExperimentSet.load(path) for path in paths]
        if size == "single":
            needed = SINES if chosen is sines_alone else OWN
            whole = [joint for joint in whole if any(e.name == needed for e in joint.experiments)]
        joints = [chosen(joint) for joint in whole]
        if not joints:
            parser.error(f"no joint to diagnose in {practice() / folder}")
        diagnose(joints[0])
        rounds = [seconds(joints) for _ in range(options.repeats)]
        found[kind] = {
            "joints": len(joints), "median_s": statistics.median(rounds), "least_s": min(rounds),
            "most_s": max(rounds), "asked_s": ASKED_S[size],
        }  # fmt: skip
        if not options.json:
            row = found[kind]
            print(
                f"{kind}: {row['median_s']:.2f} s a joint ({row['least_s']:.2f} to {row['most_s']:.2f} in "
                f"{options.repeats} rounds of {len(joints)}), asked {row['asked_s']:g} s",
                flush=True,
            )
    if options.json:
        print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
