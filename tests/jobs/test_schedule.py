"""Units that systemd accepts, and what it may and may not do to the machine."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.jobs.schedule import ScheduleOptions, next_elapse, schedule

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")


@pytest.mark.parametrize("system", [False, True])
def test_units_are_written_and_verified(tmp_path: Path, system: bool) -> None:
    result = schedule(ScheduleOptions("hp3j", "Mon..Fri 02:30", system=system, out=tmp_path, notify='say "100 %"'))
    service, timer = Path(result["service"]).read_text(), Path(result["timer"]).read_text()
    assert "OnCalendar=Mon..Fri 02:30" in timer and "Persistent=true" in timer
    assert "LimitRTPRIO=99" in service and "ProtectSystem=strict" in service and "SuccessExitStatus=5" in service
    assert '--notify "say \\"100 %%\\""' in service
    assert ("User=frictid" in service) is system
    assert result["cron"].startswith("30 2 * * * ") and r"\%" in result["cron"]
    if shutil.which("systemd-analyze"):
        assert result["verified"] is True and result["next_elapse"]


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
