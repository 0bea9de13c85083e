"""Where the gap lies: shares that add up, each effect in the regions that its own file names."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import numpy as np
import pytest
from test_gap_diagnose import SINGLES

from frictid_hil.gap.residuals import LowPass, recordings
from frictid_hil.gap.where import by_region, where
from frictid_hil.simulation.effect import Region
from frictid_hil.simulation.effects import all_effects

EFFECTS = {
    **SINGLES,
    "backlash": {"gap_rad": 2e-3},
    "friction_level_error": {"error_share": 0.1},
    "viscous_error": {"error_share": 0.2},
    "controller_gain_error": {"kp_error_share": 0.1},
    "transmission_error": {"amplitude_rad": 5e-4},
    "directional_efficiency": {"driving_share": 0.1, "backdriving_share": 0.02},
}


def places(effects: dict[str, dict[str, float]]):
    noise_nm = gap_sets.NOISE_NM * LowPass.at(1.0 / gap_sets.STEP_S).white_gain
    logs = recordings(gap_sets.make(effects, seed=4))
    return where(logs, noise_nm, velocity_gain_nm_s_per_rad=18.0)


@pytest.fixture(scope="module")
def shares() -> dict[str, dict[Region, float]]:
    """Shares by region, by effect."""
    assert set(EFFECTS) == set(all_effects())
    found = {}
    for name, parameters in EFFECTS.items():
        told = places({name: parameters})
        assert sum(place.share_of_gap for place in told) == pytest.approx(1.0), name
        assert all(place.share_of_gap > 0.0 for place in told)
        found[name] = by_region(told)
    return found


@pytest.mark.slow
def test_every_effect_is_largest_or_second_where_its_own_file_says(shares: dict[str, dict[Region, float]]) -> None:
    for name, found in shares.items():
        assert set(list(found)[:2]) & set(all_effects()[name].signature.regions), (name, found)


@pytest.mark.slow
def test_most_effects_are_largest_where_their_own_file_says(shares: dict[str, dict[Region, float]]) -> None:
    elsewhere = [n for n, found in shares.items() if next(iter(found)) not in all_effects()[n].signature.regions]
    assert len(elsewhere) <= 1, elsewhere


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "region", "least"),
    [
        ("torque_delay", Region.ACTUATION, 0.9),
        ("velocity_lag", Region.KINEMATICS, 0.9),
        ("torque_ripple", Region.POSITION, 0.6),
        ("inertia_error", Region.ACCELERATION, 0.6),
        ("viscous_nonlinearity", Region.VELOCITY_BAND, 0.6),
        ("stiction_breakaway", Region.STANDSTILL, 0.6),
        ("load_dependent_friction", Region.LOAD, 0.3),
    ],
)
def test_what_has_one_clear_place_is_found_there(
    shares: dict[str, dict[Region, float]], effect: str, region: Region, least: float
) -> None:
    assert shares[effect].get(region, 0.0) >= least


def test_a_noisy_velocity_of_a_row_s_middle_is_no_gap() -> None:
    """A controller's gain makes much torque of half a row; what a joint does wrong is smaller, and comes first."""
    made = gap_sets.make({"torque_bias": {"bias_nm": 0.1}}, seed=4)
    random, logs = np.random.default_rng(5), []
    for e in made.experiments:
        middle = np.gradient(e.position_rad, gap_sets.STEP_S)
        logs.append(replace(e, velocity_rad_s=middle + 0.01 * random.standard_normal(middle.size)))
    noise_nm = gap_sets.NOISE_NM * LowPass.at(1.0 / gap_sets.STEP_S).white_gain
    told = where(recordings(replace(made, experiments=tuple(logs))), noise_nm, velocity_gain_nm_s_per_rad=18.0)
    assert by_region(told).get(Region.KINEMATICS, 0.0) < 0.1


def test_friction_that_falls_with_a_measured_temperature_is_told_as_such() -> None:
    made = gap_sets.make()
    hot = []
    for k, e in enumerate(made.experiments):
        assert e.torque_nm is not None
        # Logs are warm and cold by turns, so that time alone does not tell it.
        celsius = np.full(e.time_s.size, 20.0 + 20.0 * (k % 2))
        slower = 0.3 * (celsius - 30.0) / 10.0 * np.sign(np.gradient(e.position_rad))
        hot.append(replace(e, torque_nm=e.torque_nm - slower, temperature_c=celsius))
    told = where(recordings(replace(made, experiments=tuple(hot))), 0.01, velocity_gain_nm_s_per_rad=18.0)
    assert by_region(told)[Region.TEMPERATURE] > 0.4


def test_shares_do_not_depend_on_the_unit_of_the_gap() -> None:
    """Ten times the residual without noise: the same picture."""
    once = by_region(places({"direction_asymmetry": {"coulomb_share": 0.2}}))
    twice = by_region(places({"direction_asymmetry": {"coulomb_share": 0.4}}))
    for region in (Region.VELOCITY_BAND, Region.POSITION):
        assert once[region] == pytest.approx(twice[region], abs=0.05)
