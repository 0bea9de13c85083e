"""SDO at the wire: transcripts of CiA 301's protocol, every abort code, and garbage."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_drivers.virtual.objects import OBJECTS, DataType


@pytest.mark.parametrize(
    ("request_frame", "reply_frame"),
    [
        ("4000100000000000", "4300100092010200"),  # device type, expedited upload of 4 bytes
        ("4061600000000000", "4f61600000000000"),  # mode display, 1 byte
        ("4041600000000000", "4b41600050020000"),  # statusword, 2 bytes: switch-on disabled, remote
        ("2f60600008000000", "6060600000000000"),  # mode 8, expedited download of 1 byte
        ("2260600009000000", "6060600000000000"),  # expedited without a size: the type decides
        ("2341600000000000", "8041600002000106"),  # statusword is read-only
        ("2300100000000000", "8000100002000106"),  # const as well
        ("4000300000000000", "8000300000000206"),  # no such object
        ("4018100900000000", "8018100911000906"),  # no such subindex
        ("2b60600008000000", "8060600012000706"),  # two bytes into one
        ("2f40600006000000", "8040600013000706"),  # one byte into two
        ("2f60600005000000", "8060600030000906"),  # mode 5 is not supported
        ("2b5a600008000000", "805a600031000906"),  # 605A above 7
        ("2b5a6000ffff0000", "805a600032000906"),  # 605A below 0
        ("2303100001000000", "8003100012000706"),  # four bytes into the count of 1003
        ("2f03100001000000", "8003100030000906"),  # only 0 clears the history
        ("4003100100000000", "8003100111000906"),  # the history is empty
        ("a041600000000000", "8041600001000405"),  # block upload is not supported
        ("c041600000000000", "8041600001000405"),  # nor block download
        ("6000000000000000", "8000000001000405"),  # a segment that nobody asked for
        ("0000000000000000", "8000000001000405"),
        ("e000000000000000", "8000000001000405"),
    ],
)
def test_transcript(desk, request_frame, reply_frame):
    assert desk.send(0x605, request_frame) == [(0x585, reply_frame)]


def test_segmented_upload(desk):
    assert desk.send(0x605, "4008100000000000") == [(0x585, "4108100015000000")]
    text = b""
    for request in ("60", "70", "60"):
        ((_, reply),) = desk.send(0x605, request + "00" * 7)
        frame = bytes.fromhex(reply)
        assert frame[0] & 0x10 == int(request, 16) & 0x10
        text += frame[1 : 8 - (frame[0] >> 1 & 7)]
    assert frame[0] & 1 and text == b"frictid virtual servo"


def test_segmented_download_and_back(desk):
    note = b"calibrated 2026-11-21, joint 3"
    assert desk.send(0x605, b"\x21\x01\x20\x00" + struct.pack("<I", len(note))) == [(0x585, "6001200000000000")]
    for start in range(0, len(note), 7):
        piece, toggle = note[start : start + 7], start // 7 % 2
        command = toggle << 4 | (7 - len(piece)) << 1 | (start + 7 >= len(note))
        reply = desk.send(0x605, bytes([command]) + piece.ljust(7, b"\0"))
        assert reply == [(0x585, bytes([0x20 | toggle << 4]).hex() + "00" * 7)]
    assert desk.servo.dictionary.values[0x200100] == note.decode()


def test_empty_string_is_uploaded_as_one_empty_segment(desk):
    assert desk.send(0x605, "4001200000000000") == [(0x585, "4101200000000000")]
    assert desk.send(0x605, "6000000000000000") == [(0x585, "0f00000000000000")]


def test_toggle_bit_must_alternate(desk):
    desk.send(0x605, "4008100000000000")
    desk.send(0x605, "6000000000000000")
    assert desk.send(0x605, "6000000000000000") == [(0x585, "8008100000000305")]
    # The transfer is over; the next segment has nothing to belong to.
    assert desk.send(0x605, "7000000000000000") == [(0x585, "8000000001000405")]


def test_segmented_download_of_another_length_than_announced(desk):
    desk.send(0x605, b"\x21\x01\x20\x00" + struct.pack("<I", 3))
    assert desk.send(0x605, "0061626364000000") == [(0x585, "8001200010000706")]
    desk.send(0x605, b"\x21\x01\x20\x00" + struct.pack("<I", 9))
    assert desk.send(0x605, "0161626364000000") == [(0x585, "8001200010000706")]
    desk.send(0x605, b"\x21\x01\x20\x00" + struct.pack("<I", 5000))
    assert desk.servo.dictionary.values[0x200100] == ""


def test_new_request_ends_a_transfer_and_an_abort_too(desk):
    desk.send(0x605, "4008100000000000")
    assert desk.read(0x1000) == 0x20192
    assert desk.send(0x605, "6000000000000000")[0][1].startswith("80")
    desk.send(0x605, "4008100000000000")
    assert desk.send(0x605, "8008100000000405") == []
    assert desk.send(0x605, "6000000000000000")[0][1].startswith("80")


def test_no_answer_in_stopped_nor_to_short_frames(desk):
    assert desk.send(0x605, "400010000000") == []
    desk.send(0x000, "0205")
    assert desk.send(0x605, "4000100000000000") == []
    desk.send(0x000, "8005")
    assert desk.read(0x1000) == 0x20192


def test_every_object_can_be_read_or_says_why_not(desk):
    for record in OBJECTS:
        for entry in record.entries:
            if entry.kind is DataType.STRING:
                continue
            code = desk.abort_of_read(record.index, entry.key & 0xFF)
            empty_history = record.index == 0x1003 and entry.key & 0xFF
            assert code == (0x06090011 if empty_history else 0), hex(entry.key)


def test_every_number_is_read_back_as_written(desk):
    """All widths and signs: the highest and lowest value of every plain parameter come back as sent."""
    skip = {0x1005, 0x1010, 0x1011, 0x1016, 0x1017, 0x1019, 0x1003, 0x6040, 0x6060, 0x60A9, 0x2040, 0x2041}
    seen = set()
    for record in OBJECTS:
        for entry in record.entries:
            if entry.access != "rw" or entry.kind is DataType.STRING:
                continue
            if record.index in skip or 0x1400 <= record.index < 0x1C00:
                continue
            size = {1: 1, 2: 1, 3: 2, 4: 4, 5: 1, 6: 2, 7: 4}[entry.kind]
            seen.add(entry.kind)
            for value in entry.limits:
                assert desk.write(record.index, entry.key & 0xFF, value, size) == 0
                signed = entry.kind in (2, 3, 4)
                assert desk.read(record.index, entry.key & 0xFF, signed=signed) == value
    assert seen == {DataType.I8, DataType.I16, DataType.I32, DataType.U8, DataType.U16, DataType.U32}


def test_stored_parameters_survive_a_reset(desk):
    desk.write(0x6065, 0, 1234, 4)
    desk.send(0x000, "8105")
    assert desk.read(0x6065) == 100_000
    desk.write(0x6065, 0, 1234, 4)
    assert desk.write(0x1010, 1, 0x12345678, 4) == 0x08000020
    assert desk.write(0x1010, 1, 0x65766173, 4) == 0
    desk.send(0x000, "8105")
    assert desk.read(0x6065) == 1234
    assert desk.write(0x1011, 1, 0x64616F6C, 4) == 0
    desk.send(0x000, "8105")
    assert desk.read(0x6065) == 100_000


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(frames=st.lists(st.binary(min_size=0, max_size=8), min_size=1, max_size=12))
def test_garbage_gets_one_answer_per_whole_frame(make_desk, frames):
    desk = make_desk()
    for frame in frames:
        answers = desk.said(0x585, desk.send(0x605, frame))
        expected = 1 if len(frame) == 8 and frame[0] >> 5 != 4 and desk.servo.nmt_state != 4 else 0
        assert len(answers) == expected
        assert all(len(answer) == 16 for answer in answers)
        if expected and frame[0] >> 5 in (5, 6, 7):
            assert answers[0].startswith("80") and answers[0].endswith("01000405")
    assert desk.read(0x1000) == 0x20192
