"""Units that systemd accepts, and what it may and may not do to the machine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from platformdirs import user_cache_path

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.jobs.schedule import ScheduleOptions, next_elapse, schedule

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")


@pytest.fixture
def real_robot(tmp_path: Path) -> Path:
    """On a CAN bus, with the permission to move unattended."""
    allowed = {"allowed_by": "A. Person", "date": "2026-11-21", "interlock_input": {"joint": "0", "bit": 3}}
    path = tmp_path / "real.yaml"
    values = {"schema": "frictid.robot/1", "extends": "hp3j.yaml", "name": "real", "bus": "socketcan:can0"}
    path.write_text(dump({**values, "driver": "cia402", "policy": {"unattended": allowed}}))
    return path


@pytest.mark.parametrize("system", [False, True])
def test_units_are_written_and_verified(tmp_path: Path, system: bool) -> None:
    result = schedule(ScheduleOptions("hp3j", "Mon..Fri 02:30", system=system, out=tmp_path, notify='say "100 %"'))
    service, timer = Path(result["service"]).read_text(), Path(result["timer"]).read_text()
    assert "OnCalendar=Mon..Fri 02:30" in timer and "Persistent=true" in timer
    assert "LimitRTPRIO=99" in service and "ProtectSystem=strict" in service and "TimeoutStartSec=14400" in service
    assert "SuccessExitStatus" not in service, "a night that was refused is a failed unit, and alarms"
    assert '--notify "say \\"100 %%\\""' in service
    assert ("User=frictid" in service) is system
    assert result["cron"].startswith("30 2 * * 1,2,3,4,5 ") and r"\%" in result["cron"]
    if shutil.which("systemd-analyze"):
        assert result["verified"] is True and result["next_elapse"]


def test_the_lock_of_a_bus_is_seen_by_everybody(tmp_path: Path) -> None:
    service = Path(schedule(ScheduleOptions("hp3j", "daily", system=True, out=tmp_path))["service"]).read_text()
    assert "PrivateTmp=" not in service and "ReadWritePaths=/tmp" in service


def test_a_night_missed_on_a_real_bus_stays_missed(tmp_path: Path, real_robot: Path) -> None:
    timer = Path(schedule(ScheduleOptions(str(real_robot), "daily", out=tmp_path))["timer"]).read_text()
    assert "Persistent=false" in timer and "Persistent=true" not in timer


def test_a_service_opens_its_port_the_bound_of_wake_times_and_no_other_device(tmp_path: Path, real_robot: Path) -> None:
    options = ScheduleOptions(str(real_robot), "daily", bus="serial:/dev/ttyUSB0", system=True, out=tmp_path)
    service = Path(schedule(options)["service"]).read_text()
    allowed = [line for line in service.splitlines() if line.startswith("Device")]
    assert allowed == ["DevicePolicy=closed", "DeviceAllow=/dev/cpu_dma_latency rw", "DeviceAllow=/dev/ttyUSB0 rw"]


def test_an_account_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no account 'nobody-here'"):
        schedule(ScheduleOptions("hp3j", "daily", system=True, user="nobody-here"))


def test_the_command_that_turns_it_on_finds_the_units(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = schedule(ScheduleOptions("hp3j", "daily", out=tmp_path / "my units"))
    assert elsewhere["enable"] == (
        f"loginctl enable-linger && systemctl --user link '{elsewhere['service']}' '{elsewhere['timer']}'"
        " && systemctl --user enable --now frictid-hil-hp3j.timer"
    )
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    own = schedule(ScheduleOptions("hp3j", "daily"))
    assert Path(own["service"]).parent == tmp_path / "config" / "systemd" / "user"
    assert "systemctl --user daemon-reload && systemctl" in own["enable"]


def test_what_cron_cannot_say_is_not_printed_as_a_cron_line(tmp_path: Path) -> None:
    result = schedule(ScheduleOptions("hp3j", "Fri *-*-13 02:00", out=tmp_path))
    assert result["cron"] is None and "cron cannot say" in result["cron_refused"]


@pytest.mark.slow
def test_the_cron_line_runs_a_night_where_there_was_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As cron does it: a bare environment, ``sh``, nobody there, no folder made beforehand."""
    values = load_robot("hp3j").values()
    values |= {"name": "by-cron", "bus": "virtual:by-cron", "joints": {"5": values["joints"]["5"]}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3}
    values["policy"] = {"warm_up": {"fixed_s": 0.0}}
    robot = tmp_path / "by cron.yaml"
    robot.write_text(dump(values))
    home = tmp_path / "home"
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "state 100 %"))
    told = tmp_path / "told.json"
    line = schedule(ScheduleOptions(str(robot), "daily", out=tmp_path, notify=f"tee '{told}'"))["cron"]
    *when, command = line.split(" ", 5)
    assert when == ["0", "0", "*", "*", "*"]
    environment = {"HOME": str(home), "PATH": "/usr/bin:/bin", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}
    environment["XDG_CACHE_HOME"] = str(user_cache_path())  # what is compiled already need not be compiled again
    home.mkdir()
    subprocess.run(["sh", "-c", command.replace(r"\%", "%")], env=environment, check=True, timeout=200)
    result = json.loads(told.read_text())
    assert (result["outcome"], result["promoted"]) == ("ok", True)
    assert result["schema"] in (home / "state 100 %" / "frictid-hil" / "by-cron.log").read_text()
    assert Path(result["active"]).is_relative_to(home)


@needs_systemd
def test_a_calendar_that_systemd_refuses_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="calendar"):
        schedule(ScheduleOptions("hp3j", "Mo 25:30", out=tmp_path))
    assert not list(tmp_path.iterdir())


@needs_systemd
def test_a_calendar_that_never_comes_true_is_refused() -> None:
    with pytest.raises(UsageError, match="never"):
        next_elapse("2001-01-01")


@pytest.mark.parametrize("text", ["", "  ", "daily\nExecStart=/bin/sh"])
def test_no_other_line_can_be_smuggled_in(text: str) -> None:
    with pytest.raises(UsageError):
        next_elapse(text)


def test_a_real_robot_without_permission_is_not_scheduled(tmp_path: Path) -> None:
    robot = tmp_path / "real.yaml"
    robot.write_text(dump({**load_robot("hp3j").values(), "driver": "cia402", "bus": "socketcan:can0"}))
    with pytest.raises(UsageError, match="unattended"):
        schedule(ScheduleOptions(str(robot), "daily", out=tmp_path / "units"))
