"""Effects that users add by an entry point, and lines that a motor's cogging leaves in recordings."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sim_joints import bare

from frictid_hil.errors import UsageError
from frictid_hil.simulation import compose, effects
from frictid_hil.simulation.effects import directional_efficiency, torque_ripple, transmission_error
from frictid_hil.simulation.inverse import View
from frictid_hil.simulation.replay import Controller, closed_loop

MODULE = """
import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm


def shaft(torque_nm, position_rad, pull_nm):
    return torque_nm - pull_nm * position_rad


EFFECT = Effect(
    name="hose_pull",
    summary="A hose pulls.",
    documentation="Only in this test.",
    parameters=(Parameter("pull_nm", -50.0, 50.0, 1.0, "at 1 rad", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.POSITION,)),
    hooks=(Hook("shaft", shaft),),
    illustrate=lambda p: Illustration("x", "y", (("hose", np.arange(3.0), np.arange(3.0)),)),
    inverse=InverseForm(
        ({},), lambda views, shape: [v.position_rad[:, None] for v in views], lambda s, c: {"pull_nm": c[0]}
    ),
)
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path with a package that offers an effect."""
    info = tmp_path / "hose-1.0.dist-info"
    info.mkdir()
    (tmp_path / "hose_of_a_user.py").write_text(MODULE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hose\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[frictid_hil.effects]\nhose_pull = hose_of_a_user:EFFECT\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "hose_of_a_user", raising=False)
    for cached in (effects.all_effects, compose.layout):
        cached.cache_clear()
    yield tmp_path
    monkeypatch.undo()
    for cached in (effects.all_effects, compose.layout):
        cached.cache_clear()


def test_a_users_effect_is_simulated_and_offered_to_the_diagnosis(installed: Path) -> None:
    added = effects.all_effects()["hose_pull"]
    assert list(effects.all_effects()) == sorted(effects.all_effects())
    assert added.inverse is not None
    assert "torque_nm = hose_pull_shaft(torque_nm, position_rad, parameters[" in compose.kernel_source()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("hose_pull = no_such_module:EFFECT", "cannot be loaded"),
        ("hose = hose_of_a_user:EFFECT", "no Effect named hose"),
        ("hose_pull = hose_of_a_user:np", "no Effect named hose_pull"),
        ("stribeck = hose_of_a_user:RENAMED", "of this name already"),
    ],
)
def test_a_users_effect_that_cannot_be_used_is_named(installed: Path, line: str, words: str) -> None:
    renamed = "\nfrom dataclasses import replace\nRENAMED = replace(EFFECT, name='stribeck')\n"
    (installed / "hose_of_a_user.py").write_text(MODULE + renamed)
    (installed / "hose-1.0.dist-info" / "entry_points.txt").write_text(f"[frictid_hil.effects]\n{line}\n")
    with pytest.raises(UsageError, match=words) as caught:
        effects.all_effects()
    assert "frictid_hil.effects" in str(caught.value)


def _spinning(torque_nm: np.ndarray, position_rad: np.ndarray, step_s: float, gear_ratio: float = 1.0) -> View:
    """A joint without friction or inertia of its own: what its torque shows is what is put there."""
    zero = np.zeros_like(position_rad)
    velocity = np.gradient(position_rad, step_s)
    return View(
        step_s=step_s, start_s=0.0, position_rad=position_rad, velocity_rad_s=velocity,
        acceleration_rad_s2=np.gradient(velocity, step_s), torque_nm=torque_nm, slip=np.sign(velocity), rate_nm=zero,
        gravity_nm=zero, payload_gravity_nm=zero, gravity_slope_nm_per_rad=zero, load_nm=zero, coulomb_nm=1.0,
        stiffness_nm_per_rad=1e4, motor_inertia_kg_m2=0.0, link_inertia_kg_m2=0.2, payload_inertia_kg_m2=0.0,
        gear_ratio=gear_ratio,
    )  # fmt: skip


def test_lines_of_a_cogging_motor_are_found_up_to_what_the_sampling_sees() -> None:
    time_s = 0.001 * np.arange(6000)
    angle = 6.3 * time_s + 0.3 * np.sin(2.0 * time_s)
    noise = 0.05 * np.random.default_rng(3).standard_normal(time_s.size)
    torque = 1.0 + 0.3 * np.cos(72 * angle + 0.4) + 0.1 * np.cos(18 * angle - 1.0) + noise
    assert torque_ripple.lines_seen([_spinning(torque, angle, 0.001)]) == (72.0, 18.0)
    assert torque_ripple.lines_seen([_spinning(1.0 + noise, angle, 0.001)]) == ()
    slow = slice(None, None, 25)  # 72 lines are beyond half the sampling rate now
    assert 72.0 not in torque_ripple.lines_seen([_spinning(torque[slow], angle[slow], 0.025)])


def test_a_line_is_found_by_a_joint_that_turns_a_quarter() -> None:
    time_s = 0.001 * np.arange(12000)
    angle = 0.45 * np.sin(0.8 * time_s) + 0.3 * np.sin(2.6 * time_s)
    noise = 0.05 * np.random.default_rng(3).standard_normal(time_s.size)
    ripple = 0.3 * np.cos(18 * angle + 0.4)
    assert np.ptp(angle) < 0.25 * 2.0 * np.pi
    assert torque_ripple.lines_seen([_spinning(ripple + noise, angle, 0.001)])[:1] == (18.0,)
    assert torque_ripple.lines_seen([_spinning(noise, angle, 0.001)]) == ()


def test_the_lines_found_give_amplitude_and_phase_back() -> None:
    time_s = 0.001 * np.arange(6000)
    angle = 6.3 * time_s
    torque = 0.3 * np.cos(72 * angle + 0.4) + 0.1 * np.cos(18 * angle - 1.0)
    view = _spinning(torque, angle, 0.001)
    shape = next(s for s in torque_ripple.shapes_for([view]) if list(s.values()) == [72.0, 18.0])
    (columns,) = torque_ripple.regressors([view], shape)
    found = torque_ripple.EFFECT.inverse.parameters(shape, np.linalg.lstsq(columns, torque, rcond=None)[0])
    assert found["amplitude_nm"] == pytest.approx(0.3) and found["phase_rad"] == pytest.approx(0.4)
    assert found["second_amplitude_nm"] == pytest.approx(0.1) and found["second_phase_rad"] == pytest.approx(-1.0)


def test_a_transmission_error_has_one_formula_both_ways() -> None:
    time_s = 0.001 * np.arange(4000)
    q = 0.5 * np.sin(2.0 * time_s)
    view = replace(_spinning(np.zeros_like(q), q, 0.001, gear_ratio=100.0), load_nm=3.0 * np.cos(q))
    (columns,) = transmission_error.regressors([view], {"first": 2.0})
    amplitude, phase = 1e-4, 0.7
    forward = [
        transmission_error.friction(0.0, v, x, load, 0.2, a, 100.0, amplitude, 2.0, phase, 0.0, 4.0, 0.0)
        for v, x, load, a in zip(view.velocity_rad_s, q, view.load_nm, view.acceleration_rad_s2, strict=True)
    ]
    weights = np.linalg.lstsq(columns, np.array(forward), rcond=None)[0]
    found = transmission_error.EFFECT.inverse.parameters({"first": 2.0}, weights)
    assert found["amplitude_rad"] == pytest.approx(amplitude) and found["phase_rad"] == pytest.approx(phase)


def test_driving_and_back_driving_are_told_apart() -> None:
    time_s = 0.001 * np.arange(4000)
    q = 0.5 * np.sin(2.0 * time_s)
    view = replace(_spinning(np.zeros_like(q), q, 0.001), load_nm=3.0 * np.cos(q) + 1.0)
    (columns,) = directional_efficiency.EFFECT.inverse.regressors([view], {})
    loads = zip(view.load_nm, view.slip, strict=True)
    forward = np.array([directional_efficiency.level(0.0, load, s, 0.2, 0.05) * s for load, s in loads])
    assert np.linalg.lstsq(columns, forward, rcond=None)[0] == pytest.approx([0.2, 0.05])


def test_a_joint_that_drives_worse_than_it_is_driven_back_comes_to_rest() -> None:
    lossy = {"directional_efficiency": {"driving_share": 0.15, "backdriving_share": 0.02}}
    time_s = 0.002 * np.arange(2000)
    command = 0.3 + 0.2 * np.clip(time_s, 0.0, 1.0)
    stiff = Controller(5e3, 1e5, 80.0, rate_hz=2000.0, velocity_filter_s=0.0, torque_limit_nm=60.0)
    held = closed_loop(bare(gravity_cos_nm=20.0).with_effects(lossy), stiff, time_s, command)
    assert np.max(np.abs(held.velocity_rad_s[-500:])) < 1e-6
