"""The same on a real pseudo terminal and the wall clock, the controller in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from serial_bench import Streamed, stream_motion

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.emulator.pty import Terminal, Waits
from frictid_drivers.motoman.port import SerialPort
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError, HardwareBusy, HardwareError, InputFileError, UsageError
from frictid_hil.jobs.emulate import emulate
from frictid_hil.plan.plan import Hold, JointPlan, Sine
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.recording.mcap_reader import read_mcap
from frictid_hil.simulation.compose import kernel

pytestmark = pytest.mark.slow


@contextmanager
def controller(*faults: str, link: Path | None = None) -> Iterator[str]:
    """An emulated controller in a process of its own, forked with everything loaded; its port."""
    kernel()
    forks = multiprocessing.get_context("fork")
    ours, theirs = forks.Pipe(duplex=False)
    settings = {"announce": theirs.send, "robot_name": "hp3j-serial.yaml", "link": link, "faults": faults}
    process = forks.Process(target=emulate, args=("motoman",), kwargs=settings)
    process.start()
    theirs.close()
    try:
        yield ours.recv()
    finally:
        process.terminate()
        process.join(10)
        assert process.exitcode in (0, -15)


def driver_on(port: str, **options: object) -> MotomanDriver:
    setup = load_robot("hp3j-serial").to_setup(f"serial:{port}")
    # A machine that is busy with other tests needs a longer queue than a quiet one.
    calm = {"lead_ticks": 40, "silence_ms": 1000.0, **options}
    return MotomanDriver(replace(setup, options={**setup.options, **calm}))


@pytest.fixture(scope="module")
def port() -> Iterator[str]:
    with controller() as name:
        yield name


def streamed_on(port: str) -> Streamed:
    driver = driver_on(port)
    try:
        driver.open()
        return stream_motion(driver, ticks=100, travel_rad=0.02)
    finally:
        driver.close()


@pytest.mark.slow
def test_six_joints_stream_over_a_pseudo_terminal(port: str) -> None:
    streamed = streamed_on(port)
    assert len(streamed.rows) > 100
    assert max(row[1] for row in streamed.rows) - streamed.rows[0][1] == pytest.approx(0.02, abs=2e-3)


@pytest.mark.slow
def test_a_job_runs_at_19200_baud_over_a_pseudo_terminal(port: str) -> None:
    driver = driver_on(port, layer="batch")
    driver.open()
    at = load_robot("hp3j-serial").to_setup().joint("3").locked_position_rad
    started = time.monotonic()
    columns = driver.run_batch(JointPlan("3", (Hold(at, 0.1), Sine(at, 0.1, 0.5), Hold(at, 0.1)), {}))
    took_s = time.monotonic() - started
    driver.close()
    rows = len(columns["time_ns"])
    assert columns["position_rad"].max() - at == pytest.approx(0.1, abs=2e-3)
    # 10 bytes per sample as base64, 11 or 10 bits per byte: the line cannot have been faster.
    assert took_s > rows * 10 * 4 / 3 * 10 / 19200


@pytest.mark.slow
def test_the_port_is_ours_alone(port: str) -> None:
    driver = driver_on(port)
    driver.open()
    other = (
        "from frictid_drivers.motoman.port import SerialPort; from frictid_hil.errors import HardwareBusy\n"
        f"try:\n    SerialPort({port!r}, 19200, 'N')\nexcept HardwareBusy as busy:\n    print('busy:', busy)"
    )
    told = subprocess.run([sys.executable, "-c", other], capture_output=True, text=True, check=True).stdout
    assert told == f"busy: {port}: the port is held by another process\n"
    with pytest.raises(HardwareBusy):
        driver_on(port).open()
    driver.close()
    SerialPort(port, 19200, "N").close()


@pytest.mark.parametrize("times", [1, 2])
def test_even_parity_on_a_pseudo_terminal_is_an_error_and_never_a_fallback(port: str, times: int) -> None:
    for _ in range(times):
        with pytest.raises(HardwareError, match="parity E"):
            driver_on(port, parity="E").open()


@pytest.mark.slow
def test_the_verb_prints_its_port_and_ends_quietly_when_asked_to() -> None:
    command = [sys.executable, "-m", "frictid_hil.cli.app", "emulate", "motoman", "--pty"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("port: /dev/")
    process.terminate()
    assert process.communicate(timeout=20) == ("", "")
    assert process.returncode == 0


def test_a_port_that_does_not_exist_says_so() -> None:
    with pytest.raises(HardwareError, match="cannot be opened") as caught:
        driver_on("/dev/no-such-port").open()
    assert not isinstance(caught.value, HardwareBusy)


@pytest.mark.slow
def test_a_port_on_which_nobody_answers_is_given_up_in_time() -> None:
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    driver = driver_on(os.ttyname(theirs), timer_a_s=0.1, retry_1=2)
    started = time.monotonic()
    with pytest.raises(HardwareError, match="no answer to ENQ, asked 3 times"):
        driver.open()
    assert time.monotonic() - started < 2.0
    os.close(ours)
    os.close(theirs)


@pytest.mark.slow
def test_unplugging_is_noticed_at_once() -> None:
    with controller("unplug@60") as port:
        driver = driver_on(port)
        driver.open()
        streamed = Streamed()
        with pytest.raises(HardwareError, match=r"the port failed|no feedback"):
            stream_motion(driver, ticks=2000, into=streamed)
        stopped_s = time.monotonic()
        driver.quick_stop()
        driver.close()
        assert time.monotonic() - stopped_s < 1.0
        assert len(streamed.rows) > 20


@pytest.mark.slow
def test_a_cable_pulled_while_the_arm_moves_stops_it(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = driver_on(port)
    driver.open()
    exchange, cycles = driver.exchange, 0

    def until_pulled(set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        nonlocal cycles
        cycles += 1
        if cycles == 60:
            driver._open_line().port.close()
        return exchange(set_points)

    monkeypatch.setattr(driver, "exchange", until_pulled)
    with pytest.raises(HardwareError, match="the port is closed"):
        stream_motion(driver, ticks=400, travel_rad=0.1)
    driver.close()
    # What was queued, three missed ticks, a deceleration of 25; then two seconds of silence, and host control again.
    time.sleep((40 + 3 + 25) * 0.004 + 2.5)
    after = driver_on(port)
    after.open()
    holds = after._open_line().host.status().holds
    first, second = ([report.position_rad for report in after.standing()] for _ in range(2))
    after.close()
    assert holds == ["command hold"]
    assert first == pytest.approx(second, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("gone_s", [0.4, 3])
def test_a_job_whose_port_comes_back_is_fetched_to_its_end(tmp_path: Path, gone_s: float) -> None:
    at = load_robot("hp3j-serial").to_setup().joint("3").locked_position_rad
    motion = JointPlan("3", (Sine(at, 0.1, 0.5, 8),), {})
    arrived: list[float] = []
    with controller(f"unplug@200:{gone_s}", link=tmp_path / "port") as port:
        assert port == str(tmp_path / "port")
        driver = driver_on(port, layer="batch", watchdog_s=1.5)
        driver.open()
        with pytest.raises(HardwareError, match="the port failed"):
            driver.run_batch(motion, arrived=lambda samples: arrived.extend(samples["position_rad"].tolist()))
        state = driver.standing()[3]
        driver.close()
    kept = driver.batch_columns
    # Gone for 0.4 s, the job had not noticed, and was stopped once we were back; else its watchdog had stopped it.
    assert 200 + 250 * min(gone_s, 1.2) < len(kept["time_ns"]) < 1000
    assert kept["position_rad"].tolist() == arrived
    assert np.abs(kept["position_rad"] - kept["position_command_rad"])[:200].max() < 2e-2
    assert state.position_rad == pytest.approx(kept["position_rad"][-1], abs=1e-2)


@pytest.mark.slow
def test_a_transfer_whose_port_comes_back_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    at = load_robot("hp3j-serial").to_setup().joint("3").locked_position_rad
    with controller("close@130:2", link=tmp_path / "port") as port:
        driver = driver_on(port, layer="batch")
        driver.open()
        line, reopened = driver._open_line().port, []
        reopen = line.reopen

        def reopen_again() -> None:
            reopened.append(time.monotonic())
            reopen()

        monkeypatch.setattr(line, "reopen", reopen_again)
        columns = driver.run_batch(JointPlan("3", (Sine(at, 0.1, 0.5, 3),), {}))
        driver.close()
    assert reopened
    assert len(columns["time_ns"]) == 1 + 3 * 157


@pytest.mark.slow
def test_what_had_come_of_a_running_job_is_on_disk_after_a_kill(tmp_path: Path) -> None:
    robot, out = tmp_path / "robot.yaml", tmp_path / "run"
    robot.write_text(
        "schema: frictid.robot/1\nextends: hp3j-serial.yaml\nname: killed\nbus: serial:none\n"
        "options:\n  layer: batch\n  stream_baud: 0\n"
    )
    with controller() as port:
        command = [sys.executable, "-m", "frictid_hil.cli.app", "calibrate", "--robot", str(robot)]
        command += ["--bus", f"serial:{port}", "--joint", "3", "--yes", "--quiet", "--out", str(out)]
        state = {**os.environ, "XDG_STATE_HOME": str(tmp_path), "FRICTID_RUNTIME_DIR": str(tmp_path)}
        process = subprocess.Popen(command, env=state, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            until_s = time.monotonic() + 60.0
            while recorded(out, "3") < 60:
                assert process.poll() is None
                assert time.monotonic() < until_s
                time.sleep(0.2)
        finally:
            process.kill()
            process.wait(10)
    # The rehearsal alone is a job of 1,372 samples; none of them was on disk before it had ended and come.
    assert 60 <= recorded(out, "3") < 1300


def recorded(out: Path, joint: str) -> int:
    """How many samples a run folder holds, while it is written."""
    try:
        return len(read_mcap(out / "samples.mcap", joint)[0].time_ns)
    except InputFileError:
        return 0


@pytest.mark.slow
def test_a_link_takes_no_other_files_place(tmp_path: Path) -> None:
    taken = tmp_path / "letter"
    taken.write_text("dear")
    with pytest.raises(UsageError, match="no link"):
        Terminal(taken)
    assert taken.read_text() == "dear"


@pytest.mark.slow
def test_the_emulator_tells_how_long_it_waited_for_a_late_host() -> None:
    waits = Waits()
    for passed_s in (0.004, 0.004):
        waits.last(passed_s)
    waits.end()
    waits.last(0.004)
    assert "waited 2 times, 8 ms at most" in str(waits)


STREAMED = [
    *[
        "lost_ack@3",
        "wrong_ack@9",
        "nak@2",
        "bad_bcc@5",
        "garble@11",
        "silence@14:4",
        "enq@1:1",
        "split@0",
        "merge@0:0.01",
    ],
    *[
        "bad_crc@40",
        "lost_frame@50x2",
        "deaf@60",
        "noise@55x2",
        "late@50:0.02",
        "alarm@60:4107",
        "hold@60",
        "drop@50:20",
    ],
    *["close@8", "unplug@40"],
]


@pytest.mark.slow
@pytest.mark.parametrize("fault", STREAMED)
def test_faults_on_a_pseudo_terminal(fault: str, tmp_path: Path) -> None:
    # A name of our own: the kernel gives the number of a terminal that is gone to the next one, of another test.
    with controller(fault, link=tmp_path / "port") as port:
        driver, streamed = driver_on(port), Streamed()
        started = time.monotonic()
        error = None
        try:
            driver.open()
            stream_motion(driver, ticks=100, travel_rad=0.02, into=streamed)
        except FrictidError as caught:
            error = caught
        finally:
            driver.close()
        assert time.monotonic() - started < 60.0
        if fault.split("@")[0] in ("alarm", "hold", "close", "unplug"):
            assert error is not None
            assert error.what
        else:
            assert error is None, f"{error} | {error.cause}"
        assert all(later[0] > earlier[0] for earlier, later in zip(streamed.rows, streamed.rows[1:], strict=False))


@pytest.mark.slow
def test_a_fault_during_the_transfer_on_a_pseudo_terminal() -> None:
    at = load_robot("hp3j-serial").to_setup().joint("3").locked_position_rad
    with controller("bad_bcc@20x2") as port:
        driver = driver_on(port, layer="batch")
        driver.open()
        columns = driver.run_batch(JointPlan("3", (Sine(at, 0.1, 0.5),), {}))
        driver.close()
    assert len(columns["time_ns"]) == 158
