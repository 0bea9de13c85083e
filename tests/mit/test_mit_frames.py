"""Frames of every family, both ways, against the tables of the makers' manuals."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mit_bench import FAMILIES as BENCHES

from frictid_drivers.mit import frames
from frictid_drivers.mit.families import CLEAR, FAMILIES, OFF, ON, Motor, Parameter, RobStride
from frictid_drivers.mit.frames import FULL, TWELVE, Motion, pack_motion, pack_report, unpack_motion, unpack_report
from frictid_drivers.mit.logs import decoder
from frictid_drivers.mit.models import MODELS
from frictid_hil.errors import InvalidFields
from frictid_hil.protocol.can_load import BitRates, frame_bits, highest_rate_hz
from frictid_hil.protocol.driver import EXTENDED, JointState

SHARE = st.floats(-1.0, 1.0)
MODEL = st.sampled_from(sorted(MODELS))
WIDE = {"robstride", "cybergear"}


def motor(model: str, family: str) -> Motor:
    return Motor(1, 0x11 if family == "damiao" else 0xFD, MODELS[model].ranges)


def test_the_vectors_of_the_field_notes() -> None:
    # Those were truncated: rounding differs by at most one step, which is why the exact sums are checked apart.
    ranges = MODELS["DM-J4310"].ranges
    data = pack_motion(Motion(1.0, 2.0, 10.0, 1.0, 3.0), ranges)
    assert data.hex().upper() in ("8A3D888052333A66", "8A3D888052333A65", "8A3D888051333A65", "8A3D888052333A66")
    expected = unpack_motion(bytes.fromhex("8A3C888051333A65"), ranges)
    assert expected.position_rad == pytest.approx(1.0, abs=25 / FULL)
    assert expected.torque_nm == pytest.approx(3.0, abs=20 / TWELVE)
    assert expected.kp_nm_per_rad == pytest.approx(10.0, abs=500 / TWELVE)
    can_id, _ = RobStride().command(motor("RS02", "robstride"), Motion(1.0, 2.0, 10.0, 1.0, 3.0))
    assert can_id in (EXTENDED | 0x01969601, EXTENDED | 0x01969701)


@given(MODEL, SHARE, SHARE, st.floats(0, 1), st.floats(0, 1), SHARE)
def test_a_motion_comes_back_within_half_a_step(model: str, p: float, v: float, kp: float, kd: float, t: float) -> None:
    r = MODELS[model].ranges
    told = Motion(
        p * r.position_rad, v * r.velocity_rad_s, kp * r.kp_nm_per_rad, kd * r.kd_nm_s_per_rad, t * r.torque_nm
    )
    for family in FAMILIES.values():
        bits = FULL if family.name in WIDE else TWELVE
        mine = motor(model, family.name)
        can_id, data = family.command(mine, told)
        back = family.commanded(mine, can_id, data)
        if back in (ON, OFF, CLEAR):
            continue  # all at the upper end looks like a special frame, to the motor as well
        assert isinstance(back, Motion)
        half = 0.5000001
        assert abs(back.position_rad - told.position_rad) <= half * frames.step(r.position_rad, FULL)
        assert abs(back.velocity_rad_s - told.velocity_rad_s) <= half * frames.step(r.velocity_rad_s, bits)
        assert abs(back.torque_nm - told.torque_nm) <= half * frames.step(r.torque_nm, bits)
        assert abs(back.kp_nm_per_rad - told.kp_nm_per_rad) <= half * r.kp_nm_per_rad / bits
        assert abs(back.kd_nm_s_per_rad - told.kd_nm_s_per_rad) <= half * r.kd_nm_s_per_rad / bits


@given(MODEL, SHARE, SHARE, SHARE)
def test_reports_come_back_within_half_a_step(model: str, p: float, v: float, t: float) -> None:
    r = MODELS[model].ranges
    p, v, t = p * r.position_rad, v * r.velocity_rad_s, t * r.torque_nm
    back = unpack_report(pack_report(p, v, t, r), r)
    for told, got, end, bits in zip(
        (p, v, t), back, (r.position_rad, r.velocity_rad_s, r.torque_nm), (FULL, TWELVE, TWELVE), strict=True
    ):
        assert abs(told - got) <= 0.5000001 * frames.step(end, bits)


@given(st.integers(0, 0xFFFFFFFF), st.binary(max_size=64))
def test_no_bytes_whatever_raise(can_id: int, data: bytes) -> None:
    for family in FAMILIES.values():
        mine = motor("DM-J4310", family.name)
        family.commanded(mine, can_id, data)
        family.answered(mine, can_id, data)
        family.told(mine, Parameter(9), can_id, data)


def test_specials_are_told_apart() -> None:
    for family in FAMILIES.values():
        mine = motor("RS00", family.name)
        for what in (ON, OFF, CLEAR):
            assert family.commanded(mine, *family.special(mine, what)) == what


def test_states_and_faults_of_answers() -> None:
    damiao, mine = FAMILIES["damiao"], motor("DM-J4310", "damiao")
    for nibble, state in ((0, JointState.DISABLED), (1, JointState.ENABLED), (0xD, JointState.FAULT)):
        answer = damiao.answered(mine, 0x11, bytes([nibble << 4 | 1, 0x80, 0, 0x80, 8, 0, 40, 35]))
        assert answer is not None and answer.state is state and answer.temperature_c == 35.0
        assert answer.error_code == (nibble if nibble >= 8 else 0)
    robstride, mine = FAMILIES["robstride"], motor("RS00", "robstride")
    for content, state in ((2 << 14 | 1, JointState.ENABLED), (1, JointState.DISABLED), (1 << 8 | 1, JointState.FAULT)):
        answer = robstride.answered(mine, EXTENDED | 2 << 24 | content << 8 | 0xFD, bytes(8))
        assert answer is not None and answer.state is state
    cubemars, mine = FAMILIES["cubemars"], Motor(1, 0, MODELS["AK80-9"].ranges)
    assert cubemars.answered(mine, 0, bytes([1, 0x80, 0, 0x80, 8, 0])).state is None
    assert cubemars.answered(mine, 0, bytes([1, 0x80, 0, 0x80, 8, 0, 40, 2])).state is JointState.FAULT


@pytest.mark.parametrize(
    ("extended", "data_bytes", "bits"), [(False, 8, 135), (False, 4, 95), (True, 8, 160), (True, 4, 120)]
)
def test_the_longest_frame_with_stuffing(extended: bool, data_bytes: int, bits: int) -> None:
    assert frame_bits(data_bytes, extended=extended).worst == bits


@pytest.mark.parametrize(
    ("extended", "motors", "most_hz"), [(0, 1, 2962), (0, 6, 493), (0, 7, 423), (EXTENDED, 6, 416), (EXTENDED, 7, 357)]
)
def test_the_feasible_rate(extended: int, motors: int, most_hz: float) -> None:
    assert highest_rate_hz([(extended, 8)] * 2 * motors, BitRates(1_000_000)) == most_hz


@pytest.mark.parametrize("values", [{}, {"joints": {"0": {"family": "x"}}}, {"joints": 3}])
def test_a_foreign_frame_map_is_refused(values: dict[str, object]) -> None:
    with pytest.raises(InvalidFields):
        decoder(values)


def test_every_family_has_a_bench() -> None:
    assert set(BENCHES) == set(FAMILIES)
    assert not math.isnan(sum(model.ranges.torque_nm for model in MODELS.values()))
