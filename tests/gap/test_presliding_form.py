"""The form of presliding that a file does not state: told from recordings whose friction was integrated here."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import numpy as np
import pytest

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap import presliding
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.gap.presliding import as_it_yields

STEP_S, FINE = 0.002, 20
LEVEL_NM, VISCOUS, STIFFNESS = 3.0, 0.5, 4000.0
SPEEDS = np.array([0.25, 0.5, 1.0, 1.5])
BELIEF = replace(
    gap_sets.NOMINAL,
    controller=None,
    curve=FrictionCurve.through(SPEEDS, LEVEL_NM + VISCOUS * SPEEDS),
    presliding_stiffness_nm_per_rad=STIFFNESS,
)


def friction(
    position: np.ndarray, step_s: float, bristle: bool, rise_nm: float, level_nm: float = LEVEL_NM
) -> np.ndarray:
    """LuGre without micro-damping, or a spring that slips, integrated along a motion; explicit steps."""
    state, force = 0.0, np.empty(position.size)
    for k, v in enumerate(np.gradient(position, step_s)):
        level = level_nm + rise_nm * np.exp(-((v / 0.08) ** 2))
        bent = STIFFNESS * abs(state) / level * (1.0 if state * v > 0.0 else -1.0) if bristle else 0.0
        state += v * step_s * (1.0 - bent)
        if not bristle:
            state = float(np.clip(state, -level / STIFFNESS, level / STIFFNESS))
        force[k] = STIFFNESS * state + VISCOUS * v
    return force


def recorded(nominal: Nominal, bristle: bool, rise_nm: float = 0.0, level_nm: float = LEVEL_NM) -> ExperimentSet:
    """Two motions with many reversals, the torque of a joint that is otherwise as believed."""
    rng, experiments = np.random.default_rng(4), []
    for order, phases in enumerate((rng.uniform(0.0, 6.28, 4), rng.uniform(0.0, 6.28, 4))):
        t = np.arange(0.0, 16.0, STEP_S / FINE)
        waves = zip((0.17, 0.41, 0.73, 1.3), (0.5, 0.3, 0.12, 0.05), phases, strict=True)
        q = sum((a * np.sin(2.0 * np.pi * f * t + p) for f, a, p in waves), np.zeros_like(t))
        acceleration = np.gradient(np.gradient(q, t), t)
        assert nominal.inertia_kg_m2 is not None
        torque = nominal.inertia_kg_m2 * acceleration + nominal.gravity_cos_nm * np.cos(q)
        torque += friction(q, STEP_S / FINE, bristle, rise_nm, level_nm)
        mean = torque[: torque.size // FINE * FINE].reshape(-1, FINE).mean(axis=1)
        rows = slice(FINE, None, FINE)
        time, position = t[rows], q[rows]
        experiments.append(
            Experiment(
                name=f"log_{order}",
                validation=bool(order),
                payload=False,
                run_order=order,
                time_s=time,
                position_rad=position,
                velocity_rad_s=None,
                torque_nm=mean[: time.size] + 0.02 * rng.standard_normal(time.size),
                position_command_rad=None,
            )
        )
    return ExperimentSet("integrated", nominal, tuple(experiments))


@pytest.mark.parametrize("bristle", [True, False])
def test_the_form_is_read_off_the_recordings(bristle: bool) -> None:
    experiments, told = as_it_yields(recorded(BELIEF, bristle))
    assert (experiments.nominal.yields_gradually is True) is bristle
    assert (told is not None) is bristle


def test_a_form_that_hardly_fits_better_is_no_other_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """As behind an encoder whose counts are longer than the way that friction builds up over."""
    squares = {True: 0.97, None: 1.0}
    monkeypatch.setattr(presliding, "_fit", lambda logs, form: (squares[form.yields_gradually], LEVEL_NM))
    experiments, told = as_it_yields(recorded(BELIEF, bristle=False))
    assert experiments.nominal.yields_gradually is None and told is None


def test_more_friction_on_a_spring_of_the_stated_stiffness_bends_it_further() -> None:
    experiments, told = as_it_yields(recorded(BELIEF, bristle=False, level_nm=1.5 * LEVEL_NM))
    assert experiments.nominal.presliding_stiffness_nm_per_rad == pytest.approx(STIFFNESS / 1.5, rel=0.05)
    assert told is not None and "the level does not" in told


def test_a_stiffness_that_nobody_states_has_no_form_and_the_travel_that_fits_best() -> None:
    unstated = replace(BELIEF, presliding_stiffness_nm_per_rad=None)
    experiments, told = as_it_yields(recorded(unstated, bristle=True))
    assert not experiments.nominal.yields_gradually and experiments.nominal.presliding_stiffness_nm_per_rad is None
    true_rad = LEVEL_NM / STIFFNESS
    assert true_rad / 2.0 < experiments.nominal.presliding_travel_rad < 2.0 * true_rad
    assert told is not None and "no presliding stiffness is stated" in told


def test_the_usual_travel_stays_where_it_fits() -> None:
    """The joint's friction builds up over 0.75 mrad; tried are factors of five."""
    usual = replace(BELIEF, presliding_stiffness_nm_per_rad=None, presliding_travel_rad=LEVEL_NM / STIFFNESS)
    experiments, told = as_it_yields(recorded(usual, bristle=False))
    assert experiments.nominal.presliding_travel_rad == usual.presliding_travel_rad and told is None


def test_a_bristle_is_no_gap_and_its_falling_level_is_named() -> None:
    healthy = diagnose(recorded(BELIEF, bristle=True))
    assert healthy.verdict == "none", healthy.summary
    assert "gradually" in healthy.reasons["presliding"]
    falling = diagnose(recorded(BELIEF, bristle=True, rise_nm=0.9))
    assert falling.causes[0].effect == "stribeck", falling.summary
