"""Drives whose CANopen another author wrote, over the loopback interface; calibrating ten of them is a benchmark."""

from __future__ import annotations

import importlib
import socket
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
pytest.importorskip("durand", reason="durand (of the extra dev) is not installed")
pytest.importorskip("msgpack", reason="msgpack (of the extra dev) is not installed")

strangers = importlib.import_module("strangers")


def multicast() -> bool:
    """Whether a datagram to a group comes back here."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.settimeout(1.0)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            one.bind(("", 0))
            group = socket.inet_aton("239.74.1.1") + socket.inet_aton("0.0.0.0")
            one.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
            one.sendto(b"here", ("239.74.1.1", one.getsockname()[1]))
            return one.recv(8) == b"here"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not multicast(), reason="no UDP multicast on this machine")
@pytest.mark.parametrize("family", ["elmo", "nanotec"])
def test_check_foresees_what_configuring_a_drive_with_anothers_canopen_meets(family, tmp_path):
    met = strangers.configured(tmp_path, family)
    assert not met.errors and not met.ended
    assert met.remarks <= met.warnings


@pytest.mark.skipif(not multicast(), reason="no UDP multicast on this machine")
def test_what_a_person_must_say_is_foreseen_there_too(tmp_path, monkeypatch):
    monkeypatch.setitem(strangers.NEEDS, "epos4", {})
    met = strangers.configured(tmp_path, "epos4")
    assert any("tells neither its position unit" in error for error in met.errors) and "tells neither" in met.ended
