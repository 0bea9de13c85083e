"""Scores of several blind checks of the wide world or the zoo together, and the calibration in bins.

    frictid-hil gap check --world wide --cases 120 --seed 1 --out first
    frictid-hil gap check --world wide --cases 120 --seed 2 --out second
    python benchmarks/gap_pooled.py first second

One check has some 200 causes. On so few even chances that are exactly right show a calibration error of 0.04: what that
would be for these very confidences is printed beside.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.blind.judged import BINS, Cause, calibration_error, headline, judged, named_causes

WORLDS = 2000  # of exactly right chances that are drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="kept by gap check --out")
    folders = parser.parse_args().folders
    for folder in folders:
        if not (folder / "answers.json").is_file():
            parser.error(f"{folder}: no answers.json here; gap check writes it with the last answer")
    truths, answers = pooled(folders)
    scores = judged(truths, answers)
    for name, rate in headline(scores).items():
        print(f"{name.replace('_', ' ')}: {rate['right']} of {rate['of']}")
    print("\n".join(calibration(named_causes(truths, answers))))


def pooled(folders: Sequence[Path]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(Truths, answers) of all folders, by folder and case."""
    truths: dict[str, Any] = {}
    answers: dict[str, Any] = {}
    for folder in folders:
        for path in sorted((folder / "truth").glob("*.yaml")):
            truths[f"{folder}/{path.stem}"] = yaml.safe_load(path.read_text())
        for answer in json.loads((folder / "answers.json").read_text()):
            answers[f"{folder}/{answer['case']}"] = answer
    return truths, answers


def calibration(causes: Sequence[Cause]) -> list[str]:
    """Lines: the calibration error, what exactly right chances would show, and one row for each bin."""
    if not causes:
        return ["no cause is named"]
    chance = np.array([cause.confidence for cause in causes])
    random = np.random.default_rng(0)
    drawn = [
        calibration_error([Cause(c, bool(u < c)) for c, u in zip(chance, random.random(chance.size), strict=True)])
        for _ in range(WORLDS)
    ]
    lines = [
        f"calibration error {calibration_error(causes):.3f} over {chance.size} causes; exactly right chances would "
        f"show {np.mean(drawn):.3f} ({np.quantile(drawn, 0.95):.3f} or less in 95 of 100)"
    ]
    bins = np.minimum((chance * BINS).astype(int), BINS - 1)
    for k in sorted(set(bins)):
        there = [cause.there for cause, own in zip(causes, bins, strict=True) if own == k]
        lines.append(f"told {np.mean(chance[bins == k]):.2f}: there {sum(there)} of {len(there)}")
    return lines


if __name__ == "__main__":
    main()
