"""Torques that a script has smoothed: told from their spectrum, and compared where the filter takes nothing off."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import gap_sets
import numpy as np
import pytest
from scipy import signal

from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.gap.smoothing import as_smoothed
from frictid_hil.jobs.gap.draft import drafted


@functools.cache
def made(*effects: tuple[str, str, float]) -> ExperimentSet:
    """A joint without a controller, with some effects (name, parameter, value)."""
    nominal = replace(gap_sets.NOMINAL, controller=None)
    found = gap_sets.make({name: {parameter: value} for name, parameter, value in effects})
    return replace(found, nominal=nominal)


def smoothed(joint: ExperimentSet, hertz: float, order: int = 4) -> ExperimentSet:
    """The same handed on by somebody who low-passes forwards and backwards."""

    def passed(e: Experiment) -> Experiment:
        assert e.torque_nm is not None
        sections = signal.butter(order, hertz, fs=1.0 / e.step_s, output="sos")
        return replace(e, torque_nm=signal.sosfiltfilt(sections, e.torque_nm))

    return replace(joint, experiments=tuple(passed(e) for e in joint.experiments))


def band_hz(joint: ExperimentSet) -> float:
    """Band in which the torque can be compared."""
    return max(e.band_hz for e in as_smoothed(joint)[0].experiments)


@pytest.mark.parametrize("hertz", [4.0, 6.0, 8.0, 12.0])
def test_the_edge_of_a_smoothed_torque_is_found(hertz: float) -> None:
    found, told = as_smoothed(smoothed(made(), hertz))
    for e in found.experiments:
        assert 0.5 * hertz < e.band_hz < 0.8 * hertz, "where a fourth-order low-pass leaves nearly all"
    assert told is not None and "compared below" in told


@pytest.mark.parametrize("order", [2, 3])
def test_a_filter_of_lower_order_begins_earlier(order: int) -> None:
    assert 2.0 < band_hz(smoothed(made(), 8.0, order)) < 0.75 * 8.0


def test_a_torque_as_recorded_is_left_alone() -> None:
    joint = made()
    assert as_smoothed(joint) == (joint, None)
    for lag_s in (0.002, 0.01):  # as a drive's own filter does
        lags = [replace(e, torque_nm=lagged(e.torque_nm, lag_s, e.step_s)) for e in joint.experiments]
        assert math.isinf(band_hz(replace(joint, experiments=tuple(lags))))


def lagged(torque_nm: np.ndarray | None, lag_s: float, step_s: float) -> np.ndarray:
    """Two first-order lags in a row."""
    assert torque_nm is not None
    share = 1.0 - math.exp(-step_s / lag_s)
    return signal.lfilter([share**2], np.convolve([1.0, share - 1.0], [1.0, share - 1.0]), torque_nm)


def test_the_end_of_an_excitation_is_no_filter() -> None:
    """A heavy link on a smooth motion: its torque ends at 4 Hz, the jumps of its friction go on."""
    time_s = np.arange(0.0, 30.0, 0.002)
    waves = (0.3, 0.7, 1.1, 1.9, 2.6, 3.4)
    position = sum((0.4 / k * np.sin(2.0 * np.pi * f * time_s + k) for k, f in enumerate(waves, 1)), np.zeros(15000))
    velocity = np.gradient(position, time_s)
    torque = 40.0 * np.gradient(velocity, time_s) + 3.0 * np.tanh(velocity / 0.01) + 0.6 * velocity
    torque += 1e-4 * np.random.default_rng(1).standard_normal(time_s.size)
    log = Experiment("a", False, False, 0, time_s, position, torque_nm=torque)
    joint = ExperimentSet("heavy", replace(made().nominal, inertia_kg_m2=40.0, gravity_cos_nm=0.0), (log,))
    assert math.isinf(band_hz(joint))


def test_what_the_file_states_is_taken() -> None:
    joint = made()
    stated = replace(joint, nominal=replace(joint.nominal, torque_smoothed_hz=10.0))
    assert 4.0 < band_hz(stated) < 6.0


@pytest.mark.parametrize("cause", [("gravity_error", "error_share", 0.25), ("stribeck", "share", 0.25)])
def test_a_cause_keeps_its_name_and_its_numbers_when_the_torque_is_smoothed(cause: tuple[str, str, float]) -> None:
    told = diagnose(smoothed(made(cause), 8.0))
    assert told.verdict == "explained" and told.causes[0].effect == cause[0]
    assert told.causes[0].parameters[cause[1]].value == pytest.approx(cause[2], rel=0.35)
    assert "was low-passed at about" in told.reasons["band"]
    assert told.raw is not None and told.raw.cutoff_hz < 8.0


def test_pushes_in_a_smoothed_torque_are_no_noise() -> None:
    """Nothing tells how loud its noise was; what no model says must not be taken for it."""
    random = np.random.default_rng(5)

    def pushed(e: Experiment) -> Experiment:
        assert e.torque_nm is not None
        times_s = random.uniform(e.time_s[0], e.time_s[-1], 12)
        hands = sum(
            (random.choice([-3.0, 3.0]) * np.exp(-(((e.time_s - t) / 0.2) ** 2)) for t in times_s), 0.0 * e.time_s
        )
        return replace(e, torque_nm=e.torque_nm + hands)

    joint = made()
    joint = replace(joint, experiments=tuple(pushed(e) for e in joint.experiments))
    assert diagnose(smoothed(joint, 8.0)).verdict == "unknown"


def test_a_healthy_joint_stays_healthy_when_its_torque_is_smoothed() -> None:
    assert diagnose(smoothed(made(), 8.0)).verdict == "none"


def test_a_draft_from_smoothed_torques_has_the_joints_inertia() -> None:
    draft = drafted(smoothed(replace(made(), nominal=Nominal()), 6.0))["draft"]
    assert draft["numbers"]["inertia_kg_m2"]["value"] == pytest.approx(0.4, rel=0.15), "0.29 where the filter bends it"
    assert any("was low-passed at about" in warning for warning in draft["warnings"])
