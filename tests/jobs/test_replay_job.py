"""A recorded run replays to the identical profile; damage is told; foreign logs are decoded by a frame map."""

from __future__ import annotations

import configparser
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

import frictid_drivers.virtual
from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import ConfigError, InputFileError, UsageError
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.bus_logs import lost_rows
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.replay import ReplayOptions, replay, simulate
from frictid_hil.jobs.watch import Silent
from frictid_hil.recording.bus_log import BusLogWriter, LogBus, logged, read_frames
from frictid_hil.recording.samples import Samples

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The smallest joint of the shipped robot alone, so that a run takes seconds."""
    values = load_robot("hp3j").values()
    values |= {"name": "replayed", "bus": "virtual:replayed", "joints": {"5": values["joints"]["5"]}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3}
    path = tmp_path_factory.mktemp("robot") / "replayed.yaml"
    path.write_text(dump(values))
    return str(path)


@pytest.fixture(scope="module")
def run(robot: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("runs") / "run"
    result = calibrate(CalibrateOptions(robot, out=place), Silent()).to_json()
    assert result["outcome"] == "ok", result
    return place


def test_a_run_replays_to_the_identical_profile(run: Path, robot: str, tmp_path: Path) -> None:
    result = replay(ReplayOptions(run, robot, out=tmp_path))
    assert result["outcome"] == "ok"
    assert result["identical"] is True
    assert result["log"]["unknown"] == {} and result["log"]["lost_rows"] == {"5": 0}
    live, played = load_profile(run / "profile.yaml"), load_profile(Path(result["profile"]))
    assert live.content_sha256 == played.content_sha256


def test_set_points_on_the_simulated_joint_move_it_as_recorded(run: Path, robot: str, tmp_path: Path) -> None:
    result = replay(ReplayOptions(run, robot, out=tmp_path))
    step_rad = 2 * np.pi / 131072 / load_robot(robot).file.joints["5"].gear_ratio
    assert result["position_rms_rad"] < 1e-4
    (csv,) = result["simulated"]
    header, first, *_ = Path(csv).read_text().splitlines()
    assert header.startswith("time_s,position_rad") and header.endswith("simulated_torque_nm")
    assert len(first.split(",")) == len(header.split(","))
    # The joint proved its units before this recording begins: how its gear was left bent shows at the very first move.
    rows = np.genfromtxt(csv, delimiter=",", names=True)
    later = rows[rows["time_s"] > rows["time_s"][0] + 1.5]
    assert np.abs(later["simulated_position_rad"] - later["position_rad"]).max() < 2 * step_rad
    # What is left of the torque is the drive's noise: 5 per mille of rated.
    torque = later["simulated_torque_nm"] - later["torque_nm"]
    assert np.sqrt(np.mean(torque**2)) < 0.007 * load_robot(robot).file.joints["5"].rated_torque_nm


def test_a_log_of_every_eighth_cycle_is_no_later_for_that(run: Path, robot: str, tmp_path: Path) -> None:
    (csv,) = replay(ReplayOptions(run, robot, out=tmp_path))["simulated"]
    rows = np.genfromtxt(csv, delimiter=",", names=True)[::8]
    names = ("position_rad", "velocity_rad_s", "torque_nm", "position_command_rad")
    columns: dict[str, Any] = {name: rows[name] for name in names}
    time_ns = np.round(1e9 * rows["time_s"]).astype(np.int64)
    thinned = Samples(joint="5", time_ns=time_ns, **columns)
    half_a_row_s = 0.5 * float(np.median(np.diff(thinned.time_s)))
    left_rad = simulate(load_robot(robot), thinned).position_rms_rad
    assert left_rad < 0.1 * half_a_row_s * np.sqrt(np.mean(rows["velocity_rad_s"] ** 2))


@pytest.mark.parametrize("name", ["profile.yaml", "simulated-5.csv"])
def test_nothing_is_written_over_unless_told(run: Path, robot: str, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(UsageError, match="exists already") as told:
        replay(ReplayOptions(run, robot, out=tmp_path))
    assert "--force" in told.value.next_step and (tmp_path / name).read_text() == "mine"


def test_another_joint_is_told_apart(run: Path, robot: str, tmp_path: Path) -> None:
    values = load_robot(robot).values()
    values["joints"]["5"]["simulated"]["inertia_kg_m2"] *= 3.0
    heavier = tmp_path / "heavier.yaml"
    heavier.write_text(dump(values))
    own, other = (replay(ReplayOptions(run, name))["torque_rms_nm"] for name in (robot, str(heavier)))
    assert other > 1.3 * own


def test_one_torque_changed_in_the_log_is_another_profile(run: Path, robot: str, tmp_path: Path) -> None:
    frames = read_frames(run / "bus.blf")
    (mark,) = [
        m for m in json.loads((run / "manifest.json").read_text())["sessions"][0]["marks"] if m["name"] == "cycles"
    ]
    node = load_robot(robot).file.joints["5"].node
    inside = np.flatnonzero((frames.can_id == 0x180 + node) & (frames.t_ns > (mark["start_ns"] + mark["end_ns"]) // 2))
    frames.data[inside[:50], 6] ^= 0x40
    result = replay(ReplayOptions(copied(run, tmp_path, list(logged(frames))), robot, simulation=False))
    assert result["identical"] is False


@pytest.mark.parametrize("kind", ["removed", "swapped", "doubled"])
def test_one_percent_of_damage_is_told_and_changes_the_curve_by_less_than_one_percent(
    run: Path, robot: str, tmp_path: Path, kind: str
) -> None:
    frames = list(logged(read_frames(run / "bus.blf")))
    random = np.random.default_rng(7)
    picked = set(random.choice(len(frames) - 1, len(frames) // 100, replace=False).tolist())
    spoilt = []
    for at, frame in enumerate(frames):
        if kind == "swapped" and at - 1 in picked:
            spoilt.insert(len(spoilt) - 1, frame)
        elif kind != "removed" or at not in picked:
            spoilt += [frame, frame] if kind == "doubled" and at in picked else [frame]
    result = replay(ReplayOptions(copied(run, tmp_path, spoilt), robot, simulation=False))
    joint, log = result["joints"]["5"], result["log"]
    assert result["outcome"] == "ok" and joint["difference_percent"] < 1.0
    told = {"removed": log["lost_rows"]["5"], "swapped": log["backwards"], "doubled": log["repeated"]}
    assert told[kind] > 0


def test_a_log_that_lacks_much_is_gated(run: Path, robot: str, tmp_path: Path) -> None:
    frames = list(logged(read_frames(run / "bus.blf")))
    random = np.random.default_rng(3)
    kept = [frame for frame in frames if random.random() > 0.06]
    result = replay(ReplayOptions(copied(run, tmp_path, kept), robot, simulation=False))
    assert result["outcome"] == "gate_failed"
    assert "missing from the log" in result["error"]["what"]


def test_a_foreign_log_needs_a_frame_map_and_unknown_frames_are_named(run: Path, robot: str, tmp_path: Path) -> None:
    session = json.loads((run / "manifest.json").read_text())["sessions"][0]
    (mark,) = [mark for mark in session["marks"] if mark["name"] == "cycles"]
    cut = (mark["start_ns"] - 300_000_000, mark["end_ns"])
    frames = [frame for frame in logged(read_frames(run / "bus.blf")) if cut[0] <= frame[0] < cut[1]]
    frames += [(frames[-1][0] + 1, 0x123, b"\1"), (frames[-1][0] + 2, 0x80000000 | 0x1ABCDE, b"")]
    log = tmp_path / "foreign.asc"
    with can.ASCWriter(log) as writer:
        for t_ns, can_id, data in frames:
            extended = bool(can_id >> 31)
            writer.on_message_received(
                can.Message(
                    timestamp=1.7e9 + t_ns * 1e-9,
                    arbitration_id=can_id & 0x1FFFFFFF,
                    is_extended_id=extended,
                    data=data,
                )
            )
    with pytest.raises(UsageError, match="which frame carries what"):
        replay(ReplayOptions(log, robot))
    mapping = json.loads((run / "manifest.json").read_text())["frame_maps"]["bus.blf"]
    described = tmp_path / "frames.yaml"
    described.write_text(dump(mapping))
    result = replay(
        ReplayOptions(
            log, robot, frames=described, procedure=Procedure(0.2, 1.5, 3, 0.8), profile=run, simulation=False
        )
    )
    assert result["log"]["unknown"] == {"frame 0x123": 1, "extended frame 0x001abcde": 1}
    assert result["joints"]["5"]["difference_percent"] is not None, result["joints"]["5"]["remarks"]
    assert result["joints"]["5"]["difference_percent"] < 1.0


@pytest.mark.parametrize("name", ["foreign.log", "foreign.asc", "foreign.blf", "foreign.trc"])
def test_a_log_in_any_format_gives_the_same_curve(name: str, run: Path, robot: str, tmp_path: Path) -> None:
    """As python-can writes them: candump, ASC, BLF, TRC; with a frame that no map describes."""
    manifest = json.loads((run / "manifest.json").read_text())
    (mark,) = [mark for mark in manifest["sessions"][0]["marks"] if mark["name"] == "cycles"]
    frames = [
        frame
        for frame in logged(read_frames(run / "bus.blf"))
        if mark["start_ns"] - 300_000_000 <= frame[0] < mark["end_ns"]
    ]
    with can.Logger(tmp_path / name) as writer:
        for t_ns, can_id, data in [*frames, (frames[-1][0] + 1, 0x123, b"\1")]:
            stamp = 1.7e9 + t_ns * 1e-9
            message = can.Message(timestamp=stamp, arbitration_id=can_id, is_extended_id=False, data=data, channel=1)
            writer.on_message_received(message)
    described = tmp_path / "frames.yaml"
    described.write_text(dump(manifest["frame_maps"]["bus.blf"]))
    procedure = Procedure(0.2, 1.5, 3, 0.8)
    options = ReplayOptions(
        tmp_path / name, robot, frames=described, procedure=procedure, profile=run, simulation=False
    )
    result = replay(options)
    assert result["log"]["frames"] == len(frames) + 1 and result["log"]["unknown"] == {"frame 0x123": 1}
    assert result["log"]["lost_rows"] == {"5": 0}
    assert result["joints"]["5"]["difference_percent"] < 1.0


def test_a_candump_log_and_an_eds_give_the_same_curve(run: Path, robot: str, tmp_path: Path) -> None:
    """From the shell, as somebody with a logger and a vendor's tool has it: no run folder, no manifest."""
    manifest = json.loads((run / "manifest.json").read_text())
    (mark,) = [mark for mark in manifest["sessions"][0]["marks"] if mark["name"] == "cycles"]
    with can.CanutilsLogWriter(tmp_path / "drive.log") as writer:
        for t_ns, can_id, data in logged(read_frames(run / "bus.blf")):
            if mark["start_ns"] - 300_000_000 <= t_ns < mark["end_ns"]:
                stamp = 1.7e9 + t_ns * 1e-9
                message = can.Message(timestamp=stamp, arbitration_id=can_id, is_extended_id=False, data=data)
                writer.on_message_received(message)
    eds = mapped_eds(manifest["frame_maps"]["bus.blf"]["joints"]["5"], robot, tmp_path / "drive.dcf")
    command = [sys.executable, "-m", "frictid_hil.cli.app", "replay", str(tmp_path / "drive.log"), "--robot", robot]
    command += ["--eds", str(eds), "--profile", str(run), "--no-simulate", "--json"]
    command += ["--amplitude", "0.2rad", "--velocity", "1.5rad/s", "--cycles", "3", "--ratio", "0.8"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert answer.returncode == 0, answer.stdout
    result = json.loads(answer.stdout)
    # A data sheet of drives does not tell of the host, whose heartbeat they watch.
    assert result["log"]["unknown"].keys() == {"heartbeat of node 127"} and result["log"]["lost_rows"] == {"5": 0}
    assert result["joints"]["5"]["difference_percent"] < 1.0


def mapped_eds(frames: dict[str, Any], robot: str, path: Path) -> Path:
    """The simulated drive's EDS with the mapping of a run as parameter values: a DCF, as commissioning tools export."""
    dcf = configparser.ConfigParser(interpolation=None)
    dcf.optionxform = str  # type: ignore[assignment,method-assign]  # keys keep their case
    dcf.read(Path(frictid_drivers.virtual.__file__).with_name("frictid_servo.eds"))
    for communication, mapping, described in ((0x1800, 0x1A00, "reports"), (0x1400, 0x1600, "commands")):
        for number, frame in enumerate(frames[described]):
            dcf[f"{communication + number:04X}sub1"]["ParameterValue"] = hex(frame["cob_id"])
            dcf[f"{mapping + number:04X}sub0"]["ParameterValue"] = str(len(frame["objects"]))
            for sub, named in enumerate(frame["objects"], start=1):
                index, object_sub, bits = named[:4], named[5:7], int(named.split()[1][1:])
                dcf[f"{mapping + number:04X}sub{sub}"]["ParameterValue"] = f"0x{index}{object_sub}{bits:02X}"
    joint = load_robot(robot).file.joints["5"]
    assert joint.rated_torque_nm is not None
    dcf["60A9"]["ParameterValue"] = "0xFDB44700"  # 0.001 revolutions per minute, as the host sets it
    dcf["6091sub1"]["ParameterValue"], dcf["6091sub2"]["ParameterValue"] = "163", "2"
    dcf["6092sub1"]["ParameterValue"] = str(131072 * 163 // 2)
    dcf["6076"]["ParameterValue"] = str(round(1000 * joint.rated_torque_nm / joint.gear_ratio))
    with path.open("w") as file:
        dcf.write(file, space_around_delimiters=False)
    return path


def test_a_wrong_frame_map_is_told_with_its_place(run: Path, robot: str, tmp_path: Path) -> None:
    described = tmp_path / "frames.yaml"
    described.write_text("schema: frictid.frames/1\njoints:\n  '5': {node: 400, position_rad_per_unit: 1.0e-6}\n")
    with pytest.raises(ConfigError, match="node"):
        replay(ReplayOptions(run / "bus.blf", robot, frames=described))


def test_a_log_of_other_frames_says_what_it_saw(robot: str, run: Path, tmp_path: Path) -> None:
    other = copied(run, tmp_path, [(k * 1000, 0x321, b"\0") for k in range(50)])
    with pytest.raises(InputFileError, match="no report") as told:
        replay(ReplayOptions(other, robot))
    assert "50 x frame 0x321" in told.value.cause


def test_a_log_is_a_bus_that_paces_and_echoes(run: Path) -> None:
    frames = read_frames(run / "bus.blf")
    echo, ear = (can.Bus(interface="virtual", channel="echo-of-a-log") for _ in range(2))
    with echo, ear, LogBus(frames, echo=echo) as bus:
        first = bus.recv(0.1)
        heard = ear.recv(0.1)
        assert first is not None and heard is not None
        assert (first.arbitration_id, bytes(first.data)) == (heard.arbitration_id, bytes(heard.data))
    first_ns = next(t for t, *_ in logged(frames))
    later = next(t for t, *_ in logged(frames) if t > first_ns + 200_000_000)
    began = time.monotonic()
    with LogBus(frames, paced=True) as bus:
        while (taken := bus.take()) is not None and taken[0] < later:
            pass
        assert time.monotonic() - began > 0.19


def test_lost_rows_are_counted_from_the_times() -> None:
    time_ns = np.arange(1000) * 1_000_000
    assert lost_rows(time_ns) == (0, 0.0)
    assert lost_rows(np.delete(time_ns, [5, 6, 500]))[0] == 3


def copied(run: Path, place: Path, frames: list[tuple[int, int, bytes]]) -> Path:
    """The same run with other frames in its log."""
    folder = place / "copy"
    folder.mkdir()
    for name in ("manifest.json", "profile.yaml"):
        shutil.copy(run / name, folder / name)
    with BusLogWriter(folder / "bus.blf") as writer:
        for frame in frames:
            writer.frame(*frame, False)
    return folder
