"""The workspace box: both sides of every face, the combined motion, and while the arm moves."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from frictid_hil.cli.app import app
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import ConfigError, PlanRefused, SafetyAbort
from frictid_hil.jobs.calibrate import CalibrateOptions, plan_calibration
from frictid_hil.kinematics import DhRow
from frictid_hil.plan.workspace import Workspace
from frictid_hil.protocol.driver import Feedback
from frictid_hil.runner.ring import Rows
from frictid_hil.runner.workspace_watch import WorkspaceWatch
from frictid_hil.runs.run import run_plan

PLANAR = (DhRow(a_m=0.5), DhRow(a_m=0.3))
ROOM = ((-1.0, 1.0), (-1.0, 1.0), (-0.1, 0.1))


@pytest.mark.parametrize(
    ("axis", "box_m", "angles", "words"),
    [
        (0, (-1.0, 0.79), (0.0, 0.0), r"x = 0.800 m is 10 mm above its bound of 0.790 m"),
        (0, (-0.78, 1.0), (math.pi, 0.0), r"x = -0.800 m is 20 mm below its bound of -0.780 m"),
        (1, (-1.0, 0.7), (math.pi / 2, 0.0), r"y = 0.800 m is 100 mm above"),
        (1, (-0.7, 1.0), (-math.pi / 2, 0.0), r"y = -0.800 m is 100 mm below"),
    ],
)
def test_the_side_the_point_and_the_angles_are_named(
    axis: int, box_m: tuple[float, float], angles: tuple[float, float], words: str
) -> None:
    faces = list(ROOM)
    faces[axis] = box_m
    box = Workspace(PLANAR, (faces[0], faces[1], faces[2]))
    found = box.outside(np.array([[0.3, 2.0], angles]))
    assert found is not None
    assert found.moment == 1
    text = found.described(["upper", "lower"])
    assert words in text
    assert f"upper at {math.degrees(angles[0]):.1f} deg" in text
    assert box.outside(np.array([[0.3, 2.0]])) is None


def test_clearance_and_tool_take_their_share_of_the_box() -> None:
    stretched = np.zeros((1, 2))
    assert Workspace(PLANAR, ((-1.0, 0.85), *ROOM[1:])).outside(stretched) is None
    for box in (
        Workspace(PLANAR, ((-1.0, 0.85), *ROOM[1:]), clearance_m=0.06),
        Workspace(PLANAR, ((-1.0, 0.85), *ROOM[1:]), tool_m=(0.06, 0.0, 0.0)),
    ):
        assert box.outside(stretched) is not None
    tool = Workspace(PLANAR, ROOM, tool_m=(0.0, 0.0, 0.2)).outside(stretched)
    assert tool is not None
    assert "the tool point" in tool.described(["0", "1"])


def test_a_position_that_is_no_number_is_outside() -> None:
    assert Workspace(PLANAR, ROOM).outside(np.array([[0.0, math.nan]])) is not None


def boxed(folder: Path, y_m: str) -> str:
    site = folder / "site.yaml"
    site.write_text(
        "schema: frictid.robot/1\nextends: hp3j-arm.yaml\n"
        f"workspace: {{x_m: [-0.2, 0.9], y_m: {y_m}, z_m: [0.0, 1.2], clearance_m: 0.05}}\n"
    )
    return str(site)


def test_the_combined_motion_is_refused_where_every_joint_alone_stays_inside(tmp_path: Path) -> None:
    narrow = boxed(tmp_path, "[-0.2, 0.4]")
    plan_calibration(CalibrateOptions(narrow))  # one by one: y goes down to -0.12 m
    with pytest.raises(PlanRefused, match=r"joint 5's link at .* y = -0.2\d\d m is \d+ mm below its bound of -0.150 m"):
        plan_calibration(CalibrateOptions(narrow, together=True))
    plan_calibration(CalibrateOptions(boxed(tmp_path, "[-0.4, 0.4]"), together=True))


def test_one_joint_alone_is_refused_too_and_nothing_is_opened(tmp_path: Path) -> None:
    site = boxed(tmp_path, "[-0.1, 0.4]")
    for more in (["--dry-run"], ["--yes", "--out", str(tmp_path / "run")]):
        done = CliRunner().invoke(app, ["calibrate", "--robot", site, "--joint", "0", *more])
        assert done.exit_code == 2
        said = " ".join(done.output.split())
        assert "leaves the workspace box" in said
        assert "joints 0 at -25.0 deg" in said
        assert not (tmp_path / "run").exists()
    assert CliRunner().invoke(app, ["calibrate", "--robot", site, "--joint", "5", "--dry-run"]).exit_code == 0


def test_a_box_needs_the_chain_and_room_between_its_faces(tmp_path: Path) -> None:
    site = tmp_path / "site.yaml"
    site.write_text(
        "schema: frictid.robot/1\nextends: hp3j.yaml\n"
        "workspace: {x_m: [-1, 1], y_m: [-1, 1], z_m: [0, 0.1], clearance_m: 0.05}\n"
    )
    with pytest.raises(ConfigError) as caught:
        load_robot(site)
    assert "has no `dh`, without which `workspace` cannot be checked" in str(caught.value)
    assert "site.yaml:3" in str(caught.value)
    assert "leaves no room between faces of 0.05 m clearance" in str(caught.value)


def test_the_box_is_watched_while_the_arm_moves() -> None:
    box = Workspace(PLANAR, ((-1.0, 0.79), *ROOM[1:]))
    watch = WorkspaceWatch(box, ["0", "1"], cycle_hz=50.0)
    inside = [Feedback(position_rad=0.5), Feedback(position_rad=0.0)]
    watch.check(inside)
    watch.check([Feedback(position_rad=math.nan), Feedback(position_rad=0.0)])  # not reported yet
    watch.check([Feedback(position_rad=0.0), Feedback(position_rad=0.0)])  # 10 mm: within what a lag may do
    with pytest.raises(SafetyAbort, match=r"leaves the workspace box: x = 0.800 m"):
        WorkspaceWatch(replace(box, clearance_m=0.001), ["0", "1"], 50.0).check([Feedback(position_rad=0.0)] * 2)


class Nothing:
    """Keeps nothing of a run."""

    def samples(self, rows: Rows) -> None:
        """Forget."""

    def frames(self, rows: Rows) -> None:
        """Forget."""


@pytest.mark.slow
def test_an_arm_that_leaves_the_box_is_stopped(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    planned = plan_calibration(
        CalibrateOptions(boxed(tmp_path, "[-0.4, 0.4]"), bus="virtual:test-box", joints=("0",), cycles=2)
    )
    assert planned.order.setup.workspace is not None
    narrow = replace(planned.order.setup.workspace, box_m=((-0.2, 0.9), (-0.1, 0.4), (0.0, 1.2)))
    with pytest.raises(SafetyAbort, match=r"y = -0.06\d m is \d+ mm below its bound of -0.060 m, with joints 0 at -\d"):
        run_plan(
            "virtual",
            replace(planned.order.setup, workspace=narrow),
            planned.plan,
            Nothing(),
            notify=lambda _: None,
            proceed=lambda _: True,
        )
