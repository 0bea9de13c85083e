"""A link that is sought in the simulated closed loop, and a drive that is later than its torque tells."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import pytest

from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.drive_in_loop import as_late
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.forward import Effects, Simulation
from frictid_hil.gap.link_in_loop import link_in_loop
from frictid_hil.gap.verdict import DOUBTED
from frictid_hil.simulation.effects import all_effects

PLAY_RAD, STIFFNESS = 0.012, 3e5
LINKS = ("backlash", "joint_elasticity")


def cause(name: str, **numbers: float) -> Finding:
    """A likely cause."""
    told = {key: Value(value, 0.9 * value, 1.1 * value) for key, value in numbers.items()}
    return Finding(name, 0.95, 0.95, 5.0, 0.5, told, (), "plant")


def off(value: float, true: float) -> float:
    """How far a number is from the true one, 0 to 1: a decade is as far as can be."""
    return min(1.0, abs(math.log10(max(value, 1e-12) / true)))


def simulation(gap_nm: Any, noise_nm: float = 0.05) -> Simulation:
    """A stand-in whose closed loop leaves what a function of the effects says, on all logs."""
    told = SimpleNamespace(fitted_gap_nm=gap_nm, loudest_gap_nm=lambda _, __: gap_nm, noise_nm=noise_nm)
    return cast(Simulation, told)


def gap_of_play(effects: Effects) -> float:
    """A joint with play; a wrong gravity does a third of what play does, and harm beside it; drift acts, too."""
    play = effects.get("backlash")
    drift = 0.0 if "temperature_drift" in effects else 0.5
    if play is None:
        return 1.0 + drift - (0.3 if "gravity_error" in effects else 0.0)
    misses = 0.8 * off(play["gap_rad"], PLAY_RAD) + 0.2 * off(play["contact_stiffness_nm_per_rad"], STIFFNESS)
    return 0.05 + misses + drift + (0.3 if "gravity_error" in effects else 0.0)


@pytest.mark.parametrize("noise_nm", [0.05, 0.0])
def test_play_is_found_of_any_size_and_what_stood_in_for_it_is_told_no_more(noise_nm: float) -> None:
    found = [cause("gravity_error", error_share=0.2), cause("temperature_drift", coulomb_share=0.3)]
    play, *rest = link_in_loop(found, simulation(gap_of_play, noise_nm), LINKS, ())
    assert play.effect == "backlash" and play.confidence == DOUBTED and math.isfinite(play.size)
    assert play.parameters["gap_rad"].value == pytest.approx(PLAY_RAD, rel=0.15)
    assert play.parameters["contact_stiffness_nm_per_rad"].value == pytest.approx(STIFFNESS, rel=0.5)
    assert [f.effect for f in rest] == ["temperature_drift"]


def test_a_joint_that_no_link_brings_nearer_has_none() -> None:
    assert link_in_loop([cause("gravity_error", error_share=0.2)], simulation(lambda _: 1.0), LINKS, ()) == []


def test_of_two_links_that_do_as_well_the_plainer_one_is_told() -> None:
    def gap_nm(effects: Effects) -> float:
        return 0.1 if set(effects) & set(LINKS) else 1.0

    assert [f.effect for f in link_in_loop([], simulation(gap_nm), LINKS, ())] == ["joint_elasticity"]


@pytest.mark.parametrize(("true_s", "told_s"), [(0.0050, 0.0050), (0.0040, 0.004), (0.0041, 0.004)])
def test_a_delay_is_moved_within_one_tick_where_the_loop_comes_clearly_nearer(true_s: float, told_s: float) -> None:
    def gap_nm(effects: Mapping[str, Mapping[str, float]]) -> float:
        return 0.05 + 500.0 * abs(effects["torque_delay"]["delay_s"] - true_s)

    delay = Finding("torque_delay", 0.99, 0.99, 9.0, 1.0, {"delay_s": Value(0.004, 0.0035, 0.0045)}, (), "actuation")
    (moved,) = as_late([delay], simulation(gap_nm), {}, list(all_effects()), 0.002, guessed=False)
    value = moved.parameters["delay_s"]
    assert value.value == pytest.approx(told_s) and value.low is not None and value.high is not None
    assert value.low < true_s < value.high


@pytest.mark.parametrize("there", ["electrical_lag", "torque_delay"])
def test_how_late_a_drive_is_and_in_which_way_is_sought_in_closed_loop_where_logs_lack_ticks(there: str) -> None:
    true = {"electrical_lag": {"time_constant_s": 0.0062}, "torque_delay": {"delay_s": 0.0062}}[there]

    def gap_nm(effects: Mapping[str, Mapping[str, float]]) -> float:
        (value,), (sought,) = effects.get(there, {"": 0.0}).values(), true.values()
        return 0.05 + 500.0 * abs(value - sought)

    delay = Finding("torque_delay", 0.99, 0.99, 9.0, 1.0, {"delay_s": Value(0.013, 0.008, 0.018)}, (), "actuation")
    faint = Finding("electrical_lag", 0.2, 0.2, 2.0, 0.0, {"time_constant_s": Value(0.002)}, (), "actuation")
    (told, *others) = as_late([delay, faint], simulation(gap_nm), {}, list(all_effects()), 0.001, guessed=True)
    assert others == ([faint] if there == "torque_delay" else [])  # no cause is told twice
    (value,) = told.parameters.values()
    assert told.effect == there and value.value == pytest.approx(0.0062, rel=0.06)
    assert value.low is not None and value.high is not None and value.low < 0.0062 < value.high
    assert ("torque_delay" in told.rivals) == (there == "electrical_lag")
    (as_read,) = as_late([delay], simulation(gap_nm), {}, ["torque_delay"], 0.001, guessed=False)
    assert as_read.effect == "torque_delay"
