"""Healthy joints whose friction is believed 3 or 10 % off: is any other cause told for it?

    frictid-hil gap check --world wide --cases 60 --seed S --out kept
    python benchmarks/gap_level.py kept [FOLDER ...] [--jobs 2]

The believed friction of every healthy joint of the checks that were kept is scaled, its presliding with it. What is
asked: ``friction_level_error``, an error within its tolerance, or ``none`` where that means nothing; another first
cause with 0.5 or more is counted, how often truth has nothing of it, and how often the level is not told with as much
beside it. A healthy joint has errors within its tolerances, and forms of friction that are not quite the library's.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import yaml

from frictid_hil.blind.judged import LEVEL, LIKELY
from frictid_hil.blind.score import Rate
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import ExperimentSet

OFF = (-0.1, -0.03, 0.03, 0.1)  # of the believed friction, over the right one


@dataclass(frozen=True, slots=True)
class Asked:
    """One healthy joint with its friction believed off."""

    folder: Path
    off: float
    there: frozenset[str]  # causes of which truth has something, be it within a tolerance


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="kept by gap check --out")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    options = parser.parse_args()
    for folder in options.folders:
        if not (folder / "truth").is_dir():
            parser.error(f"{folder}: no truth here; gap check --out keeps it")
    asked = [one for folder in options.folders for one in healthy(folder)]
    with ProcessPoolExecutor(options.jobs) as pool:
        found = list(zip(asked, pool.map(answered, asked), strict=True))
    for one, answer in found:
        if taken(answer):
            told = ", ".join(f"{cause.effect} {cause.confidence:.2f}" for cause in answer.causes)
            print(f"{one.folder} {one.off:+.0%}: {told}")
    print("| off | another first cause | of them, not there | of them, level not told | none | of |")
    print("|---|---|---|---|---|---|")
    for off in (*OFF, None):
        answers = [(one, answer) for one, answer in found if off in (None, one.off)]
        others = [(one, answer) for one, answer in answers if taken(answer)]
        absent = sum(answer.causes[0].effect not in one.there for one, answer in others)
        silent = sum(told_with(answer, LEVEL) < LIKELY for _, answer in others)
        quiet = sum(answer.verdict == "none" for _, answer in answers)
        rate = Rate(len(others), len(answers)).to_json()
        share = f"{rate['right']} ({rate['low']:.0%} to {rate['high']:.0%})" if answers else "0"
        row = "all" if off is None else f"{off:+.0%}"
        print(f"| {row} | {share} | {absent} | {silent} | {quiet} | {len(answers)} |")


def healthy(folder: Path) -> list[Asked]:
    """The joints of a check that have no fault, each believed off in every way."""
    truths = [yaml.safe_load(path.read_text()) for path in sorted((folder / "truth").glob("*.yaml"))]
    return [
        Asked(folder / "cases" / truth["case"], off, frozenset([*truth["present"], *truth["neutral"]]))
        for truth in truths
        if truth["kind"] == "none"
        for off in OFF
    ]


def answered(one: Asked) -> Diagnosis:
    """The answer about a joint whose friction is believed off."""
    joint = ExperimentSet.load(one.folder)
    nominal, factor = joint.nominal, 1.0 + one.off
    assert nominal.curve is not None
    curve = replace(nominal.curve, torque_nm=tuple(factor * torque for torque in nominal.curve.torque_nm))
    stiffness = nominal.presliding_stiffness_nm_per_rad
    stiffness = None if stiffness is None else factor * stiffness
    belief = replace(nominal, curve=curve, presliding_stiffness_nm_per_rad=stiffness)
    return diagnose(replace(joint, nominal=belief))


def taken(answer: Diagnosis) -> bool:
    """Whether another cause is told first."""
    known = answer.verdict in ("explained", "ambiguous")
    return known and answer.causes[0].effect != LEVEL and answer.causes[0].confidence >= LIKELY


def told_with(answer: Diagnosis, effect: str) -> float:
    """Confidence of a cause in an answer, 0 where it is not named."""
    return max((cause.confidence for cause in answer.causes if cause.effect == effect), default=0.0)


if __name__ == "__main__":
    main()
