"""Units that systemd accepts, and what it may and may not do to the machine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.jobs.schedule import ScheduleOptions, cron_line, next_elapse, schedule

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")


@pytest.mark.parametrize("system", [False, True])
def test_units_are_written_and_verified(tmp_path: Path, system: bool) -> None:
    result = schedule(ScheduleOptions("hp3j", "Mon..Fri 02:30", system=system, out=tmp_path, notify='say "100 %"'))
    service, timer = Path(result["service"]).read_text(), Path(result["timer"]).read_text()
    assert "OnCalendar=Mon..Fri 02:30" in timer and "Persistent=true" in timer
    assert "LimitRTPRIO=99" in service and "ProtectSystem=strict" in service and "SuccessExitStatus=5" in service
    assert '--notify "say \\"100 %%\\""' in service
    assert ("User=frictid" in service) is system
    assert result["cron"].startswith("30 2 * * 1,2,3,4,5 ") and r"\%" in result["cron"]
    if shutil.which("systemd-analyze"):
        assert result["verified"] is True and result["next_elapse"]


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
    assert when == ["30", "2", "*", "*", "*"]
    environment = {"HOME": str(home), "PATH": "/usr/bin:/bin", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}
    home.mkdir()
    subprocess.run(["sh", "-c", command.replace(r"\%", "%")], env=environment, check=True, timeout=200)
    result = json.loads(told.read_text())
    assert (result["outcome"], result["promoted"]) == ("ok", True)
    assert result["schema"] in (home / "state 100 %" / "frictid-hil" / "by-cron.log").read_text()
    assert Path(result["active"]).is_relative_to(home)


@pytest.mark.parametrize(
    ("on_calendar", "when"),
    [
        ("daily", "30 2 * * *"),
        ("03:05", "5 3 * * *"),
        ("Sat 04:00", "0 4 * * 6"),
        ("Sat..Mon 04:00:00", "0 4 * * 0,1,6"),
        ("Tue,Thu..Fri 23:59", "59 23 * * 2,4,5"),
        ("*-*-01 02:00", "0 2 * * *"),
    ],
)
def test_cron_comes_at_the_same_hour_and_weekdays(on_calendar: str, when: str) -> None:
    options = ScheduleOptions("hp3j", on_calendar)
    assert cron_line(options, load_robot("hp3j")).startswith(f"{when} mkdir ")


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
