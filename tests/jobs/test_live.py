"""Samples over Foxglove WebSocket, seen by a client that is no tool of ours."""

from __future__ import annotations

import json
import socket
import struct
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.live import LIVE_HZ, live
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.recording.mcap_reader import read_rows
from frictid_hil.runner.ring import sample_ring

pytest.importorskip("websockets")

from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from frictid_hil.jobs.foxglove import PROTOCOLS, FoxgloveServer

PROTOCOL = Subprotocol("foxglove.sdk.v1")
MESSAGE_DATA = 1


class Client(threading.Thread):
    """A viewer: takes every channel that is advertised, keeps what comes."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._port = port
        self.channels: dict[int, dict[str, Any]] = {}
        self.messages: list[tuple[int, int, dict[str, float]]] = []
        self.subscribed = threading.Event()

    def run(self) -> None:
        with connect(f"ws://127.0.0.1:{self._port}", subprotocols=[PROTOCOL]) as link:
            for frame in link:
                if isinstance(frame, str):
                    told = json.loads(frame)
                    if told["op"] == "advertise":
                        self.channels |= {one["id"]: one for one in told["channels"]}
                        wanted = [{"id": one["id"], "channelId": one["id"]} for one in told["channels"]]
                        link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                        self.subscribed.set()
                elif frame[0] == MESSAGE_DATA:
                    channel, log_ns = struct.unpack_from("<IQ", frame, 1)
                    self.messages.append((channel, log_ns, json.loads(frame[13:])))


class WithClient(Silent):
    """Brings the viewer in once the channels are there, and waits for it."""

    def __init__(self, client: Client) -> None:
        self.client = client

    def plan(self, plan: Plan, setup: RobotSetup) -> None:
        self.client.start()
        assert self.client.subscribed.wait(10.0)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.mark.slow
def test_a_client_sees_every_joint_and_its_samples(tmp_path: Path) -> None:
    values = load_robot("hp3j").values()
    values |= {"name": "seen", "bus": "virtual:seen", "joints": {"5": values["joints"]["5"]}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3}
    robot = tmp_path / "seen.yaml"
    robot.write_text(dump(values))
    client = Client(port := free_port())
    with live(WithClient(client), f"127.0.0.1:{port}") as watcher:
        result = calibrate(CalibrateOptions(str(robot), out=tmp_path / "run"), watcher).to_json()
    assert result["outcome"] == "ok"
    client.join(10.0)
    (channel,) = client.channels.values()
    assert channel["topic"] == "/joint/5" and channel["encoding"] == "json"
    schema = json.loads(channel["schema"])["properties"]
    recorded = read_rows(tmp_path / "run" / "samples.mcap")["5"]
    assert len(client.messages) > 0.5 * LIVE_HZ * 1e-9 * (
        recorded["log_time"].astype(np.int64)[-1] - recorded["log_time"].astype(np.int64)[0]
    )
    by_time = {int(row["log_time"]): row for row in recorded}
    for _, log_ns, message in client.messages:
        row = by_time[round(message["time_s"] * 1e9)]
        assert message.keys() <= schema.keys()
        assert message["position_rad"] == row["position_rad"] and message["torque_nm"] == row["torque_nm"]
        assert log_ns > 1.7e18, "a date, as viewers expect"


def test_nobody_connected_and_no_address_change_nothing() -> None:
    watcher = Silent()
    with live(watcher, None) as same:
        assert same is watcher


class Notes(Silent):
    """Keeps what a person would see."""

    def __init__(self) -> None:
        self.kept: list[str] = []

    def note(self, message: str) -> None:
        self.kept.append(message)


@pytest.mark.parametrize(("host", "warned"), [("127.0.0.1", False), ("localhost", False), ("0.0.0.0", True)])
def test_whoever_opens_it_to_the_network_is_warned(host: str, warned: bool) -> None:
    notes = Notes()
    with live(notes, f"{host}:{free_port()}"):
        pass
    assert any("warning" in note and "network" in note for note in notes.kept) == warned
    assert any(f"ws://{host}:" in note for note in notes.kept)


@pytest.mark.parametrize("address", ["8765", "localhost:", "localhost:http", "1.2.3.4:99999"])
def test_an_address_that_is_none_is_told(address: str) -> None:
    with pytest.raises(UsageError, match="HOST:PORT"), live(Silent(), address):
        pass


def test_a_port_that_is_taken_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(UsageError, match="cannot listen"), live(Silent(), address):
            pass


def test_without_the_package_the_way_to_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "frictid_hil.jobs.foxglove")
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(UsageError, match="websockets") as told, live(Silent(), "127.0.0.1:0"):
        pass
    assert "frictid-hil[live]" in told.value.next_step


REFUSED: list[str] = []


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    yield (one := two_channels())
    one.close()


def two_channels() -> FoxgloveServer:
    REFUSED.clear()
    one = FoxgloveServer("bench", "127.0.0.1", 0, refused=REFUSED.append)
    one.advertise(["/joint/1", "/joint/2"], {"title": "sample"})
    return one


def viewer(port: int, origin: str | None = None, protocol: Subprotocol = PROTOCOL) -> ClientConnection:
    said = Origin(origin) if origin else None
    # Without a long queue, and without a long farewell to a server that waits for it to be read.
    return connect(
        f"ws://127.0.0.1:{port}", origin=said, subprotocols=[protocol], max_queue=1, max_size=None, close_timeout=0.1
    )


def told(link: ClientConnection) -> dict[str, Any]:
    return json.loads(link.recv(timeout=10.0))


def subscribe(link: ClientConnection, channel_of: dict[int, int]) -> None:
    wanted = [{"id": one, "channelId": channel} for one, channel in channel_of.items()]
    link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    link.send("?")
    assert told(link)["op"] == "status", "answered in turn: what was asked before is in force"


@pytest.mark.parametrize(
    "origin",
    [
        None, "https://app.foxglove.dev", "https://studio.foxglove.dev", "file://", "foxglove-app://main",
        "http://localhost:8080", "https://localhost", "http://127.0.0.1:3000", "http://[::1]:8080",
    ],
)  # fmt: skip
def test_programs_foxglove_and_this_computer_may_watch(server: FoxgloveServer, origin: str | None) -> None:
    with viewer(server.port, origin) as link:
        assert told(link)["op"] == "serverInfo"
    assert not REFUSED


@pytest.mark.parametrize(
    "origin",
    [
        "https://example.com", "http://example.com:8765", "null", "http://app.foxglove.dev", "HTTPS://example.com",
        "https://app.foxglove.dev.example.com", "https://evil-foxglove.dev", "http://localhost.example.com",
        "http://localhost:8080.example.com", "http://127.0.0.1.example.com", "https://example.com/http://localhost",
        "http://192.168.0.7", "localhost",
    ],
)  # fmt: skip
def test_a_page_from_elsewhere_is_refused(server: FoxgloveServer, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refusal, viewer(server.port, origin):
        pass
    assert refusal.value.response.status_code == 403
    assert [origin] == REFUSED


def test_who_was_refused_is_told_once() -> None:
    notes, port, ring = Notes(), free_port(), sample_ring(4)
    with live(notes, f"127.0.0.1:{port}") as watcher:
        for _ in range(2):
            with pytest.raises(InvalidStatus), viewer(port, "https://example.com"):
                pass
            watcher.rows(ring.drain())
    ring.close()
    assert sum("https://example.com" in note for note in notes.kept) == 1


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_viewer_gets_what_it_subscribed_to_and_nothing_else(server: FoxgloveServer, protocol: Subprotocol) -> None:
    with viewer(server.port, protocol=protocol) as link:
        assert link.subprotocol == protocol
        assert told(link)["capabilities"] == []
        assert [one["topic"] for one in told(link)["channels"]] == ["/joint/1", "/joint/2"]
        subscribe(link, {7: 2, 9: 3})
        server.send([(1, 10, {"a": 1.0}), (2, 11, {"a": 2.0})])
        assert link.recv(timeout=10.0) == struct.pack("<BIQ", 1, 7, 11) + b'{"a": 2.0}'
        link.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [7]}))
        subscribe(link, {8: 1})
        server.send([(2, 12, {"a": 3.0}), (1, 13, {"a": 4.0})])
        assert link.recv(timeout=10.0) == struct.pack("<BIQ", 1, 8, 13) + b'{"a": 4.0}'


@pytest.mark.parametrize(
    "frame",
    [
        "no json", b"\x01\x00", "[]", "{}", '{"op": "subscribe"}', '{"op": "advertise", "channels": []}', "[" * 60_000,
        '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": "a", "channelId": [1]}]}',
        '{"op": "unsubscribe", "subscriptionIds": [5000000000]}',
    ],
)  # fmt: skip
def test_what_a_viewer_sends_apart_from_subscriptions_is_refused(server: FoxgloveServer, frame: str | bytes) -> None:
    with viewer(server.port) as link:
        assert [told(link)["op"], told(link)["op"]] == ["serverInfo", "advertise"]
        link.send(frame)
        assert told(link)["op"] == "status"
        subscribe(link, {1: 1})
        server.send([(1, 10, {})])
        assert link.recv(timeout=10.0) == struct.pack("<BIQ", 1, 1, 10) + b"{}"


def test_a_viewer_that_stands_still_misses_messages_and_holds_nothing_up(server: FoxgloveServer) -> None:
    long = {"much": "x" * 1_000_000}
    with viewer(server.port) as slow, viewer(server.port) as quick:
        for link in (slow, quick):
            assert [told(link)["op"], told(link)["op"]] == ["serverInfo", "advertise"]
            subscribe(link, {1: 1})
        for log_ns in range(100):
            server.send([(1, log_ns, long)])
            assert quick.recv(timeout=10.0)[5:13] == struct.pack("<Q", log_ns)
        quick.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [1]}))
        seen = 1
        while slow.recv(timeout=10.0)[5:13] != struct.pack("<Q", 100):
            server.send([(1, 100, {})])
            seen += 1
    assert seen < 100


def test_the_end_waits_for_nobody(capfd: pytest.CaptureFixture[str]) -> None:
    server = two_channels()
    with viewer(server.port) as link, socket.create_connection(("127.0.0.1", server.port)):
        assert [told(link)["op"], told(link)["op"]] == ["serverInfo", "advertise"]
        subscribe(link, {1: 1})
        for log_ns in range(30):
            server.send([(1, log_ns, {"much": "x" * 1_000_000})])
        link.recv(timeout=10.0)
        server.close()
    assert not capfd.readouterr().err
