"""Scores answers of a diagnosis against the sealed truth: rates with intervals, never a single flattering number.

Truths and answers are the plain mappings of ``truth/*.yaml`` and of ``gap diagnose --json``; nothing here knows how
either came about.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

NAMING = ("explained", "ambiguous")
CONFIDENT = 0.9
PROMISED = 2.0  # gap over floor below which a verdict may be ``none``, whatever makes it
PRACTICAL = 0.05  # the same over the believed friction level
BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)

PARTNERS = (  # of traces alike; the other one at low confidence is an honest answer
    ("torque_bias", "direction_asymmetry"),
    ("torque_bias", "encoder_offset"),
    ("encoder_offset", "gravity_error"),
    ("viscous_nonlinearity", "stribeck"),
    ("stribeck", "stiction_breakaway"),
    ("torque_delay", "electrical_lag"),
    ("presliding_hysteresis", "torque_delay"),
)

# A figure the tool reports may differ from truth's by its own choice of filter, not by more.
AGREEMENT = 1.25


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer of the diagnosis."""

    verdict: str  # ``none``, ``explained``, ``ambiguous``, ``unknown``, or ``error`` where the diagnosis raised
    causes: tuple[tuple[str, float], ...] = ()  # ranked (effect, confidence)
    confusable: tuple[str, ...] = ()  # effects that the first cause could be mistaken for
    # Before, after, noise_floor on validation logs, each a mapping of figures; empty after an error.
    gap: Mapping[str, Mapping[str, float | None]] | None = None
    seconds: float = math.nan  # time it took
    message: str = ""  # of the error

    @staticmethod
    def from_json(document: Mapping[str, Any]) -> Answer:
        """From a line of the diagnosing process: ``{"case", "seconds", "diagnosis"}`` or ``{"case", "error"}``."""
        if "error" in document:
            return Answer("error", message=str(document["error"]), seconds=float(document.get("seconds", math.nan)))
        diagnosis = document["diagnosis"]
        causes = diagnosis.get("causes", [])
        return Answer(
            verdict=str(diagnosis["verdict"]),
            causes=tuple((str(cause["effect"]), float(cause["confidence"])) for cause in causes),
            confusable=tuple(causes[0].get("confusable_with", ())) if causes else (),
            gap=diagnosis.get("gap"),
            seconds=float(document.get("seconds", math.nan)),
        )

    @property
    def named(self) -> tuple[str, ...]:
        """Effects named as causes, in order; nothing unless the verdict names any."""
        return tuple(effect for effect, _ in self.causes) if self.verdict in NAMING else ()

    @property
    def ranking(self) -> tuple[str, ...]:
        """Causes, then what the first may be confused with."""
        return tuple(dict.fromkeys((*self.named, *(self.confusable if self.named else ()))))

    @property
    def first(self) -> str:
        """The first cause, or the verdict where none is named."""
        return self.named[0] if self.named else self.verdict

    @property
    def confidence(self) -> float:
        """Of the first cause; 0 where none is named."""
        return self.causes[0][1] if self.named else 0.0


@dataclass(frozen=True, slots=True)
class Rate:
    """A share with its 95 % Wilson interval."""

    right: int
    of: int

    @property
    def share(self) -> float | None:
        """None where nothing was counted."""
        return self.right / self.of if self.of else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Wilson score interval, 95 %."""
        if not self.of:
            return None
        z = 1.959964
        p, n = self.right / self.of, self.of
        middle = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return max(0.0, middle - half), min(1.0, middle + half)

    def to_json(self) -> dict[str, Any]:
        """Plain values; ``low`` and ``high`` bound the 95 % interval."""
        low, high = self.interval or (None, None)
        return {"rate": self.share, "low": low, "high": high, "right": self.right, "of": self.of}


def counted(outcomes: Iterable[bool]) -> dict[str, Any]:
    """A rate counted from outcomes, plain values."""
    every = list(outcomes)
    return Rate(sum(every), len(every)).to_json()


def score(truths: Mapping[str, Mapping[str, Any]], answers: Mapping[str, Answer]) -> dict[str, Any]:
    """Every rate of the blind check, plain values; by case name. A case without an answer counts as an error."""
    cases = [(truth, answers.get(name, Answer("error", message="no answer"))) for name, truth in truths.items()]
    visible = [(t, a) for t, a in cases if t["visible"]]
    singles = [(t, a) for t, a in visible if t["kind"] == "single"]
    doubles = [(t, a) for t, a in visible if t["kind"] == "double"]
    # Truth files without that figure do not say otherwise.
    apart = [(t, a) for t, a in doubles if all(e.get("size_ratio_alone", math.inf) >= 1.5 for e in t["effects"])]
    healthy = [(t, a) for t, a in cases if t["kind"] == "none"]
    outside = [(t, a) for t, a in visible if t["kind"] == "outside"]
    confident = [(t, a) for t, a in cases if a.confidence >= CONFIDENT]
    return {
        "cases": len(cases),
        "errors": [{"case": t["case"], "message": a.message} for t, a in cases if a.verdict == "error"],
        "singles": _singles(singles),
        "invisible": counted(
            a.first in ("none", "unknown") if t["kind"] == "outside" else a.first in ("none", *_names(t))
            for t, a in cases
            if not t["visible"]
        ),
        "none": {
            "answered_none": counted(a.verdict == "none" for _, a in healthy),
            "false_alarms": counted(a.verdict != "none" for _, a in healthy),
        },
        "outside": {
            "answered_unknown": counted(not_taken_in(t, a) for t, a in outside),
            "unknown_alone": counted(a.verdict == "unknown" for _, a in outside),
            "by_effect": {
                name: counted(not_taken_in(t, a) for t, a in outside if _name(t) == name)
                for name in sorted({_name(t) for t, _ in outside})
            },
        },
        "doubles": {
            "both_in_top_2": counted(set(_names(t)) <= set(a.named[:2]) for t, a in apart),
            "both_in_top_2_all": counted(set(_names(t)) <= set(a.named[:2]) for t, a in doubles),
            "at_least_one_in_top_2": counted(bool(set(_names(t)) & set(a.named[:2])) for t, a in apart),
        },
        "confident": {
            "right": counted(a.first in _names(t) for t, a in confident),
            "right_or_alias": counted(_same_or_alias(t, a) for t, a in confident),
        },
        "calibration": _calibration(cases),
        "closed": {
            figure: _closed(figure, [(t, a) for t, a in singles if a.first == _name(t)])
            for figure in ("forward_torque_nm", "inverse_nm")
        },
        "figures_against_truth": {
            figure: _agreement(figure, cases) for figure in ("inverse_nm", "forward_torque_nm", "forward_position_rad")
        },
        "unknown_enlarges_gap": [t["case"] for t, a in cases if a.verdict == "unknown" and _enlarged(a)],
        "confusion": _confusion(cases),
        "seconds": times([a.seconds for _, a in cases]),
        "misses": [_miss(t, a) for t, a in cases if not _right(t, a)],
    }


def _singles(cases: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, Any]:
    """Joints with one effect, all and by its size."""

    def tops(chosen: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, Any]:
        return {f"top_{count}": counted(_name(t) in a.ranking[:count] for t, a in chosen) for count in (1, 2)}

    return {
        **tops(cases),
        "top_1_or_alias": counted(_same_or_alias(t, a) for t, a in cases),
        "by_size": {
            size: tops([(t, a) for t, a in cases if t["size_class"] == size]) for size in ("small", "medium", "large")
        },
    }


def score_left_out(answers: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, Any]:
    """The second check: visible joints with one effect, each taken out of the library before it was diagnosed.

    An error of a belief can be named all the same, and rightly: what is believed of the number stays.
    """

    def partner(truth: Mapping[str, Any], answer: Answer) -> bool:
        return {_name(truth), answer.first} in [set(pair) for pair in PARTNERS]

    confident = [(t, a) for t, a in answers if a.confidence >= CONFIDENT and a.first != _name(t)]
    partners = [(t, a) for t, a in confident if partner(t, a)]
    return {
        "joints": len(answers),
        "errors": [{"case": t["case"], "message": a.message} for t, a in answers if a.verdict == "error"],
        "confident_wrong": Rate(len(confident) - len(partners), len(answers)).to_json(),
        "confident_partner": Rate(len(partners), len(answers)).to_json(),
        "named_all_the_same": counted(a.first == _name(t) for t, a in answers),
        "answered_unknown": counted(a.verdict == "unknown" for _, a in answers),
        "wrong_causes": [
            {
                "case": t["case"],
                "effect": _name(t),
                "named": a.first,
                "confidence": a.confidence,
                "partner": partner(t, a),
            }
            for t, a in confident
        ],
        "by_effect": {
            name: dict(Counter(a.first for t, a in answers if _name(t) == name).most_common())
            for name in sorted({_name(t) for t, _ in answers})
        },
    }


def _name(truth: Mapping[str, Any]) -> str:
    return str(truth["effects"][0]["name"])


def _names(truth: Mapping[str, Any]) -> tuple[str, ...]:
    """Library effects that act; an outsider has no name that an answer could give."""
    return tuple(effect["name"] for effect in truth["effects"] if effect["in_library"])


def _same_or_alias(truth: Mapping[str, Any], answer: Answer) -> bool:
    pairs = [set(pair) for pair in truth["aliases"]]
    return any(answer.first == name or {answer.first, name} in pairs for name in _names(truth))


def not_taken_in(truth: Mapping[str, Any], answer: Answer) -> bool:
    """``unknown`` for what the library does not hold; ``none`` is as right below the gap up to which it is promised."""
    promised = max(PROMISED, truth.get("practical_over_floor", 0.0))
    return answer.verdict == "unknown" or (answer.verdict == "none" and truth["size_ratio"] < promised)


def _right(truth: Mapping[str, Any], answer: Answer) -> bool:
    if truth["kind"] == "none":
        return answer.verdict == "none"
    if truth["kind"] == "outside":
        return not_taken_in(truth, answer)
    if not truth["visible"]:
        return answer.first in ("none", *_names(truth))
    return set(_names(truth)) <= set(answer.named[: len(truth["effects"])])


def _miss(truth: Mapping[str, Any], answer: Answer) -> dict[str, Any]:
    return {
        "case": truth["case"],
        "kind": truth["kind"],
        "truth": [effect["name"] for effect in truth["effects"]],
        "visible": truth["visible"],
        "size_ratio": truth["size_ratio"],
        "verdict": answer.verdict,
        "named": [{"effect": effect, "confidence": confidence} for effect, confidence in answer.causes],
    }


def _calibration(cases: Sequence[tuple[Mapping[str, Any], Answer]]) -> list[dict[str, Any]]:
    named = [(a.confidence, a.first in _names(t)) for t, a in cases if a.named]
    rows = []
    for low, high in itertools.pairwise(BINS):
        inside = [(c, right) for c, right in named if low <= c < high or (high == 1.0 and c == 1.0)]
        mean = _summed(np.mean, [c for c, _ in inside])
        rows.append({"from": low, "to": high, "mean_confidence": mean, **counted(right for _, right in inside)})
    return rows


def _figure(answer: Answer, when: str, figure: str) -> float | None:
    value = ((answer.gap or {}).get(when) or {}).get(figure)
    return None if value is None else float(value)


def _closed(figure: str, cases: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, Any]:
    """Share of the closable gap that was closed on validation logs, from the tool's own figures and truth's floor.

    Nothing is applied where it is ``ambiguous``: such joints are counted apart, and once more as with nothing closed.
    """
    shares, undecided, without = [], 0, 0
    for truth, answer in cases:
        before, after = _figure(answer, "before", figure), _figure(answer, "after", figure)
        ideal = _held_out(truth, "ideal_residual", figure)
        # Where the validation logs hold nothing to close, a share is a quotient of noise.
        if before is None or after is None or before - ideal < 0.15 * ideal:
            without += 1
            continue
        if answer.verdict == "ambiguous":
            undecided += 1
        else:
            shares.append((before - after) / (before - ideal))
    return {
        "joints": len(shares),
        "ambiguous": undecided,
        "without_figure": without,
        "median": float(np.median(shares)) if shares else None,
        "p10": float(np.quantile(shares, 0.1)) if shares else None,
        "p10_ambiguous_as_nothing": float(np.quantile([*shares, *[0.0] * undecided], 0.1)) if shares else None,
        "worst": float(min(shares)) if shares else None,
    }


def _held_out(truth: Mapping[str, Any], what: str, figure: str) -> float:
    """A truth figure over the validation logs, or over all where the file does not part them."""
    return float(truth.get("validation", truth)[what][figure])


def _agreement(figure: str, cases: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, Any]:
    """The gap that the tool reports before any fix, over the gap that the logs contain."""

    def over(when: str, what: str) -> dict[str, float]:
        return {
            str(truth["case"]): told / _held_out(truth, what, figure)
            for truth, answer in cases
            if (told := _figure(answer, when, figure)) is not None and _held_out(truth, what, figure) > 0.0
        }

    ratios = over("before", "gap")
    values = list(ratios.values())
    return {
        "joints": len(values),
        "median_ratio": float(np.median(values)) if values else None,
        "p05_ratio": float(np.quantile(values, 0.05)) if values else None,
        "p95_ratio": float(np.quantile(values, 0.95)) if values else None,
        "larger_than_the_logs_contain": sorted(case for case, ratio in ratios.items() if ratio > AGREEMENT),
        "smaller_than_the_logs_contain": sorted(case for case, ratio in ratios.items() if ratio < 1 / AGREEMENT),
        "better_than_ideal": sorted(
            case for case, ratio in over("after", "ideal_residual").items() if ratio < 1 / AGREEMENT
        ),
    }


def _enlarged(answer: Answer) -> bool:
    for figure in ("inverse_nm", "forward_torque_nm"):
        before, after = _figure(answer, "before", figure), _figure(answer, "after", figure)
        if before is not None and after is not None and after > 1.01 * before:
            return True
    return False


def _confusion(cases: Sequence[tuple[Mapping[str, Any], Answer]]) -> dict[str, dict[str, int]]:
    """First answers by true effect, visible joints with at most one effect; ``none`` and ``outside`` are rows too."""
    rows: dict[str, Counter[str]] = {}
    for truth, answer in cases:
        if truth["visible"] and truth["kind"] != "double":
            row = _name(truth) if truth["kind"] == "single" else str(truth["kind"])
            rows.setdefault(row, Counter())[answer.first] += 1
    return {row: dict(counts.most_common()) for row, counts in sorted(rows.items())}


def times(seconds: Sequence[float]) -> dict[str, float | None]:
    """Of those that were measured."""
    measured = [value for value in seconds if math.isfinite(value)]
    return {
        "median": _summed(np.median, measured),
        "p90": _summed(lambda all_of_them: np.quantile(all_of_them, 0.9), measured),
        "worst": _summed(max, measured),
    }


def _summed(how: Callable[[Sequence[float]], Any], values: Sequence[float]) -> float | None:
    return float(how(values)) if values else None
