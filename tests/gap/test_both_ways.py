"""What one cause alone takes off recordings that did not fit it, and when it is named for that."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from frictid_hil.gap.both_ways import FAIR_SHARE, both_ways, half_of_it
from frictid_hil.gap.channel import FAMILY, Channel, Rows, Term
from frictid_hil.gap.diagnose import _half_of_it
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.how_far import Closed
from frictid_hil.gap.verdict import DOUBTED, TIED, Verdict

ROWS, STEP_S = 4000, 0.01
LOAD, LEVEL, RIPPLE = "load_dependent_friction", "friction_level_error", "viscous_nonlinearity"


def term(effect: str, column: int, deviation: float = 1.0, mean: float = 0.0) -> Term:
    return Term(effect, {}, (column,), np.array([mean]), np.array([deviation]))


def channel(
    made: dict[bool, np.ndarray],  # what is in the residual of each role beside white noise: strengths of the columns
    *,
    alike: float = 0.0,  # correlation of the second column with the first
    nuisances: tuple[Term, ...] = (),
) -> Channel:
    """Two roles of one log each, three columns; the third is what has no name. 10 is the size of all."""
    random, logs = np.random.default_rng(7), []
    for role, strengths in made.items():
        x = random.standard_normal((ROWS, 3))
        x[:, 1] = alike * x[:, 0] + np.sqrt(1.0 - alike**2) * x[:, 1]
        y = x @ strengths + 0.01 * random.standard_normal(ROWS)
        logs.append(Rows(f"log {role}", role, 0.0, y, x, np.zeros(ROWS), np.ones(ROWS, dtype=bool)))
    candidates = (term(LOAD, 0, 10.0), term(RIPPLE, 1, 10.0), term(FAMILY + "position", 2, 10.0))
    return Channel("plant", STEP_S, tuple(logs), nuisances, candidates, 1.0, 20.0)


def both(*strengths: float) -> dict[bool, np.ndarray]:
    return {role: np.array(strengths) for role in (False, True)}


def taken_both_ways(one: Channel) -> dict[str, float]:
    return {effect: fit.taken for effect, fit in both_ways(one).items()}


def named(found: list[Finding], one: Channel) -> list[str]:
    return [half.cause.effect for half in half_of_it(found, posterior(one))]


def posterior(one: Channel) -> Any:
    return SimpleNamespace(channel=one, floor=0.01)


def finding(effect: str, chance: float = 0.9) -> Finding:
    return Finding(effect, chance, chance, 2.0, 0.9, {"share": Value(0.1, 0.05, 0.15)}, (), "plant")


def test_a_cause_takes_off_its_part_of_the_power_whatever_the_rest_is() -> None:
    taken = taken_both_ways(channel(both(1.3, 0.0, 1.0)))
    assert taken[LOAD] == pytest.approx(1.0 - 1.0 / np.hypot(1.3, 1.0), abs=0.03)
    assert taken[RIPPLE] == pytest.approx(0.0, abs=0.02)
    assert taken[FAMILY + "position"] == pytest.approx(1.0 - 1.3 / np.hypot(1.3, 1.0), abs=0.03)


def test_what_one_role_alone_holds_is_taken_off_one_way_and_put_on_the_other() -> None:
    only_judged = {False: np.array([0.0, 0.0, 1.0]), True: np.array([3.0, 0.0, 1.0])}
    assert taken_both_ways(channel(only_judged))[LOAD] < 0.05
    opposite = {False: np.array([-2.0, 0.0, 1.0]), True: np.array([2.0, 0.0, 1.0])}
    assert taken_both_ways(channel(opposite))[LOAD] < -0.5


def test_a_tolerance_hides_another_cause_and_not_the_error_that_it_is_of() -> None:
    made = both(1.5, 0.0, 1.0)
    other = taken_both_ways(channel(made, nuisances=(term(LEVEL, 0, 3.0),)))
    assert other[LOAD] == pytest.approx(0.0, abs=0.02)
    own = taken_both_ways(channel(made, nuisances=(term(LOAD, 0, 3.0),)))
    assert own[LOAD] > 0.4


def test_a_cause_far_beyond_its_prior_is_not_taken_for_what_it_may_not_be() -> None:
    """The residual is slow, so that its rows tell little: a tolerance is worth more than a few of them."""
    narrow = replace(channel(both(1.5, 0.0, 1.0)), candidates=(term(LOAD, 0, 0.05),))
    assert taken_both_ways(narrow)[LOAD] < 0.15


def test_a_cause_beyond_its_bounds_is_another_one() -> None:
    made = channel(both(-1.5, 0.0, 1.0))
    losses = replace(made, candidates=(replace(made.candidates[0], least=0.0, largest=np.inf), *made.candidates[1:]))
    assert taken_both_ways(made)[LOAD] > 0.4 and taken_both_ways(losses)[LOAD] == 0.0


def test_a_shape_of_more_columns_has_to_be_worth_them() -> None:
    one = channel(both(1.5, 0.0, 1.0))
    richer = replace(
        one.candidates[0], shape={"quadratic": 1.0}, columns=(0, 1), mean=np.zeros(2), deviation=np.ones(2)
    )
    assert both_ways(replace(one, candidates=(richer, *one.candidates)))[LOAD].term is one.candidates[0]


def test_the_error_of_a_stated_stiffness_is_no_effect_of_its_own() -> None:
    one = channel(both(1.5, 0.0, 1.0))
    stiffness = replace(one.candidates[0], effect="presliding_hysteresis", shape={"stiffness": 1.0})
    assert "presliding_hysteresis" not in both_ways(replace(one, candidates=(stiffness, *one.candidates)))


def test_logs_without_noise_and_columns_that_are_one_and_the_same_are_no_obstacle() -> None:
    one = replace(channel(both(1.5, 0.0, 0.0)), nuisances=(term(LEVEL, 2, 1.0),))
    exact = replace(one, logs=tuple(replace(log, y=1.5 * log.x[:, 0], x=log.x[:, [0, 0, 2]]) for log in one.logs))
    assert taken_both_ways(exact)[LOAD] == pytest.approx(1.0, abs=1e-3)
    silent = replace(exact, logs=(exact.logs[0], replace(exact.logs[1], y=np.zeros(ROWS))))
    assert taken_both_ways(silent) == {}


def test_recordings_of_one_role_say_nothing_both_ways() -> None:
    one = channel(both(1.3, 0.0, 1.0))
    alone = replace(one, logs=one.logs[:1])
    assert taken_both_ways(alone) == {} and named([finding(LOAD)], alone) == []


@pytest.mark.parametrize(("strength", "told"), [(1.2, [LOAD]), (0.8, [])])
def test_a_cause_is_named_from_half_of_the_power_on(strength: float, told: list[str]) -> None:
    assert pytest.approx(0.293, abs=0.001) == FAIR_SHARE
    assert named([finding(LOAD)], channel(both(strength, 0.0, 1.0))) == told


def test_its_numbers_and_what_stays_are_those_of_the_fit() -> None:
    (half,) = half_of_it([finding(LOAD)], posterior(channel(both(1.5, 0.0, 1.0))))
    told = half.cause.parameters["linear_share"]
    assert told.value == pytest.approx(1.5, rel=0.05)
    assert told.low is not None and told.high is not None and told.low < 1.5 < told.high
    assert half.gap.before == pytest.approx(np.hypot(1.5, 1.0), rel=0.05)
    assert half.gap.after == pytest.approx(1.0, rel=0.05)
    assert half.gap.low < half.gap.after < half.gap.high


def test_causes_that_least_squares_cannot_tell_apart_tie_and_the_likelier_comes_first() -> None:
    alike = channel(both(1.5, 0.0, 0.8), alike=0.999)
    assert named([finding(LOAD, 0.3), finding(RIPPLE, 0.9)], alike) == [RIPPLE, LOAD]
    assert named([finding(LOAD, 0.9), finding(RIPPLE, 0.1)], alike) == [LOAD]


def test_a_likely_cause_is_not_named_where_an_unlikely_one_takes_off_more() -> None:
    made = channel(both(2.0, 0.0, 1.0), alike=0.9)
    assert named([finding(RIPPLE)], made) == []


def test_a_cause_is_not_named_where_functions_without_a_name_take_off_more() -> None:
    made = both(1.5, 0.0, 1.0)
    one = channel(made)
    curve = replace(one.candidates[2], columns=(0, 2), mean=np.zeros(2), deviation=np.full(2, 10.0))
    assert named([finding(LOAD)], one) == [LOAD]
    assert named([finding(LOAD)], replace(one, candidates=(*one.candidates[:2], curve))) == []


NONE_SAID = Verdict("unknown", (), "plant: position")


def joint(left_nm: dict[str, float] | None) -> Any:
    """A joint whose closed loop, if there is one, has a gap of 1 and leaves so much of it with each cause."""
    if left_nm is None:
        return SimpleNamespace(simulation=None)
    return SimpleNamespace(
        simulation=SimpleNamespace(bare={}, noise_nm=0.1, gap_nm=lambda effects: left_nm[next(iter(effects))])
    )


def reading(found: list[Finding], one: Channel) -> Any:
    return SimpleNamespace(found=found, sought=(), channels=[SimpleNamespace(posterior=posterior(one))])


@pytest.mark.parametrize(("left_nm", "word"), [(None, "explained"), ({LOAD: 0.45}, "explained"), ({LOAD: 0.55}, None)])
def test_the_closed_loop_has_to_bear_it_out(
    left_nm: dict[str, float] | None, word: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("frictid_hil.gap.diagnose.pooled", lambda bare, what: 1.0)
    gaps = [Closed("plant", 3.0, 3.0, 2.0, 4.0, 1.0)]
    said = _half_of_it(joint(left_nm), reading([finding(LOAD, 0.99)], channel(both(1.5, 0.0, 1.0))), NONE_SAID, gaps)
    assert (said[0].word if said is not None else None) == word
    if said is not None:
        assert [(f.effect, f.confidence) for f in said[0].named] == [(LOAD, DOUBTED)]
        assert said[1][0].after < 0.7 * said[1][0].before


def test_two_that_tie_are_ambiguous_and_each_says_so_of_the_other() -> None:
    alike = channel(both(1.5, 0.0, 0.8), alike=0.999)
    both_told = [finding(LOAD, 0.9), finding(RIPPLE, 0.8)]
    said = _half_of_it(joint(None), reading(both_told, alike), NONE_SAID, [])
    assert said is not None and said[0].word == "ambiguous"
    assert [(f.effect, f.rivals) for f in said[0].named] == [(LOAD, (RIPPLE,)), (RIPPLE, (LOAD,))]
    assert {f.confidence for f in said[0].named} == {TIED}


def test_a_doubtful_cause_is_not_told_for_being_half_of_the_gap() -> None:
    made = channel(both(1.5, 0.0, 1.0))
    assert _half_of_it(joint(None), reading([finding(LOAD, 0.4)], made), NONE_SAID, []) is None


def test_what_shows_in_the_drive_is_no_cause_of_the_joint() -> None:
    made = reading([finding(LOAD)], channel(both(1.5, 0.0, 1.0)))
    plant, drive = Closed("plant", 3.0, 3.0, 2.0, 4.0, 1.0), Closed("actuation", 9.0, 9.0, 8.0, 10.0, 1.0)
    assert _half_of_it(joint(None), made, NONE_SAID, [plant, drive]) is None
    assert _half_of_it(joint(None), made, Verdict("unknown", (), "actuation: time"), [plant]) is None


def test_what_is_explained_already_stays() -> None:
    made = reading([finding(LOAD)], channel(both(1.5, 0.0, 1.0)))
    for word in ("none", "explained", "ambiguous"):
        assert _half_of_it(joint(None), made, Verdict(word, ()), []) is None
