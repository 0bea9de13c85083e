"""A drive that filters its torque and says so: the curve is that of the joint, not of the filter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from frictid_hil.config.robot import load_robot
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compare import true_curve
from frictid_hil.jobs.report import whole_profile
from frictid_hil.jobs.watch import Silent

pytestmark = pytest.mark.slow


def test_torque_four_milliseconds_late_changes_nothing_where_the_drive_declares_it(tmp_path: Path) -> None:
    values = load_robot("hp3j").values()
    values["joints"]["4"]["simulated"]["drive"]["torque_filter_s"] = 0.004
    robot = tmp_path / "late.yaml"
    robot.write_text(yaml.safe_dump(values))
    options = CalibrateOptions(
        str(robot), bus="virtual:late", joints=("4",), amplitude_rad=0.1745, out=tmp_path / "run"
    )
    profile = whole_profile(Path(calibrate(options, Silent()).to_json()["run"])).joint("4")
    assert profile.time_skew_s == pytest.approx(0.0045)
    assert profile.procedure is not None and profile.published is not None
    velocity = profile.procedure.velocity_rad_s
    truth = true_curve(load_robot(robot), "4", velocity)
    assert curve_distance(profile.curve(), truth, velocity).e_percent_measured_range <= 0.5
    published = FrictionCurve.through(np.array(profile.published.velocity_rad_s), np.array(profile.published.torque_nm))
    assert curve_distance(published, truth, velocity).e_percent_measured_range > 3.0
