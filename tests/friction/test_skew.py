"""By how much torque is late, from shaking: found where the declaration is wrong, on joints written differently."""

from dataclasses import replace

import numpy as np
import pytest

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.link import soft_link
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.friction.quality import gates
from frictid_hil.friction.recording import Skew, synchronised
from frictid_hil.friction.skew import Delay, TimeSkew, measured_skew
from frictid_hil.jobs.identification.skew_stretch import shaking

STEP_S = 0.001
PLANT_S = 25e-6
"""These plants' own integration is half a step of 50 us late."""


def shaken(plants, joint, recording, *, seed=1):
    """The shaking of the joint, declared as its cycles are."""
    motions = shaking(joint.start, recording.procedure)
    still = np.full(300, joint.start)
    moving = [motion.position_rad(np.arange(round(motion.duration_s / STEP_S)) * STEP_S) for motion in motions]
    command = np.concatenate([still, *moving, still])
    q, _, f = plants.drive(joint, command, np.gradient(command, STEP_S), seed=seed)
    time_s = (np.arange(command.size) - still.size) * STEP_S
    return replace(
        recording, time_s=time_s, position_rad=q, torque_nm=f, velocity_rad_s=None, command_rad=None, repeat=None
    )


def declared(recording, wrong_s, uncertainty_s=2e-4):
    """The same samples, their torque declared to be less late than it is."""
    return replace(recording, skew=Skew(torque_delay_s=STEP_S / 2 - wrong_s, uncertainty_s=uncertainty_s))


@pytest.mark.slow
@pytest.mark.parametrize("wrong_s", [-2e-3, 4e-3])
@pytest.mark.parametrize(("index", "amplitude"), [(0, 20), (1, 5), (3, 10)])
def test_a_wrong_declaration_is_found_to_a_twentieth_of_a_millisecond(plants, index, amplitude, wrong_s):
    joint = plants.arm[index]
    recording = declared(plants.record(joint, plants.procedure(amplitude), repeat=False), wrong_s)
    found = measured_skew(shaken(plants, joint, recording))
    assert found.delay_s - wrong_s == pytest.approx(PLANT_S, abs=5e-5)
    assert abs(found.delay_s - wrong_s - PLANT_S) < 3 * found.deviation_s < 2e-4


def test_ripple_that_multiplies_the_friction_drags_it_little(plants):
    joint = replace(plants.arm[1], ripple=0.1)
    recording = declared(plants.record(joint, plants.procedure(20), repeat=False), 0.0)
    assert measured_skew(shaken(plants, joint, recording)).delay_s == pytest.approx(PLANT_S, abs=5e-5)


@pytest.mark.slow
def test_a_soft_link_is_taken_off_first(plants):
    joint = replace(plants.arm[2], link_share=0.5, link_frequency_hz=24.0)
    recording = declared(plants.record(joint, plants.procedure(20)), 0.0)
    link = soft_link(recording, synchronised(recording), 20.0)
    stretch = shaken(plants, joint, recording)
    assert abs(measured_skew(stretch).delay_s - PLANT_S) > 1e-4
    assert abs(measured_skew(stretch, link).delay_s - PLANT_S) < 5e-5


@pytest.mark.slow
def test_a_link_that_swings_with_the_shaking_leaves_the_declared_timing(plants):
    joint = replace(plants.arm[3], link_share=0.5, link_frequency_hz=24.0)
    recording = declared(plants.record(joint, plants.procedure(20)), 0.0)
    result = estimate(replace(recording, shaken=shaken(plants, joint, recording)))
    assert result.time_skew is None
    assert any("would feign a delay" in note for note in result.notes)


@pytest.mark.slow
def test_a_curve_that_a_wrong_declaration_bends_is_straightened_and_flagged(plants):
    joint, top = plants.arm[1], plants.procedure(10).velocity_rad_s
    recording = declared(plants.record(joint, plants.procedure(10)), 1e-3)
    as_declared = estimate(recording)
    measured = estimate(replace(recording, shaken=shaken(plants, joint, recording)))
    bent, straight = (
        curve_distance(found.curve, joint.truth(top), top).e_percent_measured_range for found in (as_declared, measured)
    )
    assert bent > 2.0
    assert straight < 0.5
    (gate,) = [gate for gate in gates(recording, measured) if gate.name == "time_skew"]
    assert not gate.passed
    assert "0.52" in gate.reason and "-0.500 +- 0.400 ms as declared" in gate.reason
    assert measured.time_skew.used_s == measured.time_skew.measured_s


@pytest.mark.slow
def test_a_right_declaration_gives_narrower_intervals_and_passes(plants):
    joint = plants.arm[1]
    recording = declared(plants.record(joint, plants.procedure(5)), 0.0)
    as_declared = estimate(recording)
    measured = estimate(replace(recording, shaken=shaken(plants, joint, recording)))
    assert measured.half_width_nm[-1] < 0.7 * as_declared.half_width_nm[-1]
    (gate,) = [gate for gate in gates(recording, measured) if gate.name == "time_skew"]
    assert gate.passed


def test_both_count_by_their_precision():
    both = TimeSkew.of(Skew(torque_delay_s=1e-3, position_delay_s=2e-4, uncertainty_s=3e-4), Delay(4e-4, 4e-4))
    assert both.declared_s == pytest.approx(8e-4)
    assert both.measured_s == pytest.approx(12e-4)
    assert both.used_s == pytest.approx(8e-4 + 4e-4 * 9 / 25)
    assert both.used_deviation_s == pytest.approx(2.4e-4)
    corrected = both.corrected(Skew(torque_delay_s=1e-3, position_delay_s=2e-4))
    assert corrected.torque_delay_s - corrected.position_delay_s == pytest.approx(both.used_s)


def test_what_did_not_shake_tells_nothing(plants):
    joint = plants.arm[1]
    recording = plants.record(joint, plants.procedure(20))
    stretch = shaken(plants, joint, recording)
    cut = stretch.time_s < 1.0
    short = replace(
        stretch, time_s=stretch.time_s[cut], position_rad=stretch.position_rad[cut], torque_nm=stretch.torque_nm[cut]
    )
    with pytest.raises(IdentificationError, match="cannot be told"):
        measured_skew(short)


@pytest.mark.parametrize("amplitude", [3, 5, 10, 20, 50, 120])
def test_shaking_keeps_to_what_the_cycles_do(plants, amplitude):
    procedure = plants.procedure(amplitude)
    time_s = np.arange(0.0, 2.0, 1e-4)
    for motion in shaking(0.4, procedure):
        position = motion.position_rad(time_s) - 0.4
        speed = np.diff(position) / 1e-4
        assert position.min() >= -1e-9 and position.max() <= procedure.amplitude_rad * (1 + 1e-9)
        assert np.abs(speed).max() <= procedure.velocity_rad_s
        assert np.abs(np.diff(speed)).max() / 1e-4 <= 2 * procedure.velocity_rad_s**2 / procedure.amplitude_rad
        assert motion.position_rad(np.array([2.0]))[0] == pytest.approx(0.4)
        moving = speed[np.abs(speed) > 1e-6]
        assert np.count_nonzero(np.diff(np.sign(moving))) == 2 * motion.turns - 1
