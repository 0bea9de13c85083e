"""Figures and dates as people read them."""

from __future__ import annotations

import pytest

from frictid_hil.config.profile import Estimate
from frictid_hil.report.words import change, estimate, plain, sentence, when, with_interval


@pytest.mark.parametrize(
    ("value", "low", "high", "told"),
    [
        (4.65684, 4.62231, 4.69137, "4.657 \u00b1 0.035 N m"),
        (19184.6, 18525.0, 19844.2, "19,185 \u00b1 660 N m"),
        (1.0, 0.5, 3.0, "1.0 (0.5 .. 3.0) N m"),
        (-0.25, -0.2612, -0.2388, "-0.250 \u00b1 0.011 N m"),
        (4.65684, None, None, "4.657 N m"),
        (4.65684, 4.65684, 4.65684, "4.657 N m"),
        (0.0, None, None, "0 N m"),
    ],
)
def test_as_many_digits_as_the_interval_bears(value: float, low: float | None, high: float | None, told: str) -> None:
    assert with_interval(value, low, high, "N m") == told


def test_a_figure_that_is_missing_says_why() -> None:
    assert estimate(Estimate.none("no slow reversal"), "N m") == "none: no slow reversal"


@pytest.mark.parametrize(
    ("value", "told"), [(15306.498, "15,306"), (2e-7, "2e-07"), (0.0012346, "0.001235"), (3.2e7, "3.2e+07")]
)
def test_no_exponent_where_a_person_would_write_none(value: float, told: str) -> None:
    assert plain(value) == told


def test_dates_changes_and_sentences() -> None:
    assert when("2026-11-21T05:15:59Z") == "2026-11-21 05:15 UTC"
    assert when("") == "" and when("yesterday") == "yesterday"
    assert [change(x) for x in (None, 14.04, -0.02, 0.02, -3.0)] == ["", "+14.0", "0.0", "0.0", "-3.0"]
    assert sentence("torque is late") == "Torque is late." and sentence("") == "" and sentence("Why?") == "Why?"
