"""Whether the 95 % interval of what a repair leaves holds, in joints that the check of the wide world has drawn.

    frictid-hil gap check --world wide --cases 120 --seed S --out kept
    python benchmarks/gap_how_far.py kept [--jobs 2]

Every ``explained`` answer with a figure is looked at twice. *Again*: the validation motions are recorded once more with
other noise; what the same causes leave of them has to lie in the interval, where they are still the answer. *True
numbers*: the joint is drawn without the causes that are named and without the errors that were fitted beside them, and
recorded; its gap to the old belief has to lie in the interval, too. That is asked where the answer names all that shows
and nothing else.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Collection, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from frictid_hil.blind.score import Rate
from frictid_hil.blind.wide import NOTHING, PRESENT, recorded_again
from frictid_hil.blind.worlds import write_rows
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.findings import EVEN

Plain = Mapping[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="kept by gap check --world wide --out")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    if not (folder / "answers.json").is_file():
        parser.error(f"{folder}: no answers.json here; gap check writes it with the last answer")
    seed = int(json.loads((folder / "result.json").read_text())["seed"])
    answers = [a for a in json.loads((folder / "answers.json").read_text()) if _has_interval(a)]
    with ProcessPoolExecutor(arguments.jobs) as pool:
        rows = []
        for row in pool.map(partial(looked_at, folder, seed), answers):
            rows.append(row)
            figures = (f"{name} {row[name]:.4g}" for name in ("low", "after", "high", "again", "true"))
            print(row["case"], *figures, flush=True)
    for name, what in (("again", "another recording"), ("true", "true numbers")):
        asked = [row for row in rows if row[name] == row[name]]
        held = Rate(sum(row["low"] <= row[name] <= row["high"] for row in asked), len(asked))
        print(f"{what}: {held.right} of {held.of}")


def _has_interval(answer: Plain) -> bool:
    found = answer.get("diagnosis") or {"verdict": "error"}
    return found["verdict"] == "explained" and found["gap"]["after_interval_95"]["inverse_nm"] is not None


def looked_at(folder: Path, seed: int, answer: Plain) -> dict[str, Any]:
    """The interval, what another recording shows of the same repair, and what true numbers leave; N m."""
    name, gap = str(answer["case"]), answer["diagnosis"]["gap"]
    low, high = gap["after_interval_95"]["inverse_nm"]
    truth = yaml.safe_load((folder / "truth" / f"{name}.yaml").read_text())
    causes = answer["diagnosis"]["causes"]
    added = {cause["effect"] for cause in causes if cause["confidence"] >= EVEN}
    told = ExperimentSet.load(folder / "cases" / name)
    improved = added | answer["diagnosis"]["fitted_along"].keys()
    asked = [(), improved] if _just(truth, added) else [()]
    drawn = recorded_again(int(name.removeprefix("case_")), seed, truth["kind"], *asked)
    again, *bare = [_set(folder / "cases" / name, rows) for rows in drawn]
    return {
        "case": name,
        "low": low,
        "after": gap["after"]["inverse_nm"],
        "high": high,
        "again": _again_nm(told, again, added),
        "true": _bare_nm(bare[0]) if bare else float("nan"),
    }


def _set(folder: Path, rows: Any) -> ExperimentSet:
    """The belief of a case with other recordings."""
    with tempfile.TemporaryDirectory() as place:
        write_rows(Path(place), yaml.safe_load((folder / "nominal.yaml").read_text()), rows)
        return ExperimentSet.load(Path(place))


def _again_nm(told: ExperimentSet, other: ExperimentSet, added: Collection[str]) -> float:
    """Gap that is left of other validation recordings by causes which the same identification recordings tell.

    NaN where the answer is another one with them.
    """
    other_of = {e.name: e for e in other.experiments}
    mixed = tuple(other_of[e.name] if e.validation else e for e in told.experiments)
    found = diagnose(replace(told, experiments=mixed))
    same = found.verdict == "explained" and {c.effect for c in found.causes if c.confidence >= EVEN} == added
    return found.after.inverse_nm if same and found.after.inverse_nm is not None else float("nan")


def _bare_nm(experiments: ExperimentSet) -> float:
    """Gap of the validation recordings to the belief."""
    before = diagnose(experiments, library=()).before.inverse_nm
    assert before is not None
    return before


def _just(truth: Plain, added: Collection[str]) -> bool:
    """Whether those causes are all that shows, and all of them are there."""
    sizes = {one["name"]: float(one["size_alone"]) for one in truth["contributors"]}
    shows = {name for name, size in sizes.items() if size >= PRESENT}
    return shows <= set(added) and all(sizes.get(name, 0.0) >= NOTHING for name in added)


if __name__ == "__main__":
    main()
