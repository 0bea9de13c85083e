"""What half and double of each constant of the diagnosis changes, on drawn joints.

    python benchmarks/gap_sensitivity.py [--world wide] [--cases 40] [--seed 1] [--jobs 2] [--write-docs]

Every joint is diagnosed as it is, then once for each constant at half and at double its value. Constants of the verdict
and of the confidences are varied on the same posterior; those of the posterior itself need a new one each. Counted are
joints whose verdict changes, joints whose first cause changes, and those answered rightly.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

from frictid_hil.blind.check import draw_sealed
from frictid_hil.config.provenance import git_revision
from frictid_hil.gap import diagnose as diagnosis
from frictid_hil.gap import findings, how_far, noise, plant_channel, posterior, verdict
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.verdict import Verdict

DOCS_PAGE = Path(__file__).parents[1] / "docs" / "evidence" / "gap-sensitivity.md"
BEGIN, END = "<!-- written by benchmarks/gap_sensitivity.py -->", "<!-- end of what it wrote -->"
FACTORS = (0.5, 2.0)
OF_VERDICT: tuple[tuple[ModuleType, str], ...] = (
    (findings, "VISIBLE"), (findings, "FORM"), (findings, "ALIKE"), (verdict, "FLOORS"), (verdict, "STANDS_OUT"),
    (verdict, "UNNAMED"), (verdict, "DOUBTED"), (verdict, "HALF"), (verdict, "LISTED"), (verdict, "NEEDED"),
    (verdict, "LEADS"),
)  # fmt: skip
OF_POSTERIOR: tuple[tuple[ModuleType, str], ...] = (
    (posterior, "EXPECTED"), (posterior, "WORTH"), (noise, "LOCAL_S"), (posterior, "FORM"),
    (posterior, "MOST_DOUBT"), (posterior, "MOST"), (posterior, "TRIED"), (plant_channel, "BEYOND"),
    (how_far, "COLOUR"), (diagnosis, "NEGLIGIBLE"), (diagnosis, "LOUD"),
)  # fmt: skip

Answer = tuple[str, str]
"""Verdict and first cause; the verdict again where none is named."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=("narrow", "wide"), default="wide")
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--write-docs", action="store_true")
    arguments = parser.parse_args()
    rows, joints = measured(arguments.world, arguments.cases, arguments.seed, arguments.jobs)
    told = table(rows, joints)
    print(told)
    if arguments.write_docs:
        head, rest = DOCS_PAGE.read_text(encoding="utf-8").split(BEGIN)
        command = f"--world {arguments.world} --cases {arguments.cases} --seed {arguments.seed}"
        source = f"`python benchmarks/gap_sensitivity.py {command}`, commit {git_revision()}:"
        DOCS_PAGE.write_text(f"{head}{BEGIN}\n\n{source}\n\n{told}\n\n{END}{rest.split(END)[1]}", encoding="utf-8")


def measured(world: str, cases: int, seed: int, jobs: int) -> tuple[dict[str, list[int]], int]:
    """([verdicts changed, first causes changed, right answers] by what was varied, joints)."""
    with tempfile.TemporaryDirectory(prefix="frictid-sensitivity-") as folder:
        sealed = draw_sealed(world, cases, seed, Path(folder), jobs, lambda *_: None)
        names = sorted(sealed.truths)
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            answers = list(pool.map(all_answers, [sealed.folder / name for name in names]))
    rows: dict[str, list[int]] = {}
    for name, answer in zip(names, answers, strict=True):
        plain = answer["as it is"]
        for what, one in answer.items():
            row = rows.setdefault(what, [0, 0, 0])
            row[0] += one[0] != plain[0]
            row[1] += one[1] != plain[1]
            row[2] += right(sealed.truths[name], one)
    return rows, len(names)


def right(truth: Mapping[str, Any], answer: Answer) -> bool:
    """Whether the first cause is one that acts; ``none`` of a healthy joint, ``unknown`` of what has no name."""
    if truth["kind"] in ("none", "outside"):
        return answer[0] == {"none": "none", "outside": "unknown"}[truth["kind"]]
    named = truth.get("main") or [effect["name"] for effect in truth["effects"]]
    return answer[1] in named


def all_answers(case: Path) -> dict[str, Answer]:
    """The answer as it is, and with every constant at half and at double."""
    experiments = ExperimentSet.load(case)
    seen: list[tuple[Any, ...]] = []
    decide = verdict.verdict

    def kept(*told: Any) -> Verdict:
        seen.append(told)
        return decide(*told)

    with put(diagnosis, "verdict", kept):
        answers = {"as it is": _answer(experiments)}
    found, channels, gaps, negligible, quiet = seen[0]
    read = [f for f in found if f.where == verdict.READ_DIRECTLY]
    for what, module, name, factor in _variations(OF_VERDICT):
        with changed(module, name, factor):
            again = [f for f in findings.findings(channels) if f.effect not in {r.effect for r in read}]
            said = decide(sorted([*read, *again], key=lambda f: -f.size), channels, gaps, negligible, quiet)
            first = said.named[0].effect if said.named and said.word in ("explained", "ambiguous") else said.word
            answers[what] = said.word, first
    for what, module, name, factor in _variations(OF_POSTERIOR):
        with changed(module, name, factor):
            answers[what] = _answer(experiments)
    return answers


def _answer(experiments: ExperimentSet) -> Answer:
    told = diagnosis.diagnose(experiments, negligible=diagnosis.NEGLIGIBLE)
    named = told.causes and told.verdict in ("explained", "ambiguous")
    return told.verdict, told.causes[0].effect if named else told.verdict


def _variations(constants: Sequence[tuple[ModuleType, str]]) -> Iterator[tuple[str, ModuleType, str, float]]:
    for module, name in constants:
        for factor in FACTORS:
            yield f"{module.__name__.rpartition('.')[2]}.{name} x {factor:g}", module, name, factor


@contextmanager
def changed(module: ModuleType, name: str, factor: float) -> Iterator[None]:
    """A constant times a factor, whole where it is a number of things, a chance at most 1."""
    value = getattr(module, name)
    other = type(value)(value * factor)
    if name in ("DOUBTED", "NEEDED", "LEADS"):
        other = min(1.0, other)
    with put(module, name, other):
        yield


@contextmanager
def put(module: ModuleType, name: str, other: Any) -> Iterator[None]:
    """Something else in the place of what a module calls by a name."""
    value = getattr(module, name)
    setattr(module, name, other)
    try:
        yield
    finally:
        setattr(module, name, value)


def table(rows: Mapping[str, Sequence[int]], joints: int) -> str:
    """One row for each variation that changes an answer, the most telling first, and the other constants by name."""
    lines = [
        f"| constant, of {joints} joints | verdict changes | first cause changes | right |",
        "|---|---|---|---|",
    ]
    first, *others = rows.items()
    loud = sorted((row for row in others if any(row[1][:2])), key=lambda row: -row[1][1])
    for what, (verdicts, causes, good) in [first, *loud]:
        lines.append(f"| {what} | {verdicts} | {causes} | {good} |")
    silent = len(others) - len(loud)
    heard = {what.partition(" x ")[0] for what, _ in loud}
    still = dict.fromkeys(name for what, _ in others if (name := what.partition(" x ")[0]) not in heard)
    lines += ["", f"{silent} of {len(others)} variations change no answer. Neither half nor double of these does:"]
    return "\n".join([*lines, f"{', '.join(still)}."])


if __name__ == "__main__":
    main()
