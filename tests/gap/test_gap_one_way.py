"""A motor that only ever turns one way: what such a motion can tell comes before what it cannot."""

from __future__ import annotations

import numpy as np
import pytest
from gap_sets import real_more_data

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.gap.residuals import recordings
from frictid_hil.gap.verdict import DOUBTED

REAL_MORE = real_more_data()
STEP_S, INERTIA, VISCOUS = 1e-3, 2e-4, 0.01
CURVE = FrictionCurve.through(np.array([2.0, 4.0, 8.0]), 0.02 + VISCOUS * np.array([2.0, 4.0, 8.0]))


def spinning(seed: int, validation: bool, cogging_nm: float) -> Experiment:
    """One log of a bare motor: a rigid-body column of its inertia, an unknown offset, 24 cogs a turn."""
    random = np.random.default_rng(seed)
    time = STEP_S * np.arange(4000)
    position = 6.0 * time + 0.3 * np.sin(2.0 * np.pi * 1.7 * time + seed)
    velocity = np.gradient(position, STEP_S)
    rigid = INERTIA * np.gradient(velocity, STEP_S)
    friction = 0.02 + VISCOUS * velocity
    torque = rigid + friction + 0.015 + cogging_nm * np.cos(24.0 * position + 0.4)
    torque = torque + 0.002 * random.standard_normal(time.size)
    return Experiment(
        name=f"spin {seed}", validation=validation, payload=False, run_order=seed, time_s=time,
        position_rad=position, torque_nm=torque, rigid_body_torque_nm=rigid,
    )  # fmt: skip


def made(cogging_nm: float) -> ExperimentSet:
    logs = spinning(0, False, cogging_nm), spinning(1, True, cogging_nm)
    return ExperimentSet("one way", Nominal(gear_ratio=1.0, curve=CURVE, continuous=True), logs)


@pytest.mark.slow
def test_cogging_comes_before_an_offset_that_may_be_friction() -> None:
    found = diagnose(made(0.03))
    assert found.causes[0].effect == "torque_ripple" and found.causes[0].confidence >= DOUBTED
    told = found.causes[0].parameters
    order, phase = told["cycles_per_motor_revolution"], told["phase_rad"]
    assert order.low == order.value == order.high == 24.0, "a line is that line, however large it is"
    assert 0.0 < phase.high - phase.low < 1.0
    assert told["amplitude_nm"].value == pytest.approx(0.03, rel=0.1)
    # Offset and friction stand for one another on such a motion: neither is sure, and nothing is applied.
    others = [c for c in found.causes if c.effect in ("torque_bias", "friction_level_error", "viscous_error")]
    assert others and max(c.confidence for c in others) <= 0.5
    assert found.verdict == "ambiguous" and "one direction" in found.reasons["motion"]


def test_a_torque_goes_with_the_rigid_body_column_of_its_own_row() -> None:
    experiments = made(0.3)
    log = experiments.experiments[0]
    assert log.torque_nm is not None and log.rigid_body_torque_nm is not None
    view = recordings(experiments)[0].view
    assert view is not None
    np.testing.assert_array_equal(view.torque_nm, log.torque_nm)


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.skipif(REAL_MORE is None, reason="no real recordings (FRICTID_REAL_MORE_DATA)")
@pytest.mark.parametrize("name", ["odri_off_a", "odri_on_a"])
def test_the_cogging_of_a_real_motor_is_named_first(name: str) -> None:
    assert REAL_MORE is not None
    found = diagnose(ExperimentSet.load(REAL_MORE / "cases" / name))
    assert found.causes[0].effect == "torque_ripple" and found.causes[0].confidence >= DOUBTED
