"""The description of frames as plain values: round trip, and every mistake named where it is."""

from __future__ import annotations

import json
import math
from dataclasses import fields

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from frictid_drivers.cia402.frame_map import Frame, FrameMap, JointFrames
from frictid_drivers.cia402.objects import Entry, IntegerType
from frictid_hil.errors import InvalidFields

HAND_WRITTEN = """
schema: frictid.frames/1
sync_cob_id: 128
joints:
  "1":
    node: 2
    position_rad_per_unit: 4.793689960306688e-07
    velocity_rad_s_per_unit: 1.0471975511965977e-06
    torque_nm_per_unit: 0.2131
    external_torque_nm_per_unit: 0.001
    reports:
    - cob_id: 386
      objects: ["6041:00 u16", "6064:00 i32", "6077:00 i16"]
    - cob_id: 642
      objects: ["606C:00 i32", "2401:00 i16 external_torque"]
    commands:
    - cob_id: 514
      objects: ["6040:00 u16", "607A:00 i32", "60B2:00 i16"]
"""


def hand_written():
    return yaml.safe_load(HAND_WRITTEN)


def test_hand_written_map():
    joint = FrameMap.from_mapping(hand_written()).joints[0]
    assert [frame.meanings for frame in joint.reports] == [
        ("status", "position", "torque"),
        ("velocity", "external_torque"),
    ]
    assert joint.commands[0].size == 8 and joint.reports[1].size == 6


finite = st.floats(allow_nan=False, allow_infinity=False).filter(bool)
entries = st.builds(
    Entry,
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    st.builds(IntegerType, st.booleans(), st.sampled_from([1, 8, 16, 24, 32])),
    st.sampled_from(["", "external_torque", "temperature", "position", "status"]),
).filter(lambda entry: Entry.parse(str(entry)) == entry)


PER_UNIT = [one.name for one in fields(JointFrames) if "_per_unit" in one.name]


@st.composite
def frame_maps(draw):
    ids = iter(draw(st.lists(st.integers(1, 0x5FF), min_size=9, max_size=9, unique=True)))
    joints = []
    for name in draw(st.lists(st.text("abc012", min_size=1), min_size=1, max_size=3, unique=True)):
        frames = [
            Frame(next(ids), tuple(draw(st.lists(entries, min_size=1, max_size=2))))
            for _ in range(draw(st.integers(0, 3)))
        ]
        node, worth = draw(st.integers(1, 127)), {name: draw(finite) for name in PER_UNIT}
        joints.append(JointFrames(name, node, **worth, reports=tuple(frames)))
    return FrameMap(tuple(joints), draw(st.one_of(st.none(), st.integers(0, 0x7FF))), draw(st.integers(0, 10**9)))


@pytest.mark.slow
@given(frame_maps())
def test_round_trip_through_json_and_yaml(frame_map):
    """Factors must survive to the last bit: replay multiplies by them."""
    plain = frame_map.to_mapping()
    assert FrameMap.from_mapping(json.loads(json.dumps(plain))) == frame_map
    assert FrameMap.from_mapping(yaml.safe_load(yaml.safe_dump(plain, sort_keys=False))) == frame_map


def test_absent_factors_stay_absent():
    joint = FrameMap.from_mapping(hand_written()).joints[0]
    assert math.isnan(joint.temperature_c_per_unit)
    assert "temperature_c_per_unit" not in FrameMap((joint,)).to_mapping()["joints"]["1"]


@pytest.mark.parametrize(
    ("change", "path", "words"),
    [
        (lambda m: m.update(schema="frictid.frames/9"), ("schema",), "frictid.frames/1"),
        (lambda m: m.update(extra=1), ("extra",), "unknown key"),
        (lambda m: m.update(sync_cob_id="128"), ("sync_cob_id",), "whole number"),
        (lambda m: m.update(joints={}), ("joints",), "at least one joint"),
        (lambda m: m["joints"]["1"].update(node=0), ("joints", "1", "node"), "1..127"),
        (lambda m: m["joints"]["1"].update(nod=1), ("joints", "1", "nod"), "unknown key"),
        (
            lambda m: m["joints"]["1"].pop("torque_nm_per_unit"),
            ("joints", "1", "torque_nm_per_unit"),
            "reported torque",
        ),
        (
            lambda m: m["joints"]["1"].update(position_rad_per_unit=0),
            ("joints", "1", "position_rad_per_unit"),
            "other than 0",
        ),
        (
            lambda m: m["joints"]["1"]["reports"][0].update(objects=["6064:00"]),
            ("joints", "1", "reports", 0, "objects", 0),
            "of the form",
        ),
        (
            lambda m: m["joints"]["1"]["reports"][0].update(objects=["2000:00 i16 wind"]),
            ("joints", "1", "reports", 0, "objects", 0),
            "unknown meaning",
        ),
        (
            lambda m: m["joints"]["1"]["reports"][0].update(objects=["6064:00 i32"] * 17),
            ("joints", "1", "reports", 0, "objects"),
            "68 bytes",
        ),
        (lambda m: m["joints"]["1"]["reports"][0].update(cob_id=514), ("joints", "1"), "described twice"),
        (lambda m: m["joints"]["1"].update(reports="386"), ("joints", "1", "reports"), "list of frames"),
    ],
)
def test_every_mistake_is_named(change, path, words):
    mapping = hand_written()
    change(mapping)
    with pytest.raises(InvalidFields) as caught:
        FrameMap.from_mapping(mapping)
    assert any(problem.path == path and words in problem.message for problem in caught.value.problems), caught.value


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@pytest.mark.slow
@given(st.sampled_from(["schema", "sync_cob_id", "window_ns", "joints"]), plain)
def test_garbage_is_refused_not_fatal(key, value):
    mapping = hand_written()
    mapping[key] = value
    try:
        FrameMap.from_mapping(mapping)
    except InvalidFields as error:
        assert error.problems


@pytest.mark.slow
@given(st.sampled_from(["node", "reports", "commands", "position_rad_per_unit"]), plain)
def test_garbage_in_a_joint_is_refused_not_fatal(key, value):
    mapping = hand_written()
    mapping["joints"]["1"][key] = value
    try:
        FrameMap.from_mapping(mapping)
    except InvalidFields as error:
        assert error.problems
