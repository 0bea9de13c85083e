from __future__ import annotations

import math
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from sim_joints import CONTROLLER, COULOMB, GRAVITY, INERTIA, STIFFNESS, VISCOUS, bare, excitation, simulate

from frictid_hil.simulation import catalogue, compose
from frictid_hil.simulation.effect import Channel
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.replay import Simulated

NAMES = sorted(all_effects())
UNITS = (
    "_rad",
    "_rad_s",
    "_nm",
    "_s",
    "_c",
    "_w",
    "_share",
    "_per_nm",
    "_rad_per_nm",
    "_nm_per_rad",
    "cycles_per_motor_revolution",
)
WITHOUT_UNIT = {
    "share",
    "exponent",
    "bend",
    "loop_exponent",
    "loop_beta",
    "cycles_per_motor_revolution",
    *(f"{which}_cycles_per_motor_revolution" for which in ("second", "third", "fourth")),
}


def test_the_effects_of_the_design_are_there() -> None:
    names = """
        stribeck viscous_nonlinearity direction_asymmetry load_dependent_friction torque_ripple
        presliding_hysteresis stiction_breakaway backlash joint_elasticity torque_delay torque_constant_error
        torque_saturation velocity_lag encoder_quantisation encoder_offset gravity_error inertia_error
        temperature_drift torque_bias electrical_lag friction_level_error viscous_error controller_gain_error
        transmission_error directional_efficiency"""
    assert set(names.split()) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_every_effect_is_completely_described(name: str) -> None:
    effect = all_effects()[name]
    assert effect.summary.endswith(".") and "Source" in effect.documentation and len(effect.documentation) > 200
    assert effect.signature.channels and effect.signature.regions and effect.hooks and effect.strengths
    for p in effect.parameters:
        assert p.name.endswith(UNITS) or p.name in WITHOUT_UNIT, p.name
        assert p.lower < p.upper and p.lower <= p.typical <= p.upper and p.description
        assert p.off is None or p.lower <= p.off <= p.upper
    assert any(effect.typical[p.name] != p.off for p in effect.strengths)


@pytest.mark.parametrize("name", NAMES)
def test_every_effect_draws_a_picture(name: str) -> None:
    effect = all_effects()[name]
    for parameters in (effect.typical, effect.off):
        picture = effect.illustrate(parameters)
        assert picture.x_label and picture.y_label and picture.curves
        for label, x, y in picture.curves:
            assert label and x.shape == y.shape and np.isfinite(x).all() and np.isfinite(y).all()


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_that_is_off_changes_nothing(name: str) -> None:
    without, off = simulate(bare()), simulate(bare(effects={name: all_effects()[name].off}))
    for column in ("position_rad", "velocity_rad_s", "torque_nm"):
        np.testing.assert_array_equal(getattr(without, column), getattr(off, column))


# -- the channels an effect is declared to show in, and no others -----------------------------------------------------

# Sizes at which the effect is plain on a joint of 0.5 kg m2 and 4 N m.
PLAIN = {
    "torque_saturation": {"limit_share": 0.15},
    "encoder_quantisation": {"step_rad": 3e-4},
    "temperature_drift": {"coulomb_share": 0.5, "time_constant_s": 5.0, "power_w": 0.5},
    "load_dependent_friction": {"linear_share": 0.3},
    "torque_constant_error": {"error_share": 0.1},
    "encoder_offset": {"offset_rad": 0.2},
    "gravity_error": {"error_share": 0.2},
    "inertia_error": {"error_share": 0.6},
    "joint_elasticity": {"compliance_rad_per_nm": 1e-3},
    "backlash": {"gap_rad": 4e-3},
    "torque_bias": {"bias_nm": 1.0},
    "torque_ripple": {"amplitude_nm": 1.0},
    "transmission_error": {"amplitude_rad": 1e-3},
    "directional_efficiency": {"driving_share": 0.3},
}


def kinematic_residual(rows: Simulated) -> float:
    """Reported velocity minus differenced position, and how coarse the positions are."""
    difference = np.diff(rows.position_rad, prepend=rows.position_rad[0]) * CONTROLLER.rate_hz
    steps = np.unique(np.abs(np.diff(rows.position_rad)))
    return max(np.abs(rows.velocity_rad_s - difference).max(), 1e3 * steps[steps > 1e-9].min())


def actuation_residual(rows: Simulated) -> float:
    """Reported torque minus the controller's demand, the controller written once more in its plainest form."""
    time, command = excitation()
    period = 1 / CONTROLLER.rate_hz
    slope = np.gradient(np.concatenate([command[:1], command, command[-1:]]), period)[1:-1]
    integral, filtered, worst = rows.torque_nm[0], 0.0, 0.0
    share = 1 - math.exp(-period / CONTROLLER.velocity_filter_s)
    for k in range(time.size - 1):
        velocity = (rows.position_rad[k] - rows.position_rad[k - 1]) / period if k else 0.0
        filtered += share * (velocity - filtered)
        error = command[k] - rows.position_rad[k]
        demand = CONTROLLER.kp_nm_per_rad * error + integral + CONTROLLER.kd_nm_s_per_rad * (slope[k] - filtered)
        if abs(demand) <= CONTROLLER.torque_limit_nm:
            integral += CONTROLLER.ki_nm_per_rad_s * error * period
        worst = max(worst, abs(rows.torque_nm[k + 1] - demand))
    return worst


def plant_residual(rows: Simulated) -> float:
    """Reported torque minus the bare joint's equation along the reported motion, smoothed over 20 ms, RMS."""
    period = 1 / CONTROLLER.rate_hz
    position = rows.position_rad
    acceleration = np.gradient(np.gradient(position, period), period)
    velocity = np.gradient(position, period)
    slip, slips = 0.0, []
    for step in np.diff(position, prepend=position[0]):
        slip = min(1.0, max(-1.0, slip + step * STIFFNESS / COULOMB))
        slips.append(slip)
    model = INERTIA * acceleration + GRAVITY * np.cos(position) + COULOMB * np.array(slips) + VISCOUS * velocity
    torque = (rows.torque_nm[:-1] + rows.torque_nm[1:]) / 2
    window = np.hanning(21)
    residual = np.convolve(torque - model[:-1], window / window.sum(), "valid")
    return float(np.sqrt(np.mean(residual**2)))


RESIDUALS = {
    Channel.KINEMATIC: (kinematic_residual, 1e-3),
    Channel.ACTUATION: (actuation_residual, 1e-6),
    Channel.PLANT: (plant_residual, 0.12),
}


def test_the_bare_joint_shows_in_no_channel() -> None:
    rows = simulate(bare())
    for residual, limit in RESIDUALS.values():
        assert residual(rows) < limit / 1.5


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_shows_in_its_channels_and_in_no_other(name: str) -> None:
    effect = all_effects()[name]
    rows = simulate(bare(effects={name: {**effect.typical, **PLAIN.get(name, {})}}))
    for channel, (residual, limit) in RESIDUALS.items():
        if channel in effect.signature.channels:
            assert residual(rows) > limit, channel
        else:
            assert residual(rows) < limit, channel


# -- composing --------------------------------------------------------------------------------------------------------


def test_the_composed_kernel_calls_every_hook_once_per_stage() -> None:
    source = compose.kernel_source()
    compile(source, "kernel", "exec")
    assert not re.search(r"^ +# effects at", source, re.MULTILINE)
    for effect in all_effects().values():
        for hook in effect.hooks:
            calls = re.findall(rf"^ +(?:\w+ = )?{effect.name}_{hook.function.__name__}\(", source, re.MULTILINE)
            assert calls, (effect.name, hook.stage)


def test_a_hook_that_asks_for_something_unknown_is_named() -> None:
    def level(level_nm: float, weather: float) -> float:
        return level_nm + weather

    effect = all_effects()["stribeck"]
    with pytest.raises(RuntimeError, match=r"stribeck: level asks for 'weather'"):
        compose._arguments(effect, level, compose.layout(), frozenset({"level_nm"}))


def test_the_kernel_works_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    folder = compose._cache_folder()
    assert folder.is_dir() and "frictid-hil-" in folder.name
    folder.rmdir()


def test_that_it_compiles_is_told_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(compose, "_cache_folder", lambda: tmp_path)
    caplog.set_level("INFO", "frictid_hil")
    assert [compose._load("x = 1").x for _ in range(2)] == [1, 1]
    assert len(caplog.messages) == 1 and "compiling the simulated joint" in caplog.messages[0]


def test_the_page_of_effects_is_up_to_date() -> None:
    docs = Path(__file__).parents[2] / "docs" / "reference"
    regenerate = "python -m frictid_hil.simulation.catalogue docs/reference"
    assert (docs / "effects.md").read_text(encoding="utf-8") == catalogue.page(), regenerate
    for name in NAMES:
        assert (docs / "effects" / f"{name}.svg").is_file(), regenerate


@pytest.mark.parametrize("name", NAMES)
def test_pictures_are_well_formed(name: str) -> None:
    picture = catalogue.picture(all_effects()[name].illustrate(all_effects()[name].typical))
    lines = ElementTree.fromstring(picture).findall("{http://www.w3.org/2000/svg}polyline")
    assert lines
    for line in lines:
        for x, y in (point.split(",") for point in line.attrib["points"].split()):
            assert 0 <= float(x) <= 480 and 0 <= float(y) <= 250
