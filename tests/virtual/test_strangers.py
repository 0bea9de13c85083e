"""Drives whose CANopen another author wrote, in a process of their own, over the loopback interface."""

from __future__ import annotations

import importlib
import shutil
import socket
import subprocess
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


on_multicast = pytest.mark.skipif(not multicast(), reason="no UDP multicast on this machine")


@pytest.fixture(scope="module", autouse=True)
def registered(tmp_path_factory):
    """The driver on this wire, as any installed package brings one."""
    folder = tmp_path_factory.mktemp("installed")
    strangers.register(folder)
    yield
    sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def npm_canopen(tmp_path_factory):
    """A third author's stack, for node.js; installed by its own client into a folder that goes away."""
    if missing := [program for program in ("node", "npm") if shutil.which(program) is None]:
        pytest.skip(f"{' and '.join(missing)} not installed: no CANopen of the npm package `canopen`")
    try:
        return strangers.npm_canopen(tmp_path_factory.mktemp("npm"))
    except subprocess.SubprocessError as error:
        pytest.skip(f"the npm package `canopen` cannot be had here: {error}")


@pytest.mark.slow
def test_calibrated_behind_a_third_canopen_on_a_serial_adapter(npm_canopen, tmp_path):
    found = strangers.calibrated(tmp_path, "copley", npm_canopen)
    assert found.check["ok"] and found.run["outcome"] == "ok", found.run
    assert not found.surprises
    assert abs(found.off_percent) <= strangers.LIMIT_PERCENT
    frames, malformed = strangers.dissected(found.log) or (0, 0)
    assert malformed == 0 and (frames > 5000 or shutil.which("tshark") is None)


@pytest.mark.slow
def test_calibrated_behind_anothers_canopen_and_a_gateway_on_tcp(tmp_path):
    found = strangers.calibrated(tmp_path, "copley", strangers.GATEWAY)
    assert found.check["ok"] and found.run["outcome"] == "ok", found.run
    assert not found.surprises
    assert abs(found.off_percent) <= strangers.LIMIT_PERCENT


@pytest.fixture(scope="module", params=sorted(strangers.known_personalities()))
def found(request, tmp_path_factory):
    return strangers.calibrated(tmp_path_factory.mktemp(request.param), request.param)


@on_multicast
@pytest.mark.slow
def test_calibrated_behind_anothers_canopen(found):
    assert found.check["ok"] and found.run["outcome"] == "ok", found.run
    assert not found.surprises
    assert abs(found.off_percent) <= strangers.LIMIT_PERCENT


@on_multicast
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_tshark_finds_no_malformed_frame(found):
    frames, malformed = strangers.dissected(found.log)
    assert frames > 5000 and malformed == 0


@on_multicast
@pytest.mark.slow
@pytest.mark.parametrize("family", ["elmo", "nanotec"])
def test_check_foresees_what_configuring_a_drive_with_anothers_canopen_meets(family, tmp_path):
    met = strangers.configured(tmp_path, family)
    assert not met.errors and not met.ended
    assert met.remarks <= met.warnings


@on_multicast
@pytest.mark.slow
def test_what_a_person_must_say_is_foreseen_there_too(tmp_path, monkeypatch):
    monkeypatch.setitem(strangers.NEEDS, "epos4", {})
    met = strangers.configured(tmp_path, "epos4")
    assert any("tells neither its position unit" in error for error in met.errors) and "tells neither" in met.ended
