"""The bus of drivers by others, on a real bus of python-can: which frames go out, and what is read of them."""

from __future__ import annotations

import os

import can
import pytest

from frictid_hil.errors import HardwareBusy
from frictid_hil.protocol.can_line import CanLine
from frictid_hil.protocol.driver import EXTENDED, FD_FRAME, WallClock

FRAMES = [
    (0x123, b"\x01\x02"),
    (EXTENDED | 0x8001, bytes(8)),
    (FD_FRAME | 0x123, bytes(48)),
    (EXTENDED | FD_FRAME | 0x8001, bytes(24)),
]


@pytest.mark.parametrize(("can_id", "data"), FRAMES)
def test_flags_of_an_identifier_make_the_frame_and_come_back(can_id, data):
    channel = f"line-{os.getpid()}"
    heard = []
    line = CanLine(f"virtual:{channel}", {"fd": True}, lambda *frame: heard.append(frame), WallClock())
    try:
        with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as other:
            line.send(can_id, data)
            message = other.recv(1.0)
            assert message is not None and bytes(message.data) == data
            assert message.is_extended_id is bool(can_id & EXTENDED)
            assert message.is_fd is message.bitrate_switch is bool(can_id & FD_FRAME)
            other.send(message)
            ((_, back, again),) = line.received()
            assert (back, again) == (can_id, data)
        assert [(told, sent) for _, told, _, sent in heard] == [(can_id, True), (can_id, False)]
    finally:
        line.close()


def test_one_bus_has_one_owner_and_a_rate_of_its_own():
    bus = f"virtual:owner-{os.getpid()}"
    classical = CanLine(bus, {"bitrate": 500_000}, None, WallClock())
    try:
        with pytest.raises(HardwareBusy):
            CanLine(bus, {}, None, WallClock())
        assert classical.highest_rate_hz([(1, 8), (2, 8)]) == 1481
    finally:
        classical.close()
    fast = CanLine(bus, {"fd": True, "data_bitrate": 5_000_000}, None, WallClock())
    assert fast.highest_rate_hz([(FD_FRAME | 1, 8), (FD_FRAME | 2, 8)]) == 7067
    fast.close()
