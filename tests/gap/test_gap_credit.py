"""What a cause must bear out on held-out recordings, and what its response must look like in time."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import cast

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap.credit import credits, sound
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.forward import Replayed, settled_nm
from frictid_hil.gap.generic import since_start
from frictid_hil.gap.held_out import change, deviations, in_stretches
from frictid_hil.gap.how_far import Hypothesis, Judge
from frictid_hil.gap.verdict import Features, verdict_of
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
    earned = credits(cast(Judge, judge), cast(Hypothesis, hypothesis), ("true", "false"))
    assert sum(credit.share for credit in earned.values()) == pytest.approx(1.0)
    assert earned["true"].share > 1.0 and earned["true"].deviations > 5.0
    assert earned["false"].share < 0.0 and earned["false"].deviations < -5.0


@pytest.mark.parametrize(("floor_nm", "kept"), [(0.01, True), (0.3, False)])
def test_what_stands_far_out_of_the_floor_is_kept_beside_a_strong_effect(floor_nm: float, kept: bool) -> None:
    strong = 5.0 * np.sin(np.linspace(0.0, 60.0, 4000))
    rare = np.zeros(4000)
    rare[1000:1040] = 4.0  # so much in so few stretches that chance could have made it
    closed = Closed(strong + rare, {"strong": strong, "rare": rare})
    judge = SimpleNamespace(
        judged=closed.judged,
        drive={},
        evidence=SimpleNamespace(misfit_ratio=lambda groups: 9.0),
        without=lambda given, name: hypothesis_of(closed, tuple(n for n in given.names if n != name)),
    )
    whole = hypothesis_of(closed, ("strong", "rare"))
    found = sound(cast(Judge, judge), cast(Hypothesis, whole), floor_nm)
    assert found.names == (("strong", "rare") if kept else ("strong",))


def hypothesis_of(judge: Closed, names: tuple[str, ...]) -> SimpleNamespace:
    """Effects of which only the replay tells."""
    left = settled_nm(judge.judged(dict.fromkeys(names)))
    effects: dict[str, dict[str, float]] = {name: {} for name in names}
    return SimpleNamespace(names=names, groups=(), replayed=names, effects=effects, judged_nm=left, misfit=1.0)


@pytest.mark.parametrize(("after", "verdict"), [(4.6, "explained"), (12.0, "unknown")])
def test_a_swinging_link_leaves_its_trace_in_inverse_dynamics(after: float, verdict: str) -> None:
    features = Features(
        before=24.4, after=after, misfit=647.0, misfit_before=1195.0, family_share=0.5, family_gain=7e5,
        family_name="lagged motion", family_alone=0.95, actuation_left=0.0, held_share=0.0,
        names=("encoder_offset", "backlash"), gain=1.2e6, rivals={"encoder_offset": (1.1e6, "torque_bias")},
        rival_drive={}, drive_gain={}, actuation_ratio=1.4, actuation_motion=1.0, actuation_rest=1.0,
        actuation_worst=1.4, coarse=1.0, floor_nm=0.1, probed={"backlash": (3476.0, 0.0, "")},
        hollow={"backlash": 0.0},
    )  # fmt: skip
    assert verdict_of(features)[0] == verdict


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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["torque_delay", "electrical_lag"])
def test_a_late_torque_is_never_named_for_sure_by_its_partner(name: str) -> None:
    size = {"torque_delay": {"delay_s": 0.004}, "electrical_lag": {"time_constant_s": 0.004}}[name]
    made = gap_sets.make({name: size})
    found = diagnose(made)
    assert found.causes[0].effect == name and found.causes[0].confidence >= 0.9
    partner = diagnose(made, library=[n for n in all_effects() if n != name])
    assert all(c.confidence < 0.9 for c in partner.causes)
