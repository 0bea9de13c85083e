"""All joints at once, on simulated drives whose joints share one arm."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import PlanRefused, UsageError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate, plan_calibration
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.identify import IdentifyOptions, identify
from frictid_hil.jobs.replay import ReplayOptions, replay
from frictid_hil.jobs.watch import Silent
from frictid_hil.protocol.driver import FD_FRAME
from frictid_hil.recording.bus_log import read_frames
from frictid_hil.simulation.arm_model import ArmModel
from frictid_hil.simulation.rigid_bodies import RigidBodies

pytestmark = pytest.mark.slow

pytest.importorskip("mujoco")

JOINTS = ("1", "2", "4")
"""Those with parallel axes: they feel each other most."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Without torque noise: what is left is of the method."""
    path = tmp_path_factory.mktemp("site") / "site.yaml"
    quiet = "".join(f"  '{n}': {{simulated: {{drive: {{torque_noise_per_mille: 0}}}}}}\n" for n in range(6))
    path.write_text(f"schema: frictid.robot/1\nextends: hp3j-arm.yaml\njoints:\n{quiet}")
    return str(path)


@pytest.fixture(scope="module")
def together(tmp_path_factory: pytest.TempPathFactory, site: str) -> tuple[Path, dict[str, object]]:
    out = tmp_path_factory.mktemp("together") / "run"
    options = CalibrateOptions(site, bus="virtual:test-together", out=out, joints=JOINTS, together=True)
    return out, calibrate(options, Silent()).to_json()


def test_three_joints_take_the_time_of_one(together: tuple[Path, dict[str, object]]) -> None:
    _, result = together
    assert result["outcome"] == "ok", result
    durations = {entry["duration_s"] for entry in result["joints"].values()}  # type: ignore[attr-defined]
    assert len(durations) == 1
    alone_s = [plan_calibration(CalibrateOptions("hp3j-arm.yaml", joints=(name,))).plan.duration_s for name in JOINTS]
    # Every stretch lasts as for the joint that needs longest; the coupling stretch, powering up and down come on top,
    # and so does the proof of units, joint by joint.
    assert durations.pop() < max(alone_s) + 4.5 + 1.5 * len(JOINTS) < 0.5 * sum(alone_s)


def test_the_curves_are_those_of_the_joints_not_of_the_arm(together: tuple[Path, dict[str, object]]) -> None:
    out, _ = together
    for name, distance in compare(out, None, "hp3j-arm.yaml")["joints"].items():
        assert distance["e_percent_measured_range"] <= 1.0, name


def test_the_inertia_that_couples_them_is_that_of_the_arm(together: tuple[Path, dict[str, object]]) -> None:
    out, _ = together
    setup = load_robot("hp3j-arm.yaml").to_setup()
    arm = ArmModel.from_mapping(setup.simulated_arm, {joint.name: joint.dh for joint in setup.joints})
    posture = [joint.locked_position_rad for joint in setup.joints]
    for name in JOINTS:
        posture[int(name)] = setup.joint(name).start_position_rad + math.radians(10)
    matrix, _ = RigidBodies(arm).at(np.array(posture), np.zeros(6))
    profile = load_profile(out / "profile.yaml")
    for name in JOINTS:
        found = profile.joint(name).quality["coupling_kg_m2"]
        assert set(found) == set(JOINTS) - {name}
        for other, value in found.items():
            assert value == pytest.approx(matrix[int(name), int(other)], rel=0.05)


def test_together_is_as_one_by_one(together: tuple[Path, dict[str, object]], site: str, tmp_path: Path) -> None:
    """Joint 4 has most to lose: without the other joints' accelerations taken off, it is 0.47 % away."""
    options = CalibrateOptions(site, bus="virtual:test-alone", out=tmp_path / "run", joints=("4",))
    assert calibrate(options, Silent()).to_json()["outcome"] == "ok"
    distance = compare(together[0], tmp_path / "run", None)["joints"]["4"]
    assert distance["e_percent_measured_range"] <= 0.25


def test_what_is_of_the_whole_arm_is_not_said_of_a_joint(together: tuple[Path, dict[str, object]]) -> None:
    out, _ = together
    profile = load_profile(out / "profile.yaml")
    assert profile.provenance.settings["together"] is True
    for name in JOINTS:
        joint = profile.joint(name)
        assert joint.procedure is not None and joint.procedure.together == JOINTS
        assert joint.inertia_kg_m2.value is None
        assert "together" in joint.inertia_kg_m2.reason


def test_the_recording_identifies_to_the_same_profile(together: tuple[Path, dict[str, object]]) -> None:
    out, _ = together
    again = identify(IdentifyOptions((out,), robot="hp3j-arm.yaml", out=out.parent / "again"))
    assert again["outcome"] == "ok"
    first, second = load_profile(out / "profile.yaml"), load_profile(out.parent / "again" / "profile.yaml")
    assert first.joints == second.joints
    alone = identify(IdentifyOptions((out,), joints=("2",), robot="hp3j-arm.yaml", out=out.parent / "one"))
    assert alone["outcome"] == "ok"  # the others' columns are in the recording all the same
    assert load_profile(out.parent / "one" / "profile.yaml").joint("2") == first.joint("2")


def test_can_fd_carries_them_faster_and_its_log_replays(tmp_path: Path, site: str) -> None:
    """At 500 Hz, twice what the classical wire takes with six joints; PDOs are FD frames, in the log as well."""
    path = tmp_path / "fd.yaml"
    path.write_text(f"schema: frictid.robot/1\nextends: {site}\ncycle_hz: 500\noptions: {{fd: true}}\n")
    run, bus, every = tmp_path / "run", "virtual:test-together-fd", tuple("012345")
    wanted = CalibrateOptions(str(path), bus=bus, out=run, joints=every, together=True, program="quick")
    result = calibrate(wanted, Silent()).to_json()
    assert result["outcome"] == "ok", result
    assert {entry["rate_hz"] for entry in result["joints"].values()} == {500.0}
    frames = read_frames(run / "bus.blf")
    fd = (frames.can_id & FD_FRAME) != 0
    assert set((frames.can_id[fd] & 0x780).tolist()) == {0x180, 0x380, 0x200, 0x300}
    assert set((frames.can_id[~fd] & 0x780).tolist()) == {0x000, 0x080, 0x580, 0x600, 0x700}
    assert np.count_nonzero(frames.can_id == 0x181 | FD_FRAME) == np.count_nonzero(frames.can_id == 0x80)
    again = replay(ReplayOptions(run, robot=str(path)))
    assert again["identical"] is True
    classical = tmp_path / "classical.yaml"
    classical.write_text(f"schema: frictid.robot/1\nextends: {site}\ncycle_hz: 500\n")
    with pytest.raises(PlanRefused, match="bus load"):
        calibrate(CalibrateOptions(str(classical), bus=bus, out=tmp_path / "no", joints=every, together=True), Silent())


def test_different_timing_is_refused(tmp_path: Path) -> None:
    site = tmp_path / "site.yaml"
    site.write_text(
        "schema: frictid.robot/1\nextends: hp3j-arm.yaml\njoints:\n  '4':\n    procedure: {amplitude_rad: 0.5}\n"
    )
    with pytest.raises(UsageError, match=r"joint 4: its 10 cycles take .* joints that move together need identical"):
        plan_calibration(CalibrateOptions(str(site), together=True))


def test_the_combined_torque_is_refused_where_each_alone_is_not() -> None:
    fast: dict[str, Any] = {"velocity_rad_s": 2.3}
    plan_calibration(CalibrateOptions("hp3j-arm.yaml", **fast))
    with pytest.raises(PlanRefused, match=r"joint 0: predicted torque .* the most that the other joints can add"):
        plan_calibration(CalibrateOptions("hp3j-arm.yaml", together=True, **fast))
