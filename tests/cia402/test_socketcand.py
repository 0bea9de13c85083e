"""python-can's `socketcand`: a bus behind a gateway on TCP, with the simulated drives there, on the wall clock."""

from __future__ import annotations

import importlib
import sys
import threading
import time
from pathlib import Path

import can
import pytest
import yaml

from frictid_drivers.virtual.on_a_bus import BusWire
from frictid_drivers.virtual.power_stage import PowerState
from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.rack_process import SYNC_GAP_TENTHS, RackProcess
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import HardwareError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.watch import Silent
from frictid_hil.protocol.can_bus import open_bus
from frictid_hil.recording.mcap_reader import read_rows

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
guest = importlib.import_module("socketcan_guest")
Gateway = importlib.import_module("socketcand_gateway").Gateway


class Drives:
    """The drives behind their gateway, in a thread."""

    def __init__(self, robot: Path) -> None:
        self.gateway, self._over, self.rack = Gateway(), threading.Event(), Rack()
        values = yaml.safe_load(robot.read_text())
        values["bus"] = "socketcand:can0"
        values["options"] |= {"host": "127.0.0.1", "port": self.gateway.port, "tcp_tune": True}
        robot.write_text(yaml.safe_dump(values))
        self.rack.install(load_robot(robot).to_setup(), sync_gap_tenths=SYNC_GAP_TENTHS)
        self.rack.warm_up()
        process = RackProcess(self.rack, BusWire(self.gateway))
        self._thread = threading.Thread(target=process.run, args=(lambda now_ns, resting: self._over.is_set(),))
        self._thread.start()

    def stopped_by_themselves(self) -> bool:
        """Whether all have, or soon will."""
        servos = self.rack.servos.values()
        for _ in range(200):
            if all(servo.axis.at_rest and servo.state is PowerState.QUICK_STOP_ACTIVE for servo in servos):
                return True
            time.sleep(0.05)
        return False

    def close(self) -> None:
        self._over.set()
        self._thread.join(10.0)
        self.gateway.shutdown()


@pytest.fixture
def bench(tmp_path):
    robot = guest.robot_file(tmp_path)
    drives = Drives(robot)
    yield robot, drives
    drives.close()


@pytest.mark.slow
def test_friction_is_found_over_it(bench, tmp_path):
    robot, drives = bench
    found = calibrate(CalibrateOptions(str(robot), out=tmp_path / "run"), Silent()).to_json()
    assert found["outcome"] in ("ok", "gate_failed"), found
    joint = found["joints"]["0"]
    assert all("late" in remark for remark in joint["remarks"]), "a busy computer stalls the drives: no other gate"
    assert joint["coulomb_nm"] == pytest.approx(guest.COULOMB_NM, rel=0.08)
    assert not drives.gateway.refused


@pytest.mark.slow
def test_a_connection_that_is_lost_in_motion_ends_the_run_and_the_drive_stops_by_itself(bench, tmp_path):
    robot, drives = bench
    watcher = guest.At("cycles", drives.gateway.cut)
    found = calibrate(CalibrateOptions(str(robot), out=tmp_path / "run"), watcher).to_json()
    assert found["exit_code"] == 3 and "failed on the bus" in found["error"]["what"], found
    assert "may still have power" in found["error"]["next_step"]
    assert drives.stopped_by_themselves()
    assert read_rows(tmp_path / "run" / "samples.mcap")["0"].size > 50, "what was measured before is kept"


def test_a_gateway_that_is_not_there_is_told(monkeypatch):
    socketcand = importlib.import_module("can.interfaces.socketcand.socketcand")
    monkeypatch.setattr(socketcand, "connect_to_server", lambda *_: (_ for _ in ()).throw(TimeoutError("no server")))
    with pytest.raises(HardwareError, match="no server"):
        open_bus("socketcand:can0", {"host": "127.0.0.1", "port": 1})


def test_frames_arrive_as_they_were_sent():
    with Gateway() as gateway:
        reached = {}
        host = threading.Thread(
            target=lambda: reached.update(bus=can.Bus("can0", "socketcand", host="127.0.0.1", port=gateway.port))
        )
        host.start()
        while host.is_alive():
            gateway.recv(0.05)
        sent = [
            can.Message(arbitration_id=0x205, data=range(8), is_extended_id=False),
            can.Message(arbitration_id=0x80, is_extended_id=False),
            can.Message(arbitration_id=0x1FFF_FFFF, data=b"\xff", is_extended_id=True),
        ]
        with reached["bus"] as bus:
            for message in sent:
                bus.send(message)
                assert gateway.recv(5.0).equals(
                    message, timestamp_delta=None, check_channel=False, check_direction=False
                )
                gateway.send(message)
                assert bus.recv(5.0).equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
        assert not gateway.refused
