"""The whole verb over the serial driver in virtual time: plan, jobs or stream, recording, identification, outcome."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.emulator.build import build
from frictid_drivers.motoman.emulator.faults import Fault, FaultPlan
from frictid_drivers.motoman.emulator.loopback import LoopbackPort
from frictid_hil.config.profile import load_profile
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate, plan_calibration
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.recording.mcap_reader import read_mcap
from frictid_hil.runner.events import Event, JobProgress
from frictid_hil.runs.folder import load_manifest

ROBOT = """\
schema: frictid.robot/1
extends: hp3j-serial.yaml
name: bench
bus: serial:loopback
options:
  layer: {layer}
  emulator:
    averaging_ms: {averaging_ms}
"""
QUICK = {"program": "quick", "joints": ("5",)}
"""Two fast cycles of one light joint: what matters here is how a run ends."""

Calibrate = Callable[..., dict[str, Any]]


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """A robot file; and from now on every run on it meets an emulated controller on virtual time."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def made(*, layer: str = "batch", averaging_ms: int = 0, faults: tuple[str, ...] = ()) -> Path:
        plan = FaultPlan(Fault.parse(text) for text in faults)

        def driver(setup: RobotSetup) -> MotomanDriver:
            emulator = build(setup, plan)
            return MotomanDriver(setup, port_factory=lambda path, baud, parity: LoopbackPort(emulator, baud, parity))

        monkeypatch.setattr("frictid_hil.runs.run.new_driver", lambda name, setup: driver(setup))
        path = tmp_path / "bench.yaml"
        path.write_text(ROBOT.format(layer=layer, averaging_ms=averaging_ms))
        return path

    return made


def options(robot: Path, out: Path, **changes: Any) -> CalibrateOptions:
    return CalibrateOptions(str(robot), out=out, **{**QUICK, **changes})


def test_the_plan_shows_cycles_of_whole_ticks_before_anything_is_opened(robot: Callable[..., Path]) -> None:
    planned = plan_calibration(CalibrateOptions(str(robot()), joints=("5",)))
    assert any("1364, 684, 456, 340, 272, 228, 196, 172, 152, 136 ticks of 4 ms" in note for note in planned.plan.notes)
    (cycles,) = [motion for motion in planned.plan.joints[0].motions if motion.name == "cycles"]
    assert cycles.duration_s == pytest.approx(4000 * 0.004)


@pytest.mark.slow
def test_one_joint_in_batch_at_19200_is_within_the_bar(robot: Callable[..., Path], tmp_path: Path) -> None:
    path = robot()
    events: list[Event] = []

    class Watching(Silent):
        def event(self, event: Event) -> None:
            events.append(event)

    result = calibrate(options(path, tmp_path / "run", joints=("1",), program="thorough"), Watching()).to_json()
    assert result["outcome"] == "ok", result["joints"]["1"]["remarks"]
    distance = compare(tmp_path / "run", None, str(path))["joints"]["1"]
    assert distance["e_percent_measured_range"] < 0.5
    # What was really planned is recorded, not what was asked for.
    profile = load_profile(tmp_path / "run" / "profile.yaml").joint("1")
    assert profile.procedure is not None and profile.procedure.shares is not None
    ticks = np.rint(np.pi * profile.procedure.amplitude_rad / profile.procedure.velocity_rad_s / 0.004)
    assert ticks == 136
    stages = [(event.stage, event.share) for event in events if isinstance(event, JobProgress)]
    assert {stage for stage, _ in stages} == {"motion", "transfer"}
    assert stages[-1] == ("transfer", 1.0)
    names = [mark["name"] for mark in load_manifest(tmp_path / "run")["sessions"][0]["marks"]]
    assert names == ["move", "rehearsal", "hold", "cycles", "drift", "hold", "reversal", "return", "hold"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "exit_code", "told"),
    [
        ("hold@300", 4, "pressed hold"),
        ("alarm@900:4107", 4, "alarm 4107"),
        ("unplug@1600", 3, "port is gone"),
        ("close@400", 3, "port is gone"),
        ("lost_block@60x400", 3, "no reply|no answer|ended|silent|unreadable"),
    ],
)
def test_a_fault_in_batch_keeps_the_recording_and_resumes(
    robot: Callable[..., Path], tmp_path: Path, fault: str, exit_code: int, told: str
) -> None:
    path = robot(faults=(fault,))
    result = calibrate(options(path, tmp_path / "run"), Silent()).to_json()
    assert result["exit_code"] == exit_code, result

    assert re.search(told, result["error"]["what"] + result["error"]["cause"]), result["error"]
    (kept,) = read_mcap(tmp_path / "run" / "samples.mcap", "5")
    assert len(kept.time_ns) > 100
    assert np.all(np.diff(kept.time_ns) > 0)
    path = robot()
    resumed = calibrate(options(path, tmp_path / "run", resume=tmp_path / "run"), Silent()).to_json()
    assert resumed["outcome"] == "ok", resumed
    assert resumed["joints"]["5"]["rate_hz"] == 250.0


@pytest.mark.slow
@pytest.mark.parametrize("layer", ["stream", "batch"])
def test_an_averaging_filter_of_150_ms_ends_in_the_gates_refusal(
    robot: Callable[..., Path], tmp_path: Path, layer: str
) -> None:
    """Not in a safety abort, and not in wrong friction: the fast cycles are named, and so is the filter."""
    result = calibrate(
        options(
            robot(layer=layer, averaging_ms=150),
            tmp_path / "run",
            joints=("3",),
            program="thorough",
            amplitude_rad=0.349,
        ),
        Silent(),
    ).to_json()
    assert (result["outcome"], result["exit_code"]) == ("gate_failed", 5), result
    (remark,) = [text for text in result["joints"]["3"]["remarks"] if text.startswith("tracking")]
    assert "averag" in remark
    assert "cycle 10" in remark
