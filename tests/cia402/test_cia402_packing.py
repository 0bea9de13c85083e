"""Integers to bytes and back for any mapping a drive may have; short and odd frames."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_drivers.cia402.codec import packing
from frictid_drivers.cia402.objects import IntegerType

any_type = st.builds(IntegerType, st.booleans(), st.integers(1, 64))


@st.composite
def mapping_with_values(draw):
    types, room = [], 64
    while room and (not types or draw(st.booleans())):
        kind = draw(st.one_of(any_type, st.sampled_from([IntegerType.parse(t) for t in ("u8", "i16", "i32", "u16")])))
        if kind.bits > room:
            break
        types.append(kind)
        room -= kind.bits
    return types, [draw(st.integers(kind.low, kind.high)) for kind in types]


@pytest.mark.slow
@given(mapping_with_values())
def test_round_trip(case):
    types, values = case
    codec = packing(types)
    buffer = bytearray(codec.size)
    codec.pack_into(buffer, 0, *values)
    assert codec.unpack_from(buffer) == tuple(values)
    assert codec.size == (sum(kind.bits for kind in types) + 7) // 8


@given(mapping_with_values())
def test_bits_follow_each_other_from_the_least_significant(case):
    """Against the definition itself, one big integer."""
    types, values = case
    codec = packing(types)
    buffer = bytearray(codec.size)
    codec.pack_into(buffer, 0, *values)
    word = shift = 0
    for kind, value in zip(types, values, strict=True):
        word |= (value % (1 << kind.bits)) << shift
        shift += kind.bits
    assert bytes(buffer) == word.to_bytes(codec.size, "little")


@given(st.lists(any_type, min_size=1, max_size=4), st.binary(max_size=8))
def test_short_frames_are_told(types, data):
    codec = packing(types)
    if len(data) < codec.size:
        with pytest.raises(struct.error):
            codec.unpack_from(data)
    else:
        assert all(kind.low <= value <= kind.high for kind, value in zip(types, codec.unpack_from(data), strict=True))


@pytest.mark.parametrize("kind", ["i8", "u16", "i24", "u1"])
def test_values_beyond_the_type_are_refused(kind):
    parsed = IntegerType.parse(kind)
    codec = packing([parsed])
    with pytest.raises(struct.error):
        codec.pack_into(bytearray(codec.size), 0, parsed.high + 1)


@pytest.mark.parametrize("text", ["", "i", "16", "u0", "u65", "f32", "i016", "u8 "])
def test_no_integer_type(text):
    with pytest.raises(ValueError, match="not an integer type"):
        IntegerType.parse(text)
