"""Samples over Foxglove WebSocket, seen by a client that is no tool of ours."""

from __future__ import annotations

import json
import socket
import struct
import sys
import threading
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

pytestmark = pytest.mark.slow

pytest.importorskip("foxglove")
connect = pytest.importorskip("websockets.sync.client").connect

PROTOCOL = "foxglove.sdk.v1"
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


def test_without_the_sdk_the_way_to_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(UsageError, match="Foxglove SDK") as told, live(Silent(), "127.0.0.1:0"):
        pass
    assert "frictid-hil[live]" in told.value.next_step
