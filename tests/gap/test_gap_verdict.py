"""What is said of draws that are given: the rules of the verdict, each by itself."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from frictid_hil.gap.channel import Term
from frictid_hil.gap.findings import DRAWS, SIDED, Finding, Sampled, findings
from frictid_hil.gap.how_far import Closed
from frictid_hil.gap.verdict import _shown, unreached, verdict

CAUSE = "torque_saturation"
ERROR = "gravity_error"
NEGLIGIBLE = 1.2  # between one floor and two


def channel(name: str, cause: str, size: float, signs: np.ndarray, *, between_rows: bool = False) -> Sampled:
    """Draws that all hold one cause of a size, in floors, with the signs of its coefficient."""
    term = Term(cause, {}, (0,), np.zeros(1), np.ones(1))
    nuisances = (term,) if cause == ERROR else ()
    held = SimpleNamespace(
        name=name,
        nuisances=nuisances,
        between_rows=between_rows,
        logs=(),
        judged=(),
        level_free=False,
        of_the_joint=name in ("plant", "loop"),
    )
    posterior: Any = SimpleNamespace(
        channel=held,
        chance=0.03,
        floor=1.0,
        terms=lambda model: [term],
        contributions=lambda draw: {cause: (np.zeros(1, dtype=int), draw.values)},
    )
    draws: Any = [
        SimpleNamespace(model=SimpleNamespace(effects=frozenset([cause])), values=np.array([size * s])) for s in signs
    ]

    def each(value: float) -> dict[str, np.ndarray]:
        return {cause: np.full(DRAWS, value)}

    sizes, terms = each(size), [{cause: [(term, draw.values)]} for draw in draws]
    return Sampled(
        posterior, draws, terms, sizes, {cause: signs}, each(0.1), each(0.1), each(10.0), each(10.0),
        np.zeros(DRAWS), sizes[cause], np.ones((1, 1)),
    )  # fmt: skip


def sure(size: float) -> Finding:
    return Finding(CAUSE, 0.99, 0.99, size, 0.99, {}, (), "plant")


@pytest.mark.parametrize(("size", "word"), [(8.8, "explained"), (0.9, "none")])
def test_a_cause_that_identification_logs_hold_outweighs_a_channel_that_is_faint_in_the_others(
    size: float, word: str
) -> None:
    drawn = channel("plant", CAUSE, size, np.ones(DRAWS), between_rows=True)
    gap = Closed("plant", 1.9, 1.0, 0.99, 1.01, floor=1.0)
    assert verdict([sure(size)], [drawn], [gap], NEGLIGIBLE, otherwise_quiet=True).word == word


@pytest.mark.parametrize(("judged", "word"), [(True, "explained"), (False, "unknown")])
def test_what_stays_of_a_guessed_demand_is_left_to_the_closed_loop(judged: bool, word: str) -> None:
    drawn = channel("plant", CAUSE, 8.8, np.ones(DRAWS))
    guess = replace(
        channel("actuation", "torque_delay", 0.0, np.ones(DRAWS), between_rows=True), generic=np.full(DRAWS, 9.0)
    )
    gaps = [Closed("plant", 8.9, 1.1, 1.0, 1.2, floor=1.0), Closed("actuation", 9.0, 9.0, 8.9, 9.1, floor=1.0)]
    said = verdict([sure(8.8)], [drawn, guess], gaps, NEGLIGIBLE, otherwise_quiet=False, loop_judges=judged)
    assert said.word == word


@pytest.mark.parametrize(("unnamed", "word"), [(1.0, "unknown"), (0.5, "explained")])
def test_a_drive_that_does_what_has_no_name_is_not_told_as_an_error_within_its_tolerance(
    unnamed: float, word: str
) -> None:
    """A dead zone of 1.9 floors was a `controller_gain_error` with 0.89."""
    quiet = channel("plant", "torque_bias", 0.1, np.ones(DRAWS))
    drive = channel("actuation", ERROR, 1.5, np.ones(DRAWS))
    held = [frozenset(["family demand"] * (k < unnamed * DRAWS)) for k in range(DRAWS)]
    draws: Any = [SimpleNamespace(model=SimpleNamespace(effects=e), values=np.array([1.5])) for e in held]
    drive = replace(drive, draws=draws)
    gaps = [Closed("plant", 1.0, 1.0, 0.9, 1.1, floor=1.0), Closed("actuation", 1.9, 1.3, 1.2, 1.4, floor=1.0)]
    told = Finding(ERROR, 0.9, 0.9, 1.5, 0.99, {}, (), "actuation")
    assert verdict([told], [quiet, drive], gaps, NEGLIGIBLE, otherwise_quiet=False).word == word


@pytest.mark.parametrize(
    ("still", "along_nm", "word"), [(True, 1.2, "none"), (False, 1.2, "explained"), (True, 1.5, "explained")]
)
def test_a_cause_in_a_guess_is_none_where_nothing_shows_besides(still: bool, along_nm: float, word: str) -> None:
    """Gains that are right to 1 % were a `controller_gain_error` with 0.99 on a joint without a gap."""
    quiet = channel("plant", "torque_bias", 0.1, np.ones(DRAWS))
    guess = channel("actuation", CAUSE, 8.8, np.ones(DRAWS), between_rows=True)
    gaps = [Closed("plant", along_nm, 1.0, 0.9, 1.1, floor=1.0), Closed("actuation", 9.0, 1.1, 1.0, 1.2, floor=1.0)]
    said = verdict(
        [sure(8.8)], [quiet, guess], gaps, NEGLIGIBLE, otherwise_quiet=True, loop_judges=True, loop_still=still
    )
    assert said.word == word


@pytest.mark.parametrize(("quiet", "likely", "named"), [(False, 0.3, True), (True, 0.3, False), (False, 0.9, False)])
def test_a_faint_replay_between_rows_names_what_nobody_else_makes_of_the_closed_loop(
    quiet: bool, likely: float, named: bool
) -> None:
    drawn = [
        channel("plant", CAUSE, 1.0, np.ones(DRAWS)),
        channel("actuation", "torque_delay", 1.3, np.ones(DRAWS), between_rows=True),
    ]
    late = Finding("torque_delay", 0.99, 0.99, 1.3, 0.5, {}, (), "actuation")
    other = Finding(CAUSE, likely, likely, 1.0, 0.5, {}, (), "plant")
    gaps = [Closed("plant", 1.5, 1.0, 0.8, 1.0, floor=1.0), Closed("actuation", 1.7, 0.9, 0.8, 1.0, floor=1.0)]
    assert (late in _shown([late, other], drawn, gaps, quiet)) is named


@pytest.mark.parametrize(("after", "word"), [(1.1, "explained"), (1.75, "none")])
def test_a_sure_cause_within_noise_is_told_if_it_takes_half_of_the_gap(after: float, word: str) -> None:
    drawn = channel("plant", CAUSE, 0.95, np.ones(DRAWS))
    gap = Closed("plant", 1.99, after, after, after, floor=1.0)
    assert verdict([sure(0.95)], [drawn], [gap], NEGLIGIBLE, otherwise_quiet=True).word == word


@pytest.mark.parametrize(("fitted", "word"), [(1.9, "none"), (3.5, "unknown")])
def test_a_gap_that_only_the_identification_logs_show_is_not_none(fitted: float, word: str) -> None:
    """Play of 3.4 floors was none, because the validation logs hardly came to it."""
    drawn = channel("plant", CAUSE, 0.1, np.ones(DRAWS))
    gap = Closed("plant", 1.2, 1.2, 1.1, 1.3, floor=1.0, fitted=fitted)
    assert verdict([], [drawn], [gap], NEGLIGIBLE, otherwise_quiet=True).word == word


@pytest.mark.parametrize(("reaches", "word"), [(False, "explained"), (True, "none")])
def test_a_cause_that_the_validation_logs_never_come_to_is_told_all_the_same(reaches: bool, word: str) -> None:
    """A saturation of 19 floors, which only a fast log came to, was no help on slow ones."""
    drawn = channel("plant", CAUSE, 8.8, np.ones(DRAWS))
    told = [SimpleNamespace(x=np.full((50, 1), 1.0), validation=False)]
    told += [SimpleNamespace(x=np.full((50, 1), float(reaches)), validation=True)]
    channel_with: Any = SimpleNamespace(**{**vars(drawn.posterior.channel), "logs": told})
    posterior: Any = SimpleNamespace(**{**vars(drawn.posterior), "channel": channel_with})
    drawn = replace(drawn, posterior=posterior)
    assert unreached(sure(8.8), [drawn]) is not reaches
    gap = Closed("plant", 1.1, 1.1, 1.0, 1.2, floor=1.0)
    assert verdict([sure(8.8)], [drawn], [gap], NEGLIGIBLE, otherwise_quiet=True).word == word


@pytest.mark.parametrize("above", [0.5, 0.7, 0.8, 0.2, 1.0])
def test_an_error_is_listed_where_the_draws_agree_on_its_sign(above: float) -> None:
    signs = np.where(np.arange(DRAWS) < above * DRAWS, 1.0, -1.0)
    found = findings([channel("plant", ERROR, 3.0, signs)])
    assert [f.effect for f in found] == ([ERROR] if max(above, 1.0 - above) >= SIDED else [])


def test_the_cause_that_is_likelier_to_be_the_largest_comes_first() -> None:
    """In seven draws of ten the other one is smaller; in the rest it is so large that it makes more on average."""
    steady = channel("plant", CAUSE, 3.0, np.ones(DRAWS))
    other = channel("actuation", "torque_delay", 2.5, np.ones(DRAWS))
    rarely = {"torque_delay": np.where(np.arange(DRAWS) < 0.3 * DRAWS, 9.0, 2.5)}
    found = findings([steady, replace(other, sizes=rarely)])
    assert [f.effect for f in found] == [CAUSE, "torque_delay"] and found[1].size > found[0].size


def test_what_is_no_error_of_the_belief_has_no_sides() -> None:
    signs = np.where(np.arange(DRAWS) % 2, 1.0, -1.0)
    assert [f.effect for f in findings([channel("plant", CAUSE, 3.0, signs)])] == [CAUSE]


@pytest.mark.parametrize(
    ("before", "needs", "small", "word"),
    [(4.0, 0.0, True, "none"), (6.0, 0.0, True, "unknown"), (4.0, 0.1, True, "unknown"), (4.0, 0.0, False, "unknown")],
)
def test_a_small_gap_that_tolerances_make_is_none_where_hardly_a_draw_needs_a_cause(
    before: float, needs: float, small: bool, word: str
) -> None:
    """A healthy joint of another friction law, 1 % of the friction off, was `unknown`."""
    drawn = channel("plant", ERROR, 0.1, np.ones(DRAWS))
    models = [frozenset(["family time"] if k < needs * DRAWS else []) for k in range(DRAWS)]
    draws: Any = [SimpleNamespace(model=SimpleNamespace(effects=m), values=np.zeros(1)) for m in models]
    drawn = replace(drawn, draws=draws)
    gap = Closed("plant", before, 1.0, 0.9, 1.1, floor=1.0)
    assert verdict([], [drawn], [gap], 10.0, otherwise_quiet=False, small=small).word == word


@pytest.mark.parametrize(
    ("before", "share", "word"), [(1.2, 0.7, "none"), (1.2, 0.96, "explained"), (1.6, 0.7, "explained")]
)
def test_a_cause_that_some_draws_do_without_is_none_where_no_gap_shows(before: float, share: float, word: str) -> None:
    drawn = channel("plant", CAUSE, 1.05, np.ones(DRAWS))
    without: Any = SimpleNamespace(model=SimpleNamespace(effects=frozenset()), values=np.zeros(1))
    drawn = replace(drawn, draws=[d if k < share * DRAWS else without for k, d in enumerate(drawn.draws)])
    cause = Finding(CAUSE, share, share, 1.05, share, {}, (), "plant")
    gap = Closed("plant", before, 0.9, 0.8, 1.0, floor=1.0)
    assert verdict([cause], [drawn], [gap], 0.0, otherwise_quiet=True).word == word
