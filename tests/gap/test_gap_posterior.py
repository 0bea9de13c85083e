"""The posterior on joints whose fault is known: what it names, how large, and what it does without the right cause."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap import noise
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.findings import Finding, findings, sampled
from frictid_hil.gap.plant_channel import plant_channel
from frictid_hil.gap.posterior import Posterior
from frictid_hil.gap.residuals import recordings
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
