"""Adding an effect is adding one file: two toy effects in a folder of their own are simulated, named and written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gap_sets
import pytest

from frictid_hil.gap.diagnose import diagnose
from frictid_hil.simulation import catalogue, compose, effects

CABLE = '''
"""A cable that pulls with the square of the angle: a torque that no other effect has."""
import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm


def shaft(torque_nm: float, position_rad: float, pull_nm: float) -> float:
    return torque_nm - pull_nm * position_rad * position_rad * abs(position_rad)


EFFECT = Effect(
    name="cable_pull",
    summary="A cable pulls.",
    documentation="Only in this test. Source: none.",
    parameters=(Parameter("pull_nm", -50.0, 50.0, 1.0, "at 1 rad", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.POSITION,)),
    hooks=(Hook("shaft", shaft),),
    illustrate=lambda p: Illustration("x", "y", (("cable", np.arange(3.0), np.arange(3.0)),)),
    inverse=InverseForm(
        shapes=({},),
        regressors=lambda views, shape: [(np.abs(v.position_rad) ** 3)[:, None] for v in views],
        parameters=lambda shape, coefficients: {"pull_nm": float(coefficients[0])},
    ),
)
'''

AMPLIFIER = '''
"""An amplifier behind the drive that smooths; the diagnosis is asked without the library's own lag."""
import math

import numpy as np
from scipy import signal

from frictid_hil.simulation.drive_form import ActuationForm
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature


def current(current_nm: float, state: object, at: int, step_s: float, smoothing_s: float) -> float:
    if smoothing_s <= 0.0:
        return current_nm
    state[at] += (1.0 - math.exp(-step_s / smoothing_s)) * (current_nm - state[at])
    return state[at]


def settle(state: object, at: int, torque_nm: float) -> None:
    state[at] = torque_nm


def reported(torque, smoothing_s, step_s, limit_nm):
    share = 1.0 - math.exp(-step_s / smoothing_s)
    b, a = [share], [1.0, share - 1.0]
    end = signal.lfilter(b, a, torque, zi=signal.lfilter_zi(b, a) * torque[0])[0]
    start = np.concatenate([end[:1], end[:-1]])
    return torque + (start - torque) * share * smoothing_s / step_s


EFFECT = Effect(
    name="amplifier_smoothing",
    summary="An amplifier smooths the torque.",
    documentation="Only in this test. Source: none.",
    parameters=(Parameter("smoothing_s", 0.0, 0.05, 0.004, "time constant", off=0.0),),
    signature=Signature((Channel.ACTUATION,), (Region.ACTUATION,)),
    hooks=(Hook("current", current, order=35), Hook("settle", settle)),
    illustrate=lambda p: Illustration("x", "y", (("smooth", np.arange(3.0), np.arange(3.0)),)),
    actuation=ActuationForm("smoothing_s", lambda views, seen: np.linspace(0.001, 0.02, 20), reported, late=True),
    state_size=1,
)
'''


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder: Path = tmp_path_factory.mktemp("effects")
    (folder / "cable_pull.py").write_text(CABLE)
    (folder / "amplifier_smoothing.py").write_text(AMPLIFIER)
    _forget()
    effects.__path__.append(str(folder))
    yield
    effects.__path__.remove(str(folder))
    _forget()


def _forget() -> None:
    for cached in (effects.all_effects, compose.layout, compose.kernel):
        cached.cache_clear()


@pytest.mark.slow
@pytest.mark.usefixtures("library")
@pytest.mark.parametrize(
    ("name", "parameter", "value"), [("cable_pull", "pull_nm", 3.0), ("amplifier_smoothing", "smoothing_s", 0.006)]
)
def test_a_file_is_all_it_takes(name: str, parameter: str, value: float) -> None:
    made = gap_sets.make({name: {parameter: value}})
    d = diagnose(made, library=set(effects.all_effects()) - {"electrical_lag"})
    assert d.verdict == "explained" and d.causes[0].effect == name
    assert d.causes[0].parameters[parameter].value == pytest.approx(value, rel=0.1)
    assert d.model is not None and d.model.effects[name][parameter] == pytest.approx(value, rel=0.1)
    assert f"## {name}" in catalogue.page()
