"""How far a gap closes: the interval of what is left, and the figures of the closed loop."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import numpy as np
import pytest

from frictid_hil.config.nominal import Tolerance
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.forward import Replay, Replayed, pooled
from frictid_hil.gap.how_far import _interval
from frictid_hil.gap.tolerances import Tolerances

STEP_S = 0.02
TRUE = np.array([0.4, 1.0])  # coefficients of what is left and of what a cause makes, N m


def _recorded(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """A residual whose noise remembers for 0.1 s."""
    white = random.standard_normal(x.shape[0] + 1)
    return x @ TRUE + 0.3 * (0.8 * white[1:] + 0.6 * white[:-1])


def test_the_interval_holds_another_recording_and_the_true_numbers_in_nine_of_ten() -> None:
    """A cause is fitted to one recording and judged on a second; a third one is to come."""
    random = np.random.default_rng(3)
    again, true = [], []
    for _ in range(300):
        x = np.stack([np.sin(np.arange(1000) * 0.11), np.sign(np.sin(np.arange(1000) * 0.05))], axis=1)
        cause = x[:, 1:]
        covariance = np.linalg.inv(cause.T @ cause) * (0.3**2 * 2.0 + 0.5 * TRUE[0] ** 2)
        fitted = np.linalg.lstsq(cause, _recorded(random, x), rcond=None)[0]
        draws = fitted + random.standard_normal((40, 1)) * np.sqrt(covariance)
        left = _recorded(random, x) - cause @ fitted
        low, high = _interval(left, [cause @ (fitted - draw) for draw in draws], STEP_S)
        other = _recorded(random, x)
        again.append(low <= np.sqrt(np.mean((other - cause @ fitted) ** 2)) <= high)
        true.append(low <= np.sqrt(np.mean((other - cause @ TRUE[1:]) ** 2)) <= high)
        assert high < 1.4 * low  # it says something
    assert min(np.mean(again), np.mean(true)) > 0.9


@pytest.mark.slow
def test_without_a_library_the_gap_is_told_all_the_same() -> None:
    found = diagnose(gap_sets.make({"torque_bias": {"bias_nm": 0.3}}), library=())
    assert found.before.inverse_nm == pytest.approx(0.3, rel=0.02)
    assert "torque_bias" not in {cause.effect for cause in found.causes}


@pytest.mark.slow
def test_what_was_fitted_within_tolerances_is_reported_and_in_the_improved_joint() -> None:
    cause = {"direction_asymmetry": {"coulomb_share": 0.07, "viscous_share": 0.15}}
    experiments = gap_sets.make({**cause, "friction_level_error": {"error_share": 0.004}})
    found = diagnose(experiments)
    level = found.fitted_along["friction_level_error"]["error_share"]
    assert {c.effect for c in found.causes} == {"direction_asymmetry"}
    assert level.low is not None and level.high is not None and level.low <= 0.004 <= level.high
    told = found.to_json()["fitted_along"]["friction_level_error"]["error_share"]
    assert told == {"value": level.value, "interval_95": [level.low, level.high]}
    model = found.improved_model()
    assert model is not None and model.effects["friction_level_error"]["error_share"] == level.value
    alone = {name: model.effects[name] for name in cause}
    left = pooled(Replay(experiments)(alone, validation=True), "torque_nm")
    assert found.after.forward_torque_nm is not None and found.after.forward_torque_nm < 0.9 * left


@pytest.mark.slow
def test_the_gap_after_is_that_of_the_joint_that_is_written() -> None:
    """The belief corrected by what was told leaves as much: a row that is late has no number, and stays."""
    made = gap_sets.make({"gravity_error": {"error_share": 0.1}}, noise_nm=0.08)
    late = [replace(e, torque_nm=0.8 * e.torque_nm + 0.2 * np.roll(e.torque_nm, 1)) for e in made.experiments]
    known = {name: 1e-4 for name in ("inertia_kg_m2", "friction_torque", "viscous", "torque_constant")}
    sure = Tolerances.of(Tolerance(**known, absolute={"zero_offset_rad": 1e-6}))
    experiments = replace(made, nominal=replace(made.nominal, tolerances=sure), experiments=tuple(late))
    found = diagnose(experiments)
    assert found.causes[0].effect == "gravity_error"
    gravity_nm = made.nominal.gravity_cos_nm * (1.0 + found.causes[0].parameters["error_share"].value)
    corrected = replace(experiments.nominal, gravity_cos_nm=gravity_nm)
    left = diagnose(replace(experiments, nominal=corrected), library=()).before.inverse_nm
    assert found.after.inverse_nm == pytest.approx(left, rel=0.02)


def test_a_closed_loop_is_told_from_where_a_log_has_settled() -> None:
    start, rest = np.full(50, 9.0), np.full(150, 2.0)
    log = Replayed(np.concatenate([start, rest]), np.concatenate([start, 0.5 * rest]), settled=50)
    assert (pooled({"moves": log}, "torque_nm"), pooled({"moves": log}, "position_rad")) == (2.0, 1.0)
