"""A new robot file takes gear and rated torque from the drives; they are read, nothing is written."""

from __future__ import annotations

import pytest
from cia402_bench import Bench
from cia402_wire import ScriptedDrive

from frictid_hil.config.robot import load_robot
from frictid_hil.jobs.new_robot import JointAnswers, new_robot


def test_what_the_drives_say_stands_in_the_file(tmp_path, monkeypatch):
    bench = Bench(ScriptedDrive(1))

    def with_its_bus(name, setup):
        assert name == "cia402"
        return type(bench.driver)(setup, bus_factory=lambda: bench.bus, clock=bench.clock)

    monkeypatch.setattr("frictid_hil.jobs.new_robot.new_driver", with_its_bus)
    answers = JointAnswers("0", 1, (-1.0, 1.0), 2.0, 30.0)
    written = new_robot(tmp_path / "bench.yaml", driver="cia402", bus="socketcan:can0", joints=[answers], read=True)
    joint = load_robot(written.path).file.joints["0"]
    assert written.read["0"]["gear_ratio"] == joint.gear_ratio
    assert joint.rated_torque_nm == pytest.approx(written.read["0"]["rated_torque_nm"], rel=1e-5)
