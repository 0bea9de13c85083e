"""What a technician meets when the hardware, the disk or another process is in the way."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest
from called import PROGRAM, run

SHORT = ("--joint", "5", "--amplitude", "8deg", "--velocity", "60deg/s", "--cycles", "3", "--yes")


@pytest.mark.slow
@pytest.mark.parametrize("verb", [("check",), ("calibrate", *SHORT)])
def test_a_bus_that_is_not_there_is_exit_3(verb: tuple[str, ...], tmp_path: Path) -> None:
    result = run(verb[0], "--robot", "hp3j", "--bus", "socketcan:no-such-can", *verb[1:], cwd=tmp_path)
    assert result.returncode == 3, result.stderr
    assert "no-such-can" in result.stderr
    assert "next step" in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.rglob("samples*"))


@pytest.mark.slow
def test_a_drive_that_does_not_answer_is_named(tmp_path: Path) -> None:
    faults = json.dumps([{"kind": "mute", "joint": "3"}])
    result = run("calibrate", "--robot", "hp3j", *SHORT, "--json", cwd=tmp_path, FRICTID_VIRTUAL_FAULTS=faults)
    assert result.returncode == 4, result.stderr
    error = json.loads(result.stdout)["error"]
    assert "node 4" in error["where"], error
    assert error["next_step"]
    assert "Transfer" not in result.stderr, "libraries do not talk to the user"


@pytest.mark.slow
def test_a_drive_that_falls_silent_while_moving_ends_in_a_safety_stop_and_keeps_the_log(tmp_path: Path) -> None:
    faults = json.dumps([{"kind": "mute", "joint": "5", "at_s": 6.0}])
    out = tmp_path / "run"
    result = run(
        "calibrate", "--robot", "hp3j", *SHORT, "--json", "--out", str(out), cwd=tmp_path, FRICTID_VIRTUAL_FAULTS=faults
    )
    assert result.returncode == 4, result.stderr
    answer = json.loads(result.stdout)
    assert answer["outcome"] == "aborted"
    assert (out / "samples.mcap").stat().st_size > 100_000
    again = run("identify", str(out), cwd=tmp_path)
    assert again.returncode == 1, "the cycles never came, and that is said"
    assert "it ended before them: it holds move, rehearsal" in " ".join(again.stderr.split())


@pytest.mark.slow
@pytest.mark.wall_clock
def test_two_processes_on_one_bus(tmp_path: Path) -> None:
    first = subprocess.Popen(
        [PROGRAM, "calibrate", "--robot", "hp3j", *SHORT, "--realtime", "--out", str(tmp_path / "first")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        frames = tmp_path / "first" / "bus.blf"
        until = time.monotonic() + 100
        while not (frames.exists() and frames.stat().st_size > 1000) and time.monotonic() < until:
            time.sleep(0.1)
        second = run("calibrate", "--robot", "hp3j", *SHORT, "--realtime", cwd=tmp_path)
        assert first.poll() is None, first.communicate()[1]
        assert second.returncode == 3, second.stderr
        assert "in use" in second.stderr
    finally:
        first.kill()
        first.wait()


@pytest.mark.slow
def test_a_full_disk_is_told_and_what_was_written_stays(tmp_path: Path) -> None:
    # A limit on file size fails a write just as a full disk does, at a size that we choose.
    limited = subprocess.run(
        ["prlimit", "--fsize=400000", PROGRAM, "calibrate", "--robot", "hp3j", *SHORT, "--out", str(tmp_path / "run")],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=200,
        check=False,
    )
    assert limited.returncode == 1, limited.stderr
    assert "Traceback" not in limited.stderr
    assert (tmp_path / "run" / "samples.mcap").exists()


@pytest.mark.slow
def test_a_folder_that_may_not_be_written_is_told_before_anything_moves(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    result = run("calibrate", "--robot", "hp3j", *SHORT, "--out", str(blocked / "run"), cwd=tmp_path)
    assert result.returncode in (1, 2), result.stderr
    assert "Traceback" not in result.stderr
    assert str(blocked) in result.stderr
