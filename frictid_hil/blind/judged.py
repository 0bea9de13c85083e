"""Scores of the wide world and the zoo: what is named first, false all-clears, confidence against truth, intervals.

A truth names the causes that are right first (``main``), those that are there (``present``), those that are neither
(``neutral``), and what can't be told from each contributor.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictid_hil.blind.generator import VISIBLE
from frictid_hil.blind.score import CONFIDENT, Answer, Rate, counted, not_taken_in, times

FALSE_CLEAR = 3.0  # gap over floor from which ``none`` is a false all-clear
BINS = 10  # of confidence, for the calibration error
LEVEL = "friction_level_error"
LIKELY = 0.5  # confidence from which a cause is claimed rather than mentioned


@dataclass(frozen=True, slots=True)
class Cause:
    """A cause that an answer names."""

    confidence: float  # as the answer tells it
    there: bool  # whether truth has it
    neutral: bool = False  # neither there nor not: naming it is neither right nor wrong


def judged(truths: Mapping[str, Mapping[str, Any]], documents: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Every figure, plain values, from truths and answered lines by case name; a case without a line is an error."""
    absent = {"error": "no answer"}
    cases = [(t, Answer.from_json(documents.get(n, absent)), documents.get(n, absent)) for n, t in truths.items()]
    wrong = [(t, a) for t, a, _ in cases if t["kind"] in ("tolerance", "single", "double")]
    visible = [(t, a) for t, a in wrong if t["size_ratio"] >= VISIBLE]
    every = _causes([(t, a) for t, a, _ in cases])
    named = [cause for cause in every if not cause.neutral]
    # A first cause that is neither there nor not is no mistake.
    sure = [not _there(t, a.first) and a.first not in t["neutral"] for t, a, _ in cases if a.confidence >= CONFIDENT]
    off = [(t, a) for t, a in visible if LEVEL in t["main"]]
    taken = [a.confidence >= LIKELY and a.first not in (*t["main"], *_tied(t)) for t, a in off]

    def first(chosen: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, Any]:
        return counted(_right(t, a) for t, a in chosen)

    def by(key: str) -> dict[str, Any]:
        found = sorted({str(t[key]) for t, _ in visible})
        return {value: first([(t, a) for t, a in visible if t[key] == value]) for value in found}

    return {
        "cases": len(cases),
        "errors": [{"case": t["case"], "message": a.message} for t, a, _ in cases if a.verdict == "error"],
        "first": first(visible),
        "first_by_kind": by("kind"),
        "first_by_controller": by("controller"),
        "first_or_tied": counted(_right(t, a) or a.first in _tied(t) for t, a in visible),
        "none": counted(a.verdict == "none" for t, a, _ in cases if t["kind"] == "none"),
        "first_of_all": first(wrong),
        "outside": counted(not_taken_in(t, a) for t, a, _ in cases if t["kind"] == "outside"),
        "false_none": counted(
            a.verdict == "none" for t, a, _ in cases if t["size_ratio"] >= FALSE_CLEAR
        ),
        "sure_and_wrong": Rate(sum(sure), len(cases)).to_json(),
        "friction_level_taken_for_another": counted(taken),
        # A level that is told behind another cause is told.
        "friction_level_not_told": counted(
            another and dict(a.causes).get(LEVEL, 0.0) < LIKELY for another, (_, a) in zip(taken, off, strict=True)
        ),
        "parameters": counted(held for t, _, d in cases for held in _held(t, d)),
        "brier": float(np.mean([(cause.confidence - cause.there) ** 2 for cause in named])) if named else None,
        "calibration_error": calibration_error(named) if named else None,
        "calibration_error_neutral_as_wrong": calibration_error(every) if every else None,
        "causes": {"judged": len(named), "neutral": len(every) - len(named)},
        "confusion": _confusion([(t, a) for t, a, _ in cases]),
        "seconds": {n: s for n, s in times([a.seconds for _, a, _ in cases]).items() if n != "worst"},
        "misses": [
            {"case": t["case"], "kind": t["kind"], "main": t["main"], "answer": a.first, "confidence": a.confidence,
             "size": t["size_ratio"]}
            for t, a, _ in cases if not _right(t, a)
        ],
    }  # fmt: skip


def headline(scores: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The rates that a person asks for first, by name."""
    told = {f"first_controller_{name}": rate for name, rate in scores["first_by_controller"].items()}
    level = ("friction_level_taken_for_another", "friction_level_not_told")
    rest = ("none", "outside", "false_none", "sure_and_wrong", *level, "parameters")
    names = ("first", "first_of_all", *told, "first_or_tied", *rest)
    return {name: told.get(name) or scores[name] for name in names}


def page(result: Mapping[str, Any]) -> str:
    """One run in Markdown, failures included."""
    scores = result["scores"]
    lines = [
        f"### The {result['world']} world",
        "",
        f"{result['cases']} joints, seed {result['seed']}; SHA-256 of the truth, published before the first answer: "
        f"`{result['truth_sha256']}`; of the code that answered: `{result['code_sha256']}`.",
        "",
        "| | share | 95 % interval | count |",
        "|---|---|---|---|",
    ]
    for name, rate in headline(scores).items():
        if rate["of"]:
            interval = f"{100 * rate['low']:.0f} .. {100 * rate['high']:.0f} %"
            share = f"{100 * rate['rate']:.1f} %"
            lines.append(f"| {name.replace('_', ' ')} | {share} | {interval} | {rate['right']} of {rate['of']} |")
    lines += [
        "",
        f"Brier score of named causes {_told(scores['brier'])}, expected calibration error "
        f"{_told(scores['calibration_error'])} (with neutral causes as wrong "
        f"{_told(scores['calibration_error_neutral_as_wrong'])}); median of processor time "
        f"{_told(scores['seconds']['median'])} s; errors {len(scores['errors'])}.",
        "",
        "| missed | truth | answer | confidence | floors |",
        "|---|---|---|---|---|",
    ]
    for miss in scores["misses"]:
        truth = ", ".join(miss["main"]) or "none"
        lines.append(f"| {miss['case']} | {truth} | {miss['answer']} | {miss['confidence']:.2f} | {miss['size']:.3g} |")
    return "\n".join(lines) + "\n"


def _told(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _right(truth: Mapping[str, Any], answer: Answer) -> bool:
    if truth["kind"] == "none":
        return answer.verdict == "none"
    return answer.first in truth["main"]


def _tied(truth: Mapping[str, Any]) -> set[str]:
    """What can't be told from a right first answer."""
    return {name for one in truth["contributors"] if one["name"] in truth["main"] for name in one["indistinguishable"]}


def _there(truth: Mapping[str, Any], effect: str) -> bool:
    return effect in (*truth["present"], *truth["main"]) or effect in _tied(truth)


def _held(truth: Mapping[str, Any], document: Mapping[str, Any]) -> list[bool]:
    """Whether the interval of each known parameter that the answer states holds the truth."""
    diagnosis = document.get("diagnosis") or {}
    stated = {
        (cause["effect"], name): value["interval_95"]
        for cause in diagnosis.get("causes", [])
        for name, value in cause.get("parameters", {}).items()
        if isinstance(value, Mapping) and value.get("interval_95")
    }
    return [
        bool(interval[0] <= known["value"] <= interval[1])
        for known in truth["true_parameters"]
        if (interval := stated.get((known["effect"], known["parameter"]))) is not None
    ]


def named_causes(truths: Mapping[str, Mapping[str, Any]], documents: Mapping[str, Mapping[str, Any]]) -> list[Cause]:
    """What calibration is judged on: all causes of all answers but those that are neither there nor not."""
    cases = [(t, Answer.from_json(documents[name])) for name, t in truths.items() if name in documents]
    return [cause for cause in _causes(cases) if not cause.neutral]


def _causes(cases: Sequence[tuple[Mapping[str, Any], Answer]]) -> list[Cause]:
    return [
        Cause(confidence, there, not there and effect in t["neutral"])
        for t, a in cases
        if a.named
        for effect, confidence in a.causes
        for there in [_there(t, effect)]
    ]


def calibration_error(causes: Sequence[Cause]) -> float:
    """Mean distance of confidence from share, over bins of confidence, weighted by count."""
    chance = np.array([cause.confidence for cause in causes])
    there = np.array([float(cause.there) for cause in causes])
    bins = np.minimum((chance * BINS).astype(int), BINS - 1)
    parts = [abs(float(np.sum(chance[bins == k] - there[bins == k]))) for k in range(BINS)]
    return float(sum(parts) / chance.size)


def _confusion(cases: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, dict[str, int]]:
    rows: dict[str, Counter[str]] = {}
    for truth, answer in cases:
        rows.setdefault(truth["main"][0] if truth["main"] else "none", Counter())[answer.first] += 1
    return {row: dict(counts) for row, counts in sorted(rows.items())}
