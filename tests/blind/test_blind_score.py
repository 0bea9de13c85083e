"""Scores by hand: what counts as right, and that a rate cannot flatter itself."""

from __future__ import annotations

from typing import Any

import pytest

from frictid_hil.blind.page import page
from frictid_hil.blind.score import Answer, Rate, score, score_left_out

ALIASES = [["torque_delay", "electrical_lag"]]
FLOOR = {"inverse_nm": 0.1, "actuation_nm": 0.1, "forward_torque_nm": 0.1, "forward_position_rad": 1e-5}


def truth(case: str, kind: str, *effects: str, ratio: float = 5.0, alone: tuple[float, ...] = ()) -> dict[str, Any]:
    gap = {figure: ratio * value for figure, value in FLOOR.items()}
    return {
        "case": case,
        "kind": kind,
        "effects": [
            {"name": name, "in_library": kind != "outside", **({"size_ratio_alone": alone[k]} if alone else {})}
            for k, name in enumerate(effects)
        ],
        "visible": ratio >= 1.5 or kind == "none",
        "size_ratio": ratio,
        "size_class": "none" if kind == "none" else "small" if ratio < 4 else "medium" if ratio < 12 else "large",
        "validation": {"gap": gap, "ideal_residual": FLOOR},
        "aliases": ALIASES,
    }


def answer(
    verdict: str, *causes: tuple[str, float], before: float = 0.5, after: float = 0.1, confusable: tuple[str, ...] = ()
) -> Answer:
    return Answer.from_json(
        {
            "case": "-",
            "seconds": 2.0,
            "diagnosis": {
                "verdict": verdict,
                "causes": [{"effect": e, "confidence": c, "confusable_with": list(confusable)} for e, c in causes],
                "gap": {
                    "before": {"inverse_nm": before, "forward_torque_nm": before, "forward_position_rad": None},
                    "after": {"inverse_nm": after, "forward_torque_nm": after, "forward_position_rad": None},
                },
            },
        }
    )


def scored(*pairs: tuple[dict[str, Any], Answer]) -> dict[str, Any]:
    return score({t["case"]: t for t, _ in pairs}, {t["case"]: a for t, a in pairs})


def counts(rate: dict[str, Any]) -> tuple[int, int]:
    return rate["right"], rate["of"]


def test_wilson_interval_of_eight_in_ten() -> None:
    low, high = Rate(8, 10).interval or (0.0, 0.0)
    assert low == pytest.approx(0.4902, abs=1e-4)
    assert high == pytest.approx(0.9433, abs=1e-4)
    assert Rate(0, 0).share is None
    assert Rate(0, 0).interval is None


def test_singles_count_the_first_cause_and_the_first_two() -> None:
    s = scored(
        (truth("a", "single", "stribeck"), answer("explained", ("stribeck", 0.95))),
        (truth("b", "single", "stribeck", ratio=2), answer("explained", ("gravity_error", 0.6), ("stribeck", 0.3))),
        (truth("c", "single", "stribeck", ratio=20), answer("unknown", ("stribeck", 0.4))),
        (truth("d", "single", "torque_delay"), answer("ambiguous", ("electrical_lag", 0.5))),
        (
            truth("e", "single", "torque_delay"),
            answer("explained", ("electrical_lag", 0.6), confusable=("torque_delay",)),
        ),
    )["singles"]
    assert counts(s["top_1"]) == (1, 5)
    assert counts(s["top_2"]) == (3, 5)
    assert counts(s["top_1_or_alias"]) == (3, 5)
    assert counts(s["by_size"]["small"]["top_2"]) == (1, 1)
    assert counts(s["by_size"]["large"]["top_1"]) == (0, 1)


def test_an_invisible_effect_may_be_missed_or_named_but_not_mistaken() -> None:
    s = scored(
        (truth("a", "single", "stribeck", ratio=1.1), answer("none")),
        (truth("b", "single", "stribeck", ratio=1.1), answer("explained", ("stribeck", 0.6))),
        (truth("c", "single", "stribeck", ratio=1.1), answer("explained", ("backlash", 0.6))),
        (truth("d", "single", "stribeck", ratio=1.1), answer("unknown")),
        (truth("e", "outside", "bumper", ratio=1.1), answer("unknown")),
    )
    assert counts(s["invisible"]) == (3, 5)
    assert counts(s["singles"]["top_1"]) == (0, 0)


def test_any_word_but_none_about_a_healthy_joint_is_a_false_alarm() -> None:
    s = scored(
        (truth("a", "none", ratio=1.0), answer("none")),
        (truth("b", "none", ratio=1.0), answer("unknown")),
        (truth("c", "none", ratio=1.0), answer("explained", ("torque_bias", 0.9))),
    )["none"]
    assert counts(s["answered_none"]) == (1, 3)
    assert counts(s["false_alarms"]) == (2, 3)


def test_a_pair_needs_both_and_both_must_be_visible_alone() -> None:
    s = scored(
        (truth("a", "double", "x", "y", alone=(3, 3)), answer("explained", ("y", 0.9), ("x", 0.9))),
        (truth("b", "double", "x", "y", alone=(3, 3)), answer("explained", ("x", 0.9), ("z", 0.9), ("y", 0.9))),
        (truth("c", "double", "x", "y", alone=(3, 1.2)), answer("explained", ("x", 0.9))),
    )["doubles"]
    assert counts(s["both_in_top_2"]) == (1, 2)
    assert counts(s["both_in_top_2_all"]) == (1, 3)
    assert counts(s["at_least_one_in_top_2"]) == (2, 2)


def test_none_is_right_about_an_outsider_as_far_as_it_is_promised() -> None:
    small = truth("a", "outside", "bumper", ratio=1.9)
    practical = truth("b", "outside", "bumper", ratio=3.0) | {"practical_over_floor": 3.5}
    visible = truth("c", "outside", "bumper", ratio=4.0) | {"practical_over_floor": 3.5}
    s = scored(*((one, answer("none")) for one in (small, practical, visible)))["outside"]
    assert counts(s["answered_unknown"]) == (2, 3)
    assert counts(s["unknown_alone"]) == (0, 3)


def test_confidence_about_an_outsider_is_wrong_whatever_is_named() -> None:
    s = scored(
        (truth("a", "outside", "bumper"), answer("explained", ("encoder_offset", 0.97))),
        (truth("b", "single", "stribeck"), answer("explained", ("stribeck", 0.93))),
        (truth("c", "outside", "bumper"), answer("unknown", ("stribeck", 0.99))),
    )
    assert counts(s["confident"]["right"]) == (1, 2)
    assert counts(s["outside"]["answered_unknown"]) == (1, 2)
    bins = {row["from"]: counts(row) for row in s["calibration"]}
    assert bins[0.95] == (0, 1)
    assert bins[0.9] == (1, 1)


def test_closed_share_uses_the_floor_of_the_truth() -> None:
    s = scored(
        (truth("a", "single", "stribeck"), answer("explained", ("stribeck", 0.9), before=0.5, after=0.14)),
        (truth("b", "single", "stribeck"), answer("explained", ("backlash", 0.9), before=0.5, after=0.5)),
        (truth("c", "single", "stribeck"), answer("explained", ("stribeck", 0.9), before=0.11, after=0.1)),
        (truth("d", "single", "stribeck"), answer("ambiguous", ("stribeck", 0.5), before=0.5, after=0.5)),
    )["closed"]["forward_torque_nm"]
    assert s["median"] == pytest.approx(0.9)
    assert (s["joints"], s["ambiguous"], s["without_figure"]) == (1, 1, 1)
    assert s["p10_ambiguous_as_nothing"] == pytest.approx(0.09)


def test_a_gap_larger_than_the_logs_contain_is_reported_as_a_defect() -> None:
    s = scored(
        (truth("a", "single", "stribeck"), answer("none", before=0.8, after=0.05)),
        (truth("b", "single", "stribeck"), answer("none", before=0.52, after=0.1)),
    )["figures_against_truth"]
    assert s["inverse_nm"]["larger_than_the_logs_contain"] == ["a"]
    assert s["inverse_nm"]["better_than_ideal"] == ["a"]
    assert s["forward_position_rad"]["joints"] == 0


def test_an_error_or_a_missing_answer_is_wrong_everywhere() -> None:
    truths = {"a": truth("a", "single", "stribeck"), "b": truth("b", "none", ratio=1.0)}
    s = score(truths, {"a": Answer.from_json({"case": "a", "error": "ValueError: no"})})
    assert [entry["case"] for entry in s["errors"]] == ["a", "b"]
    assert counts(s["singles"]["top_1"]) == (0, 1)
    assert counts(s["none"]["false_alarms"]) == (1, 1)
    assert {miss["case"] for miss in s["misses"]} == {"a", "b"}


def test_unknown_that_changes_the_gap_for_the_worse_is_listed() -> None:
    s = scored(
        (truth("a", "outside", "bumper"), answer("unknown", before=0.5, after=0.9)),
        (truth("b", "outside", "bumper"), answer("unknown", before=0.5, after=0.5)),
    )
    assert s["unknown_enlarges_gap"] == ["a"]
    assert s["confusion"] == {"outside": {"unknown": 2}}


def test_with_its_effect_left_out_only_a_confident_stranger_is_wrong() -> None:
    delayed = truth("a", "single", "torque_delay")
    s = score_left_out(
        [
            (delayed, answer("unknown")),
            (delayed, answer("explained", ("electrical_lag", 0.7))),
            (delayed, answer("explained", ("electrical_lag", 0.95))),
            (delayed, answer("explained", ("stribeck", 0.95))),
            (delayed, answer("explained", ("stribeck", 0.5))),
            (truth("b", "single", "gravity_error"), answer("explained", ("gravity_error", 0.95))),
        ]
    )
    assert counts(s["confident_wrong"]) == (1, 6)
    assert counts(s["confident_partner"]) == (1, 6)
    assert counts(s["named_all_the_same"]) == (1, 6)
    assert [cause["named"] for cause in s["wrong_causes"]] == ["electrical_lag", "stribeck"]
    assert s["by_effect"]["torque_delay"] == {"electrical_lag": 2, "stribeck": 2, "unknown": 1}


def test_the_page_lists_every_miss() -> None:
    s = scored(
        (truth("case_007", "single", "stribeck"), answer("explained", ("backlash", 0.61))),
        (truth("case_008", "none", ratio=1.0), answer("none")),
    )
    hashes = {"truth_sha256": "ab" * 32, "code_sha256": "cd" * 32}
    text = page({"cases": 2, "seed": 5, **hashes, "scores": s, "leave_one_out": None})
    assert "| case_007 | stribeck (single) | 5.00 | explained | backlash (0.61) |" in text
    assert "case_008" not in text
    assert "0 of 1" in text
    assert "abab" in text
