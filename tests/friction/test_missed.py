"""A missed set-point shakes the joint: what its torque does then is no friction."""

from dataclasses import replace

import numpy as np
import pytest

from frictid_hil.friction.cleaned import without_shakes
from frictid_hil.friction.estimate import estimate

SHOOK_NM = (-80.0, 57.0, 50.0)
"""What a drive at 250 Hz did after one missed set-point, as parts of its torque."""


@pytest.fixture(scope="module")
def coarse(plants):
    """Three cycles at 250 Hz."""
    fine = plants.record(plants.arm[2], replace(plants.procedure(20), cycles=3))
    every = round(0.004 / float(np.median(np.diff(fine.time_s))))
    columns = ("time_s", "position_rad", "velocity_rad_s", "torque_nm")
    return replace(fine, **{name: getattr(fine, name)[::every] for name in columns})


def missed(recording, at: int):
    """Without that row, and with the torque that its drive had after it."""
    torque = recording.torque_nm.copy()
    torque[at + 1 : at + 1 + len(SHOOK_NM)] += SHOOK_NM
    columns = ("time_s", "position_rad", "velocity_rad_s")
    return replace(
        recording,
        torque_nm=np.delete(torque, at),
        **{name: np.delete(getattr(recording, name), at) for name in columns},
    )


def fastest_row(recording, cycle: int) -> int:
    """Of a cycle, forwards."""
    begin, end = np.searchsorted(recording.time_s, recording.procedure.cycle_starts_s[cycle : cycle + 2])
    return int(begin + np.argmax(recording.velocity_rad_s[begin:end]))


def test_without_a_gap_nothing_is_touched(coarse):
    assert without_shakes(coarse) == (coarse, 0)


@pytest.mark.slow
def test_a_missed_set_point_in_a_window_does_not_bend_the_curve(coarse, monkeypatch):
    usual = np.array(estimate(coarse, "aligned").curve.torque_nm)
    spoilt = missed(coarse, fastest_row(coarse, 1))
    found = estimate(spoilt, "aligned")
    np.testing.assert_allclose(found.curve.torque_nm, usual, rtol=0.01)
    assert any("1 missed set-points" in note for note in found.notes)
    monkeypatch.setattr("frictid_hil.friction.cleaned.without_shakes", lambda recording: (recording, 0))
    bent = np.array(estimate(spoilt, "aligned").curve.torque_nm)
    assert np.max(np.abs(bent / usual - 1.0)) > 0.02


def test_where_the_joint_turns_round_nothing_is_touched(coarse):
    """Friction itself jumps there."""
    row = fastest_row(coarse, 1)
    turn = row + int(np.argmax(coarse.velocity_rad_s[row:] <= 0.0))
    assert without_shakes(missed(coarse, turn))[1] == 0


def test_a_gap_that_shook_nothing_stays_as_it_is(coarse):
    row = fastest_row(coarse, 1)
    columns = ("time_s", "position_rad", "velocity_rad_s", "torque_nm")
    gap = replace(coarse, **{name: np.delete(getattr(coarse, name), row) for name in columns})
    assert without_shakes(gap)[1] == 0
