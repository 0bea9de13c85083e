"""Fits the map from clues to confidence on joints of its own seeds, and checks it across joints that did not fit it.

Run: python benchmarks/gap_confidence.py [--cases 200] [--seed 31003] [--jobs 2] [--part 1/1] [--out FOLDER]
     [--fit-only] [--write]

Every joint is drawn as the blind check draws it and diagnosed; a visible joint with one effect again with that effect
taken out of the library, where every named cause is wrong. Clues of all named causes are kept in the folder, so an
interrupted run goes on. Weights have one sign each (a map that cannot turn round on a chance correlation) and are
shrunk towards zero; the table judges every joint by weights that it did not fit. ``--write`` puts them into
frictid_hil/gap/confidence_fit.py, from where the product takes them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.blind.generator import Assignment, assignments, draw_case, write_case
from frictid_hil.gap.confidence import SIGNS
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.simulation.effects import all_effects

FIT = Path(__file__).parents[1] / "frictid_hil" / "gap" / "confidence_fit.py"
SHRINK = 0.05
"""Prior on the weights: inverse variance of each, the constant excepted."""
FOLDS = 10
BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=31003)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--part", default="1/1", help="k/n: only every n-th joint, so that several commands share them")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--fit-only", action="store_true", help="fit what the folder holds")
    parser.add_argument("--write", action="store_true", help="replace the weights of the product")
    arguments = parser.parse_args()
    out: Path = arguments.out or Path(tempfile.gettempdir()) / f"frictid-gap-confidence-{arguments.seed}"
    out.mkdir(parents=True, exist_ok=True)
    kept = out / "clues.jsonl"
    kept.touch()
    if not arguments.fit_only:
        collect(arguments.cases, arguments.seed, arguments.part, arguments.jobs, kept)
    rows = [row for line in kept.read_text().splitlines() for row in json.loads(line)["causes"]]
    weights = fitted(rows)
    table = calibration(rows)
    for name, weight in weights.items():
        print(f"{name}: {weight:.3f}")
    print("\n".join(table))
    if arguments.write:
        joints = [json.loads(line) for line in kept.read_text().splitlines()]
        FIT.write_text(page(weights, table, joints))
        print(f"written: {FIT}")


def collect(cases: int, seed: int, part: str, jobs: int, kept: Path) -> None:
    """Clues of every named cause, one line a joint."""
    share, of = (int(number) for number in part.split("/"))
    known = {(d["seed"], d["case"]) for d in map(json.loads, kept.read_text().splitlines())}
    tasks = [
        (k, seed, one)
        for k, one in enumerate(assignments(cases, seed))
        if (seed, k) not in known and k % of == share - 1
    ]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for done, line in enumerate(pool.map(clues_of_joint, tasks), start=1):
            with kept.open("a") as file:
                file.write(json.dumps(line) + "\n")
            if done % 10 == 0 or done == len(tasks):
                print(f"{done} of {len(tasks)}", flush=True)


def clues_of_joint(task: tuple[int, int, Assignment]) -> dict[str, Any]:
    """Clues of all causes named for one joint, with and without its own effect in the library."""
    index, seed, assignment = task
    case = draw_case(index, seed, assignment)
    truth = case.truth
    names = [e["name"] for e in truth["effects"] if e["in_library"]]
    with tempfile.TemporaryDirectory() as folder:
        write_case(case, Path(folder) / case.name)
        experiments = ExperimentSet.load(Path(folder) / case.name)
    runs: list[tuple[str | None, list[str]]] = [(None, names)]
    if truth["visible"] and truth["kind"] == "single":
        runs.append((names[0], []))
    causes, verdicts = [], []
    for left_out, right in runs:
        library = [n for n in all_effects() if n != left_out]
        answer = diagnose(experiments, library=library, least_chance=0.0)
        verdicts.append(answer.verdict)
        for rank, cause in enumerate(answer.causes):
            if answer.verdict in ("explained", "ambiguous") and cause.clues is not None:
                causes.append(
                    {
                        "joint": f"{seed}-{index}",
                        "left_out": left_out,
                        "rank": rank,
                        "effect": cause.effect,
                        "right": cause.effect in right,
                        "terms": cause.clues.terms(),
                    }
                )
    about = {"kind": truth["kind"], "truth": names, "visible": truth["visible"], "verdicts": verdicts}
    return {"seed": seed, "case": index, "commit": commit(), **about, "causes": causes}


def commit() -> str:
    """The commit that diagnoses, shortened; empty outside a checkout."""
    asked = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, cwd=FIT.parent).stdout.strip()


def fitted(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Weights by penalised likelihood under their signs."""
    names = list(SIGNS)
    table = np.array([[row["terms"][name] for name in names] for row in rows])
    right = np.array([row["right"] for row in rows], dtype=float)

    def cost(weights: Array) -> tuple[float, Array]:
        logit = table @ weights
        value = float(np.sum(np.logaddexp(0.0, logit) - right * logit))
        slope = table.T @ (1.0 / (1.0 + np.exp(-logit)) - right)
        shrunk = weights.copy()
        shrunk[0] = 0.0
        return value + 0.5 * SHRINK * float(shrunk @ shrunk), slope + SHRINK * shrunk

    limits = {0: (None, None), 1: (0.0, None), -1: (None, 0.0)}
    found = optimize.minimize(
        cost, np.zeros(len(names)), jac=True, method="L-BFGS-B", bounds=[limits[SIGNS[n]] for n in names]
    )
    return {name: round(float(weight), 3) for name, weight in zip(names, found.x, strict=True)}


def chances(rows: Sequence[Mapping[str, Any]], weights: Mapping[str, float]) -> Array:
    """Chance of every row, shape (n,)."""
    logit = np.array([sum(weights[n] * row["terms"][n] for n in weights) for row in rows])
    chance: Array = np.clip(1.0 / (1.0 + np.exp(-logit)), 0.05, 0.99)
    return chance


def calibration(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Claimed against true shares, every joint judged by weights that it did not fit."""
    joints = sorted({row["joint"] for row in rows})
    fold = {joint: int(k) for joint, k in zip(joints, np.random.default_rng(0).permutation(len(joints)), strict=True)}
    judged: list[tuple[float, Mapping[str, Any]]] = []
    for k in range(FOLDS):
        inside = [row for row in rows if fold[row["joint"]] % FOLDS == k]
        if inside:
            weights = fitted([row for row in rows if fold[row["joint"]] % FOLDS != k])
            judged += list(zip(chances(inside, weights), inside, strict=True))
    lines = ["| confidence | whole library: right | own effect taken away: right |", "|---|---|---|"]
    for low, high in itertools.pairwise(BINS):
        cells = []
        for left_out in (False, True):
            here = [r["right"] for c, r in judged if low <= c < high and (r["left_out"] is not None) == left_out]
            cells.append(f"{sum(here)} of {len(here)}")
        lines.append(f"| {low:.2f} to {high:.2f} | {cells[0]} | {cells[1]} |")
    return lines


def page(weights: Mapping[str, float], table: Sequence[str], joints: Sequence[Mapping[str, Any]]) -> str:
    """The product's file of weights."""
    numbers = "\n".join(f'    "{name}": {weight},' for name, weight in weights.items())
    seeds = ", ".join(str(seed) for seed in sorted({joint["seed"] for joint in joints}))
    commits = ", ".join(sorted({joint["commit"] for joint in joints}))
    return (
        '"""Weights of the confidence\'s logistic map; written by ``benchmarks/gap_confidence.py --write``.\n\n'
        f"{len(joints)} joints of seeds {seeds}, diagnosed at commits {commits}.\n"
        "Causes named in joints that did not fit the weights they are judged by (ten folds):\n\n"
        + "\n".join(table)
        + '\n"""\n\n'
        f"from __future__ import annotations\n\nWEIGHTS: dict[str, float] = {{\n{numbers}\n}}\n"
    )


if __name__ == "__main__":
    main()
