"""``calibrate --measure-skew``: planned within limits, refused where the bus does not allow it, kept in the profile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import UsageError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate, plan_calibration
from frictid_hil.jobs.identify import IdentifyOptions, identify
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import SKEW, Plan

pytestmark = pytest.mark.slow


def planned(robot: str = "hp3j", **options: Any) -> Plan:
    return plan_calibration(CalibrateOptions(robot, joints=("1",), **options)).plan


def test_shaking_is_planned_only_where_it_is_asked_for_and_asks_for_no_more_than_the_cycles() -> None:
    plain, shaking = planned().joints[0], planned(measure_skew=True).joints[0]
    assert [motion.name for motion in shaking.motions].count(SKEW) == 4
    assert SKEW not in [motion.name for motion in plain.motions]
    assert shaking.duration_s == pytest.approx(plain.duration_s + 8.2)
    for figure in ("travel_rad", "peak_velocity_rad_s", "predicted_torque_nm"):
        assert getattr(shaking, figure) == getattr(plain, figure)
    assert any("shakes at 4 and 8 Hz" in note for note in planned(measure_skew=True).notes)


def test_the_robot_file_may_ask_for_it_and_the_command_line_has_the_last_word(tmp_path: Path) -> None:
    values = load_robot("hp3j").values()
    values["procedure"]["measure_skew"] = True
    robot = tmp_path / "always.yaml"
    robot.write_text(yaml.safe_dump(values))
    asked, told_not_to = planned(str(robot)), planned(str(robot), measure_skew=False)
    assert SKEW in [motion.name for motion in asked.joints[0].motions]
    assert SKEW not in [motion.name for motion in told_not_to.joints[0].motions]


@pytest.mark.parametrize(
    ("robot", "options", "why"),
    [
        ("hp3j", {"together": True}, "one joint at a time"),
        ("hp3j", {"rate_hz": 100.0}, "too few"),
        ("hp3j-serial", {}, "on its own clock"),
    ],
)
def test_it_is_refused_where_it_would_tell_nothing(robot: str, options: dict[str, object], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        planned(robot, measure_skew=True, **options)


def test_a_wrong_declaration_is_measured_over_the_bus_flagged_and_kept(tmp_path: Path) -> None:
    """The robot file declares a torque filter of 2 ms away; the recording tells the same once more."""
    values = load_robot("hp3j").values()
    values["joints"]["4"]["simulated"]["drive"]["torque_filter_s"] = 0.002
    values["joints"]["4"].setdefault("options", {})["timing"] = {"torque_delay_s": 0.0005, "uncertainty_s": 0.0002}
    robot = tmp_path / "unaware.yaml"
    robot.write_text(yaml.safe_dump(values))
    options = CalibrateOptions(
        str(robot), bus="virtual:unaware", joints=("4",), program="quick", measure_skew=True, out=tmp_path / "run"
    )
    result = calibrate(options, Silent()).to_json()
    entry = result["joints"]["4"]
    assert result["outcome"] == "gate_failed"
    assert "measured" in entry["remarks"][0] and "0.500 +- 0.400 ms as declared" in entry["remarks"][0]
    profile = load_profile(result["profile"]).joint("4")
    assert profile.time_skew is not None
    assert profile.time_skew.declared_s == pytest.approx(0.0005)
    assert profile.time_skew.measured_s == pytest.approx(0.0025, abs=1e-4)
    assert profile.time_skew_s == profile.time_skew.used_s == entry["time_skew_s"]
    again = identify(IdentifyOptions((tmp_path / "run",), robot=str(robot), method="least-squares"))
    assert again["joints"]["4"]["time_skew"] == entry["time_skew"]
