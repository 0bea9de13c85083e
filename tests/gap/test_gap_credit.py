"""What a cause must bear out on held-out recordings, and what its response must look like in time."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap.credit import credits
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.forward import Replayed
from frictid_hil.gap.generic import since_start
from frictid_hil.gap.held_out import change, deviations, in_stretches
from frictid_hil.simulation.effects import all_effects


class Closed:
    """A judge whose effects each take a known torque off a known difference."""

    def __init__(self, gap_nm: np.ndarray, taken_nm: Mapping[str, np.ndarray]) -> None:
        self.gap_nm, self.taken_nm = gap_nm, taken_nm

    def judged(self, effects: Mapping[str, object]) -> dict[str, Replayed]:
        left = self.gap_nm - sum((self.taken_nm[name] for name in effects), np.zeros_like(self.gap_nm))
        return {"log": Replayed(left, left)}


def test_an_effect_that_opens_what_another_closes_too_far_gets_a_negative_share() -> None:
    random = np.random.default_rng(1)
    gap = np.sin(np.linspace(0.0, 60.0, 4000)) + 0.05 * random.standard_normal(4000)
    wave = np.sin(np.linspace(0.0, 60.0, 4000))
    judge = Closed(gap, {"true": wave, "false": 0.1 * random.standard_normal(4000)})
    hypothesis = SimpleNamespace(effects={"true": {}, "false": {}})
    earned = credits(judge, hypothesis, ("true", "false"))  # type: ignore[arg-type]
    assert sum(credit.share for credit in earned.values()) == pytest.approx(1.0)
    assert earned["true"].share > 1.0 and earned["true"].deviations > 5.0
    assert earned["false"].share < 0.0 and earned["false"].deviations < -5.0


def test_a_change_that_chance_makes_is_within_its_standard_error() -> None:
    random = np.random.default_rng(2)
    before, after = (in_stretches(random.standard_normal(20_000)) for _ in range(2))
    assert abs(change(before, after).deviations) < 3.0
    better = change(before, 0.5 * before)
    assert better.share == pytest.approx(-0.5) and better.deviations < -5.0
    assert deviations(np.zeros(5)) == 0.0


def test_way_and_rest_start_anew_when_a_joint_rests_or_turns() -> None:
    still, ramp = np.zeros(500), np.linspace(0.0, 0.5, 500)
    position = np.concatenate([still, ramp, np.full(250, 0.5), 0.5 + ramp, 1.0 - ramp])
    way, rest = since_start(position, 0.002, 1e-3)
    assert way[499] == 0.0 and rest[499] == pytest.approx(2.0, abs=0.01)
    assert way[990] == pytest.approx(0.49, abs=0.01) and rest[990] == rest[600] > 1.9
    assert rest[1249] == pytest.approx(0.5, abs=0.02)
    assert way[1300] == pytest.approx(0.05, abs=0.005) and rest[1300] == pytest.approx(0.5, abs=0.02)
    # A turn without rest.
    assert way[1900] == pytest.approx(0.15, abs=0.01) and rest[1900] == 0.0


@pytest.mark.parametrize("name", ["torque_delay", "electrical_lag"])
def test_a_late_torque_is_never_named_for_sure_by_its_partner(name: str) -> None:
    size = {"torque_delay": {"delay_s": 0.004}, "electrical_lag": {"time_constant_s": 0.004}}[name]
    made = gap_sets.make({name: size})
    found = diagnose(made)
    assert found.causes[0].effect == name and found.causes[0].confidence >= 0.9
    partner = diagnose(made, library=[n for n in all_effects() if n != name])
    assert all(c.confidence < 0.9 for c in partner.causes)
