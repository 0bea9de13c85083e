"""The page that shows a blind check, failures included, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.metadata import version
from typing import Any

_HEAD = """### The last full run

`frictid-hil gap check` draws joints from a generator of its own (other formulas and another integrator than the effect
library), seals what was drawn, has other processes diagnose the recordings, and only then compares. This page is the
last full run, failures included.
"""


_RATES = {  # by name: where they stand in the scores, and what they are called
    "singles_top_1": ("singles", "top_1", "Visible single effects named first"),
    "singles_top_1_or_alias": ("singles", "top_1_or_alias", "... or its alias"),
    "singles_top_2": ("singles", "top_2", "... among the first two"),
    "none_answered_none": ("none", "answered_none", "Healthy joints answered `none`"),
    "outside_answered_unknown": (
        "outside",
        "answered_unknown",
        "Visible effects from outside answered `unknown`, or `none` where it is promised",
    ),
    "outside_unknown_alone": ("outside", "unknown_alone", "... answered `unknown`"),
    "doubles_both_in_top_2": ("doubles", "both_in_top_2", "Both of two effects (each visible alone) in the first two"),
    "doubles_all_both_in_top_2": ("doubles", "both_in_top_2_all", "... of all pairs"),
    "invisible_none_or_named": ("invisible", "", "Invisible effects answered `none` or by their name"),
    "confident_right": ("confident", "right", "Answers of confidence 0.9 and more that are right"),
    "confident_right_or_alias": ("confident", "right_or_alias", "... or the alias of right"),
}
AIMS = {  # that the diagnosis is to reach
    "singles_top_1": 0.97,
    "singles_top_2": 0.98,
    "none_answered_none": 0.97,
    "outside_answered_unknown": 0.95,
    "doubles_both_in_top_2": 0.85,
    "confident_right": 0.95,
}
CLOSED_AIMS = {"median": 0.97, "p10": 0.85}
_QUANTILES = {"median": "median", "p10": "10 % quantile"}
SECONDS_AIM = 5.0
LEFT_OUT_AIM = 0.03


def headline(scores: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The rates that a person asks for first, by name."""
    return {name: scores[part][rate] if rate else scores[part] for name, (part, rate, _) in _RATES.items()}


def page(result: Mapping[str, Any]) -> str:
    """The whole page of one run."""
    scores = result["scores"]
    lines = [
        _HEAD,
        f"{result['cases']} joints, seed {result['seed']}, frictid-hil {version('frictid-hil')}: "
        f"`python benchmarks/gap_check.py --cases {result['cases']} --seed {result['seed']}"
        f"{' --leave-one-out' if result.get('leave_one_out') else ''}`. SHA-256 of the truth, published before the "
        f"first answer: `{result['truth_sha256']}`; of the code that answered: `{result['code_sha256']}`.",
        "",
        *_rates(scores),
        *_by_size(scores),
        *_closed(scores),
        *_calibration(scores),
        *_figures(scores),
        *_confusion(scores),
        *_outside(scores),
        *_misses(scores),
        *(_left_out(result["leave_one_out"]) if result.get("leave_one_out") else ()),
    ]
    return "\n".join(lines) + "\n"


def _section(title: str, *prose: str, head: str, rows: Iterable[str]) -> list[str]:
    """A heading, paragraphs and a table."""
    told = [line for paragraph in prose for line in (paragraph, "")]
    return [f"### {title}", "", *told, head, "|---" * (head.count("|") - 1) + "|", *rows, ""]


def _rates(scores: Mapping[str, Any]) -> list[str]:
    seconds, alarms = scores["seconds"], scores["none"]["false_alarms"]
    rows = (
        f"| {_RATES[name][2]} | {_percent(AIMS.get(name))} | {_percent(rate['rate'])} | {_interval(rate)} "
        f"| {_count(rate)} | {_met(rate, AIMS.get(name))} |"
        for name, rate in headline(scores).items()
    )
    return [
        *_section("Rates", head="| | aim | share | 95 % interval | count | |", rows=rows),
        f"False alarms on healthy joints (aim at most {_percent(1 - AIMS['none_answered_none'])}): "
        f"{_percent(alarms['rate'])} ({_count(alarms)}).",
        "",
        f"Processor time per joint (aim: median {SECONDS_AIM:.0f} s): median {_number(seconds['median'])} s, "
        f"90 % within {_number(seconds['p90'])} s, longest {_number(seconds['worst'])} s. Diagnoses that raised an "
        f"error: {len(scores['errors'])}. Answers `unknown` that enlarged the gap: "
        f"{len(scores['unknown_enlarges_gap'])}.",
        "",
    ]


def _by_size(scores: Mapping[str, Any]) -> list[str]:
    rows = (
        f"| {size} | {_percent(rates['top_1']['rate'])} | {_percent(rates['top_2']['rate'])} | {rates['top_1']['of']} |"
        for size, rates in scores["singles"]["by_size"].items()
    )
    told = "The size is the largest ratio of gap to floor: small below 4, medium below 12, large above."
    return _section("Single effects by size", told, head="| size | first | first two | count |", rows=rows)


def _closed(scores: Mapping[str, Any]) -> list[str]:
    return _section(
        "Share of the gap closed",
        "On validation logs, for single effects named first: (before - after) / (before - floor), before and after as "
        f"the tool reports them, the floor from the truth. Aim for the torque: median {CLOSED_AIMS['median']}, "
        f"10 % quantile {CLOSED_AIMS['p10']}. Nothing is applied where the verdict is `ambiguous`: such joints are not "
        "among these; the last column counts them as nothing closed.",
        head="| figure | median | 10 % quantile | worst | joints | | ambiguous | 10 % quantile with them |",
        rows=(
            f"| `{figure}` | {_number(row['median'])} | {_number(row['p10'])} | {_number(row['worst'])} "
            f"| {row['joints']} | {_closed_met(row) if figure == 'forward_torque_nm' else ''} "
            f"| {row['ambiguous']} | {_number(row['p10_ambiguous_as_nothing'])} |"
            for figure, row in scores["closed"].items()
        ),
    )


def _closed_met(row: Mapping[str, Any]) -> str:
    if row["median"] is None:
        return ""
    missed = [_QUANTILES[name] for name, aim in CLOSED_AIMS.items() if row[name] < aim]
    return f"**{' and '.join(missed)} missed**" if missed else "met"


def _calibration(scores: Mapping[str, Any]) -> list[str]:
    rows = (
        f"| {row['from']:.2f} to {row['to']:.2f} | {_number(row['mean_confidence'])} | {_percent(row['rate'])} "
        f"| {_count(row)} |"
        for row in scores["calibration"]
    )
    return _section("Calibration", head="| confidence | mean | right | count |", rows=rows)


def _figures(scores: Mapping[str, Any]) -> list[str]:
    return _section(
        "The tool's own figures against the truth",
        "The gap that the tool reports before any fix, over the gap that the recordings contain. A larger one is a "
        "defect.",
        head="| figure | median | 5 % | 95 % | larger | smaller | after, better than ideal |",
        rows=(
            f"| `{figure}` | {_number(row['median_ratio'])} | {_number(row['p05_ratio'])} | "
            f"{_number(row['p95_ratio'])} | {len(row['larger_than_the_logs_contain'])} | "
            f"{len(row['smaller_than_the_logs_contain'])} | {len(row['better_than_ideal'])} |"
            for figure, row in scores["figures_against_truth"].items()
        ),
    )


def _confusion(scores: Mapping[str, Any]) -> list[str]:
    rows = (f"| {truth} | {_counts(answers)} |" for truth, answers in scores["confusion"].items())
    return _section("What was answered for what", head="| truth | first answers |", rows=rows)


def _outside(scores: Mapping[str, Any]) -> list[str]:
    title = "Effects from outside, answered `unknown`, or `none` where it is promised"
    rows = (f"| {effect} | {_count(rate)} |" for effect, rate in scores["outside"]["by_effect"].items())
    return _section(title, head="| effect | right |", rows=rows)


def _misses(scores: Mapping[str, Any]) -> list[str]:
    rows = []
    for miss in scores["misses"]:
        truth = " + ".join(miss["truth"]) or "none"
        named = ", ".join(f"{cause['effect']} ({cause['confidence']:.2f})" for cause in miss["named"]) or "-"
        visible = "" if miss["visible"] else ", invisible"
        rows.append(
            f"| {miss['case']} | {truth} ({miss['kind']}{visible}) | {miss['size_ratio']:.2f} | {miss['verdict']} "
            f"| {named} |"
        )
    return _section("Every miss", head="| case | truth | size | verdict | named |", rows=rows)


def _left_out(check: Mapping[str, Any]) -> list[str]:
    wrong, partner = check["confident_wrong"], check["confident_partner"]
    both = (wrong["right"] + partner["right"]) / wrong["of"] if wrong["of"] else None
    # Every cause named with confidence though its effect was not there.
    confident = (
        f"| {one['case']} | {one['effect']} | {one['named']} ({one['confidence']:.2f}) "
        f"| {'partner' if one['partner'] else ''} |"
        for one in check["wrong_causes"]
    )
    table = ["| case | effect left out | named with confidence | |", "|---|---|---|---|", *confident]
    return [
        "### With the joint's own effect taken out of the library",
        "",
        f"{check['joints']} visible joints with one effect. A confident (0.9 and more) wrong cause, aim "
        f"{_percent(LEFT_OUT_AIM)} at most: "
        f"{_percent(wrong['rate'])} ({_count(wrong)}, {_interval(wrong)}); "
        f"a confident partner of the true one (an honest one is named below 0.9): {_count(partner)}, "
        f"{_interval(partner)}; the two together: {_percent(both)}. Named all the same, as an error of a "
        f"belief can be: {_count(check['named_all_the_same'])}. Answered `unknown`: "
        f"{_percent(check['answered_unknown']['rate'])}.",
        "",
        *(table if check["wrong_causes"] else ["No cause was named with confidence."]),
        "",
        "| effect left out | first answers |",
        "|---|---|",
        *(f"| {effect} | {_counts(answers)} |" for effect, answers in check["by_effect"].items()),
        "",
    ]


def _counts(answers: Mapping[str, int]) -> str:
    return ", ".join(f"{answer} {count}" for answer, count in answers.items())


def _met(rate: Mapping[str, Any], aim: float | None) -> str:
    """Whether a rate reaches its aim, and where it does not, whether its interval still holds the aim."""
    if aim is None or rate["rate"] is None:
        return ""
    if rate["rate"] >= aim:
        return "met"
    return "missed, within the interval" if rate["high"] >= aim else "**missed**"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _interval(rate: Mapping[str, Any]) -> str:
    return "-" if rate["low"] is None else f"{100 * rate['low']:.1f} to {100 * rate['high']:.1f} %"


def _count(rate: Mapping[str, Any]) -> str:
    return f"{rate['right']} of {rate['of']}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
