"""The way back after our own watchdog: shown, asked, reset - and only then."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from frictid_drivers.virtual.driver import VirtualDriver
from frictid_drivers.virtual.rack_launcher import decode_setup, encode_setup
from frictid_hil.cli.app import app
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import HardwareError, PlanRefused
from frictid_hil.jobs.check import check
from frictid_hil.jobs.reset import reset


def robot(folder: Path, *faults: dict) -> str:
    values = {
        "schema": "frictid.robot/1", "extends": "hp3j.yaml", "name": "cut-off", "driver": "virtual",
        "bus": f"virtual:cut{os.getpid()}", "options": {"faults": list(faults)},
    }  # fmt: skip
    path = folder / "cut.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


CUT_OFF = {"kind": "left_in_fault", "joint": "1"}


def test_the_fault_is_shown_before_it_is_reset(tmp_path):
    name = robot(tmp_path, CUT_OFF)
    checked = check(name)
    assert not checked["ok"]
    (error,) = [one for one in checked["findings"] if one["severity"] == "error"]
    assert (
        "0x8130" in error["message"] and "heartbeat" in error["message"] and "frictid-hil reset" in error["next_step"]
    )
    shown = []
    with pytest.raises(PlanRefused, match="nothing was reset"):
        reset(name, ask=lambda faults: bool(shown.extend(faults)))
    assert [fault.subject for fault in shown] == ["joint 1"] and "0x8130" in shown[0].message
    result = reset(name, ask=lambda faults: True)
    assert [one["subject"] for one in result["reset"]] == ["joint 1"]


def test_a_reset_of_the_fault_alone_would_not_do(tmp_path):
    driver = VirtualDriver(load_robot(robot(tmp_path, CUT_OFF)).to_setup())
    driver.open()
    try:
        assert len(driver.faults()) == 1
        servo = driver._rack.servos["1"]
        servo.write(0x6040, 0, 0x80, driver._rack.now_ns)
        assert len(driver.faults()) == 1
        driver.reset_faults()
        assert driver.faults() == [] and not servo.axis.powered
    finally:
        driver.close()


def test_a_cause_that_stays_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr("frictid_drivers.cia402.reentry._LEAVE_S", 0.05)
    driver = VirtualDriver(load_robot(robot(tmp_path, {**CUT_OFF, "code": 0x7305})).to_setup())
    driver.open()
    stage = driver._rack.servos["1"].power
    monkeypatch.setattr(stage, "_reset_fault", lambda: None)
    with pytest.raises(HardwareError, match=r"still in fault 0x7305 \(sensor"):
        driver.reset_faults()
    driver.close()


def test_nothing_to_reset_and_nobody_to_ask(tmp_path):
    runner = CliRunner()
    healthy = runner.invoke(app, ["reset", "--robot", robot(tmp_path)])
    assert healthy.exit_code == 0 and "no drive is in fault" in healthy.output
    refused = runner.invoke(app, ["reset", "--robot", robot(tmp_path, CUT_OFF)])
    assert refused.exit_code == 2 and "needs a yes" in refused.output
    done = runner.invoke(app, ["reset", "--robot", robot(tmp_path, CUT_OFF), "--yes", "--json"])
    assert done.exit_code == 0 and "frictid.reset/1" in done.output


def test_the_folder_of_the_robot_file_reaches_the_drives_own_process(tmp_path):
    setup = replace(load_robot("hp3j.yaml").to_setup(), folder=tmp_path)
    assert decode_setup(encode_setup(setup)).folder == tmp_path
