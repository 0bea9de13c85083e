"""What a rehearsal says of the torque it saw."""

import pytest

from frictid_hil.errors import SafetyAbort
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.protocol.error_words import told_error
from frictid_hil.runner.cycle import Stream
from frictid_hil.runner.sign_watch import SignWatch


def judged(forward_nm, backward_nm):
    watch = SignWatch(Stream([0.0] * 4, 0.001), "3", 0.001)
    for velocity, torque in ((0.5, forward_nm), (-0.5, backward_nm)):
        watch.update(Feedback(velocity_rad_s=velocity, torque_nm=torque), SetPoint())
    watch.judge()


def test_friction_opposes_motion():
    judged(2.0, -2.0)


def test_a_wrong_sign_is_told():
    with pytest.raises(SafetyAbort, match="friction must oppose motion"):
        judged(-2.0, 2.0)


def test_a_torque_that_never_changes_is_no_wrong_sign():
    with pytest.raises(SafetyAbort, match=r"stood at 0 N m all the way") as caught:
        judged(0.0, 0.0)
    assert "6077" in caught.value.cause


def test_error_codes_in_words():
    assert "heartbeat" in told_error(0x8130) and "sensor" in told_error(0x7305)
    assert told_error(0x0815) == "0x0815"
