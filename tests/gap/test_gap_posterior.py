"""The posterior on joints whose fault is known: what it names, how large, and what it does without the right cause."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap import noise
from frictid_hil.gap.channel import FAMILY, Channel, Rows, Term
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.findings import (
    ABSENT,
    DRAWS,
    Finding,
    _beyond,
    _chances,
    _confidence,
    _nearest,
    _opposed,
    _ways,
    findings,
    parameters,
    sampled,
)
from frictid_hil.gap.gaussian import integrated, put_inside
from frictid_hil.gap.plainest import _equal, plainest
from frictid_hil.gap.plant_channel import plant_channel
from frictid_hil.gap.posterior import VISIBLE, Draw, Posterior, by_term
from frictid_hil.gap.residuals import recordings
from frictid_hil.gap.tolerances import Sigma
from frictid_hil.simulation.effects import all_effects


def _found(effects: dict[str, dict[str, float]]) -> list[Finding]:
    experiments = gap_sets.make(effects)
    channel = plant_channel(experiments.nominal, recordings(experiments), list(all_effects()), ())
    assert channel is not None
    return findings([sampled(Posterior(channel, len(all_effects())))])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "parameter", "value"),
    [("direction_asymmetry", "coulomb_share", 0.06), ("gravity_error", "error_share", 0.12)],
)
def test_a_cause_comes_first_with_an_interval_that_holds_it(effect: str, parameter: str, value: float) -> None:
    first = _found({effect: {parameter: value}})[0]
    assert first.effect == effect and first.chance > 0.9
    told = first.parameters[parameter]
    assert told.low is not None and told.high is not None
    assert told.low - 0.05 * value < value < told.high + 0.05 * value


@pytest.mark.slow
def test_a_belief_far_beyond_its_tolerance_is_wrong_and_no_other_form_of_friction() -> None:
    tight = replace(gap_sets.NOMINAL.tolerances, viscous=Sigma(0.005, 0.0, "stated"))
    experiments = gap_sets.make({"viscous_error": {"error_share": -0.4}}, replace(gap_sets.NOMINAL, tolerances=tight))
    first = diagnose(experiments).causes[0]
    assert first.effect == "viscous_error" and first.confidence > 0.9
    assert first.parameters["error_share"].value == pytest.approx(-0.4, abs=0.1)


def test_what_may_not_be_drawn_is_made_up_for_by_what_is_like_it() -> None:
    root = np.linalg.cholesky(np.array([[1.0, -0.9, 0.0], [-0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    told = put_inside(np.array([-3.0, 3.0, 0.5]), root, np.array([0, 2]), np.array([-1.0, -np.inf]), np.full(2, 9.0))
    # The two are nearly one cause with opposite signs: the second gives back what the first may not make.
    np.testing.assert_allclose(told, [-1.0, 3.0 - 0.9 * 2.0, 0.5])


@pytest.mark.parametrize(("loss", "first"), [((0.3, 0.1), "directional_efficiency"), ((0.3, -0.26), "inertia_error")])
def test_a_gear_returns_no_more_than_it_is_given(loss: tuple[float, float], first: str) -> None:
    """An inertia a fifth off was a gear that lost a share of the load when driving, and gained it when driven back."""
    random = np.random.default_rng(4)
    time = np.linspace(0.0, 60.0, 1600)
    load, motion = np.sin(2.0 * time), np.sign(np.sin(3.1 * time))
    driving = load * motion >= 0.0
    own = np.stack([motion * np.abs(load) * driving, motion * np.abs(load) * ~driving], axis=1)
    columns = np.column_stack([own, load])
    logs = [
        Rows(name, judged, 0.0, own @ loss + 0.05 * random.standard_normal(1600), columns, np.zeros(1600), load < 9.0)
        for name, judged in (("known", False), ("judged", True))
    ]
    form = all_effects()["directional_efficiency"].inverse
    assert form is not None
    gear = Term("directional_efficiency", {}, (0, 1), np.zeros(2), np.ones(2), *form.bounds, form.bounded)
    inertia = Term("inertia_error", {}, (2,), np.zeros(1), np.ones(1))
    posterior = Posterior(Channel("plant", 0.04, tuple(logs), (), (gear, inertia), 1.0, 10.0), 20)
    told = findings([sampled(posterior)])[0]
    assert told.effect == first and told.chance > 0.9
    if first == gear.effect:
        found = [told.parameters[name].value for name in ("driving_share", "backdriving_share")]
        assert found == pytest.approx(loss, abs=0.02)


@pytest.mark.parametrize("strength", [0.02, 30.0])
def test_two_shapes_of_a_whole_cause_are_that_cause_once(strength: float) -> None:
    """Where the recordings hardly show it, too: told twice, it would be as large again in the validation logs."""
    random = np.random.default_rng(3)
    near = random.standard_normal(800)
    shapes = np.column_stack([near, near + 0.05 * random.standard_normal(800)]) * strength
    logs = []
    for k, validation in enumerate((False, False, True)):
        y = shapes.mean(axis=1) + 0.1 * random.standard_normal(800)
        logs.append(Rows(str(k), validation, 0.0, y, shapes, np.zeros(800), np.ones(800, dtype=bool)))
    candidates = [
        Term("torque_saturation", {"limit_share": value}, (k,), np.ones(1), np.full(1, 0.1))
        for k, value in enumerate((0.3, 0.31))
    ]
    posterior = Posterior(Channel("actuation", 0.01, tuple(logs), (), tuple(candidates), 1.0, 20.0), 20)
    assert float(np.sum(posterior.fitted((0, 1)))) == pytest.approx(1.0, abs=0.2)
    assert float(np.sum(posterior.fitted((0,)))) == pytest.approx(1.0, abs=0.2)


def _curves() -> tuple[Posterior, np.ndarray]:
    """A channel with the level of friction as a belief, a Stribeck and a bent curve as causes, a function of time."""
    random = np.random.default_rng(5)
    speed = np.abs(np.sin(np.linspace(0.0, 40.0, 1600)))
    of_time = np.sin(np.linspace(0.0, 3.0, 1600))
    columns = np.stack([1.0 + 0.2 * speed, np.exp(-speed / 0.2), np.log1p(speed / 0.06), of_time], axis=1)
    log = Rows("log", False, 0.0, random.standard_normal(1600), columns, np.zeros(1600), np.ones(1600, dtype=bool))
    stated = Term("friction_level_error", {}, (0,), np.zeros(1), np.full(1, 0.05))
    candidates = [
        replace(stated, deviation=np.full(1, 0.3)),
        Term("stribeck", {"stribeck_velocity_rad_s": 0.2, "exponent": 1.0}, (1,), np.zeros(1), np.ones(1)),
        Term("viscous_nonlinearity", {"knee_rad_s": 0.06, "bend": 0.0}, (2,), np.zeros(1), np.ones(1)),
        Term(FAMILY + "time", {"size": 1.0}, (3,), np.zeros(1), np.ones(1)),
    ]
    channel = Channel("plant", 0.01, (log,), (stated,), tuple(candidates), 1.0, 20.0)
    return Posterior(channel, 20), columns


def test_curves_that_cancel_into_an_error_of_the_believed_curve_are_that_error() -> None:
    posterior, columns = _curves()
    gram = columns.T @ columns / columns.shape[0]
    curves = np.linalg.lstsq(columns[:, 1:3], columns[:, 0], rcond=None)[0]
    draw = Draw(posterior.model((1, 2)), 0, np.array([-0.85, *curves]))
    told = plainest(posterior, draw, gram)
    assert told.model.effects == {"friction_level_error"}
    assert told.values == pytest.approx([0.15, 0.0], abs=0.02)
    # Nothing is lost: what the error leaves is there, without a name.
    made = [np.zeros(4), np.zeros(4)]
    for one, sums in zip((draw, told), made, strict=True):
        for numbers, values in posterior.contributions(one).values():
            np.add.at(sums, numbers, values)
    np.testing.assert_allclose(made[0], made[1])


@pytest.mark.parametrize(("times", "unnamed", "told"), [(1.0, 0.0, True), (40.0, 0.0, False), (40.0, 9.0, True)])
def test_what_curves_leave_of_an_error_is_no_more_than_is_hidden_or_has_no_name(
    times: float, unnamed: float, told: bool
) -> None:
    """A tenth of a large curve would show, unless the joint is as far off its forms elsewhere."""
    posterior, columns = _curves()
    gram = columns.T @ columns / columns.shape[0]
    curves = np.linalg.lstsq(columns[:, 1:3], columns[:, 0], rcond=None)[0] * times
    draw = Draw(posterior.model((1, 2, 3)), 0, np.array([-0.85 * times, *curves, unnamed]))
    assert ("stribeck" not in plainest(posterior, draw, gram).model.effects) is told


@pytest.mark.parametrize(("backdriving", "told"), [(0.8, "load_dependent_friction"), (0.3, "directional_efficiency")])
def test_a_gear_that_loses_about_as_much_either_way_has_a_friction_with_the_load(backdriving: float, told: str) -> None:
    random = np.random.default_rng(6)
    load, driving = np.abs(random.standard_normal(1600)), np.arange(1600) % 2 == 0
    columns = np.stack([load * driving, load * ~driving, load, random.standard_normal(1600)], axis=1)
    log = Rows("log", False, 0.0, random.standard_normal(1600), columns, np.zeros(1600), np.ones(1600, dtype=bool))
    candidates = (
        Term("directional_efficiency", {}, (0, 1), np.zeros(2), np.ones(2), 0.0, np.inf, 2),
        Term("load_dependent_friction", {"quadratic": 0.0}, (2,), np.zeros(1), np.ones(1)),
        Term("torque_ripple", {"first": 1.0}, (3,), np.zeros(1), np.ones(1)),
    )
    posterior = Posterior(Channel("plant", 0.01, (log,), (), candidates, 1.0, 20.0), 20)
    draw = Draw(posterior.model((0, 2)), 0, np.array([1.0, backdriving, 0.5]))
    plain = plainest(posterior, draw, columns.T @ columns / columns.shape[0])
    assert plain.model.effects == {told, "torque_ripple"}
    made = [np.zeros(1600), np.zeros(1600)]
    for k, one in enumerate((draw, plain)):
        for numbers, values in posterior.contributions(one).values():
            made[k] += columns[:, numbers] @ values
    np.testing.assert_allclose(made[0], made[1])
    if told == "load_dependent_friction":
        assert plain.values == pytest.approx([0.9, 0.5], abs=0.02)


def test_a_gear_that_carries_no_load_has_no_parts_to_compare() -> None:
    columns = np.zeros((400, 3))
    log = Rows(
        "log", False, 0.0, np.random.default_rng(6).standard_normal(400), columns, np.zeros(400), np.ones(400, bool)
    )
    candidates = (
        Term("directional_efficiency", {}, (0, 1), np.zeros(2), np.ones(2), 0.0, np.inf, 2),
        Term("load_dependent_friction", {"quadratic": 0.0}, (2,), np.zeros(1), np.ones(1)),
    )
    posterior = Posterior(Channel("plant", 0.01, (log,), (), candidates, 1.0, 20.0), 20)
    draw = Draw(posterior.model((0,)), 0, np.array([1.0, 1.0]))
    assert plainest(posterior, draw, np.zeros((3, 3))) is draw


def test_of_equal_parts_no_more_is_sure_than_the_form_of_what_is_plainer_tells() -> None:
    chances = [_equal(off**2) for off in (0.0, 0.1, 0.2, 0.4)]
    assert chances == pytest.approx([0.85, 0.77, 0.43, 0.002], abs=0.01)


def test_a_curve_that_nothing_cancels_keeps_its_name() -> None:
    posterior, columns = _curves()
    draw = Draw(posterior.model((2,)), 0, np.array([0.01, 0.3]))
    assert plainest(posterior, draw, columns.T @ columns / columns.shape[0]) is draw


def test_a_whitened_row_is_white_and_of_unit_size() -> None:
    random = np.random.default_rng(0)
    red = np.convolve(random.standard_normal(20_000), 0.8 ** np.arange(40), mode="valid")
    white, _ = noise.whitened(red[:, None], noise.autocovariance([red]))
    rest = white[:, 0]
    assert abs(float(np.std(rest)) - 1.0) < 0.03
    assert abs(float(rest[1:] @ rest[:-1]) / rest.size) < 0.03


@pytest.mark.slow
def test_a_healthy_joint_is_none_and_a_payload_in_validation_alone_is_no_cause_of_the_library() -> None:
    assert diagnose(gap_sets.make()).verdict == "none"
    made = gap_sets.make(only=("sines_small", "sines_large", "moves_payload"))
    heavier = [
        replace(e, torque_nm=e.torque_nm + 3.0 * e.validation * np.cos(e.position_rad)) for e in made.experiments
    ]
    found = diagnose(replace(made, experiments=tuple(heavier)))
    assert found.verdict == "unknown" and "moves_payload" in found.reasons["validation"]


@pytest.mark.slow
def test_a_limit_that_validation_logs_never_reach_is_no_all_clear() -> None:
    made = gap_sets.make({"torque_saturation": {"limit_share": 0.24}}, only=("sines_large", "chirp", "triangle_slow"))
    judged = [replace(e, validation=e.name == "triangle_slow") for e in made.experiments]
    found = diagnose(replace(made, experiments=tuple(judged)))
    assert found.verdict != "none" and found.causes[0].effect == "torque_saturation"


def test_columns_that_are_alike_and_very_well_known_are_integrated_out() -> None:
    random = np.random.default_rng(0)
    wide = 1e9 * random.standard_normal((400, 5))
    alike = wide[:, :3] + 1e-4 * random.standard_normal((400, 3))
    table = np.concatenate([wide, alike, random.standard_normal((400, 2))], axis=1)
    left, gain = integrated(table.T @ table, np.arange(8), np.array([8, 9]))
    assert np.isfinite(gain) and np.all(np.diag(left) > 0.0)


def test_shapes_that_oppose_each_other_are_told_as_the_one_nearest_to_their_sum() -> None:
    speed = np.linspace(0.01, 1.0, 400)
    shapes = [{"knee_rad_s": knee, "bend": 0.0} for knee in (0.05, 0.1, 0.2, 0.4)]
    table = np.stack([np.log1p(speed / shape["knee_rad_s"]) for shape in shapes], axis=1)
    terms = [Term("viscous_nonlinearity", shape, (k,), np.zeros(1), np.ones(1)) for k, shape in enumerate(shapes)]
    channel: Any = SimpleNamespace(
        gram=table.T @ table / speed.size, posterior=SimpleNamespace(channel=SimpleNamespace(candidates=terms))
    )
    found = [(terms[0], np.array([2.0])), (terms[3], np.array([-0.5]))]
    assert _opposed(found) and not _opposed(found[:1])
    term, values = _nearest("viscous_nonlinearity", channel, found)
    together = table[:, 0] * 2.0 - table[:, 3] * 0.5
    told = table[:, terms.index(term)] * values[0]
    assert np.std(together - told) < 0.1 * np.std(together)


def test_lines_over_position_are_read_each_by_its_own_coefficients() -> None:
    lines = [{"first": 3.0}, {"first": 12.0, "second": 24.0}, {"first": 5.0}]
    columns = [(0, 1), (2, 3, 4, 5), (6, 7)]
    terms = [
        Term("torque_ripple", s, c, np.zeros(len(c)), np.ones(len(c))) for s, c in zip(lines, columns, strict=True)
    ]
    posterior = SimpleNamespace(channel=SimpleNamespace(name="plant", of_the_joint=True))
    two = np.array([0.1, 0.0, 2.0, 0.0, 0.0, 1.0, 0.2, 0.0])
    one = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0])
    held = [{"torque_ripple": by_term(terms, values)} for values in (two, one)]
    channel: Any = SimpleNamespace(posterior=posterior, held=held)
    told = parameters("torque_ripple", channel, 0)
    assert sorted(v for name, v in told.items() if name.endswith("amplitude_nm")) == [1.0, 2.0]
    told = parameters("torque_ripple", channel, 1)
    assert next(v for name, v in told.items() if name.endswith("amplitude_nm")) == 0.2


def test_two_delays_that_pull_the_same_way_are_one_between_them() -> None:
    terms = [Term("torque_delay", {"delay_s": s}, (k,), np.ones(1), np.ones(1)) for k, s in enumerate((0.02, 0.04))]
    posterior = SimpleNamespace(channel=SimpleNamespace(name="tracking", of_the_joint=False))
    held = [{"torque_delay": by_term(terms, np.array([0.5, 0.5]))}]
    channel: Any = SimpleNamespace(posterior=posterior, held=held)
    assert parameters("torque_delay", channel, 0) == pytest.approx({"delay_s": 0.03})


@pytest.mark.parametrize(("believed", "blur"), [(0.2, 1.0), (1.0, 1.0), (4.0, 1.0), (1.0, 0.3)])
def test_the_chance_of_a_blurred_error_is_the_share_of_drawn_ones_that_show(believed: float, blur: float) -> None:
    rng = np.random.default_rng(5)
    true = believed * rng.normal(size=2_000_000)
    seen = true + blur * rng.normal(size=true.size)
    for size in (0.1, 0.6, 1.2):
        alike = true[np.abs(seen - size) < 0.02]
        parts = _chances(*(np.full(DRAWS, value) for value in (size, blur, believed)))
        told, other, absent = (np.mean(part) for part in parts)
        assert told == pytest.approx(np.mean(alike > VISIBLE), abs=0.02)
        assert other == pytest.approx(np.mean(alike < -VISIBLE), abs=0.02)
        assert absent == pytest.approx(np.mean(np.abs(alike) < ABSENT), abs=0.02)


@pytest.mark.parametrize(("believed", "lent"), [(0.3, 0.2), (1.0, 0.3)])
def test_a_confidence_is_the_share_of_right_names_among_the_right_and_the_wrong_ones(
    believed: float, lent: float
) -> None:
    """What neither shows nor is absent counts for neither."""
    rng = np.random.default_rng(6)
    true = believed * rng.normal(size=2_000_000)
    seen = true + lent * rng.normal(size=true.size)
    nuisance = Term("inertia_error", {}, (0,), np.zeros(1), np.ones(1))
    posterior = SimpleNamespace(chance=0.1, channel=SimpleNamespace(nuisances=(nuisance,)))
    for size in (0.3, 0.5, 0.8):
        alike = np.abs(true[np.abs(seen - size) < 0.02])
        right, wrong = np.mean(alike > VISIBLE), np.mean(alike < ABSENT)
        figures = {"sizes": size, "blurs": 9.0, "lent": lent, "tolerated": believed, "believed": believed}
        every = {name: {"inertia_error": np.full(DRAWS, value)} for name, value in figures.items()}
        channel: Any = SimpleNamespace(posterior=posterior, **every)
        assert _confidence("inertia_error", [channel]) == pytest.approx(right / (right + wrong), abs=0.03)


@pytest.mark.parametrize(("tolerated", "believed", "lent"), [(0.0, 4.0, 0.5), (0.3, 3.0, 0.5), (1.0, 4.0, 0.2)])
def test_the_chance_beyond_a_tolerance_is_the_share_of_drawn_ones(
    tolerated: float, believed: float, lent: float
) -> None:
    rng, prior = np.random.default_rng(5), 0.1
    beyond = rng.random(4_000_000) < prior
    seen = np.where(beyond, np.hypot(believed, lent), np.hypot(tolerated, lent)) * rng.normal(size=beyond.size)
    for size in (0.1, 1.2, 1.8):
        found = _beyond(np.full(1, size), np.full(1, lent), np.full(1, tolerated), np.full(1, believed), prior)
        assert found == pytest.approx(np.mean(beyond[np.abs(seen - size) < 0.02]), abs=0.03)


@pytest.mark.parametrize(("alike", "ways"), [(0.0, 4.0), (1.0, 1.0)])
def test_columns_that_move_apart_are_as_many_ways_as_they_are_and_equal_ones_are_one(alike: float, ways: float) -> None:
    candidates = [Term(name, {}, (k,), np.zeros(1), np.ones(1)) for k, name in enumerate(("a", "b", "c", "d"))]
    nameless = Term(FAMILY + "speed", {}, (4,), np.zeros(1), np.ones(1))
    posterior: Any = SimpleNamespace(channel=SimpleNamespace(candidates=[*candidates, nameless]))
    size = np.array([1.0, 2.0, 3.0, 4.0, 9.0])
    gram = (np.eye(5) + alike * (1.0 - np.eye(5))) * size[:, None] * size
    assert _ways(posterior, gram) == pytest.approx(ways)


def test_what_the_forms_of_others_may_have_made_is_no_error_beyond_its_tolerance() -> None:
    size, blur = np.full(DRAWS, 0.3), np.full(DRAWS, 3.0)
    narrow, wide = (sum(np.mean(c) for c in _chances(size, blur, np.full(DRAWS, s))[:2]) for s in (0.1, 10.0))
    assert narrow < 0.01 < 0.8 < wide


@pytest.mark.parametrize(("mean", "deviation"), [(0.0, 2.0), (1.0, 0.1)])
def test_a_cause_is_believed_to_show_at_its_strength_and_what_that_may_be_off(mean: float, deviation: float) -> None:
    """A cause whose shape holds its number has strength one: a motor that lost 30 % of its torque did so as a whole."""
    random = np.random.default_rng(4)
    shape = random.standard_normal((600, 1))
    y = shape[:, 0] + 0.1 * random.standard_normal(600)
    logs = [Rows(str(k), k == 2, 0.0, y, shape, np.zeros(600), np.ones(600, dtype=bool)) for k in range(3)]
    term = Term("torque_saturation", {"limit_share": 0.3}, (0,), np.full(1, mean), np.full(1, deviation))
    posterior = Posterior(Channel("actuation", 0.01, tuple(logs), (), (term,), 1.0, 20.0), 20)
    draw = posterior.draws(posterior.search(), 1)[0]
    drawn = mean + deviation * random.standard_normal(100_000)
    tolerated, found = posterior.believed(draw, np.full(1, np.mean(shape**2)))["torque_saturation"]
    assert tolerated == 0.0
    assert found == pytest.approx(float(np.mean(drawn**2) * np.mean(shape**2)), rel=0.05)
