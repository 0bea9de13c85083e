"""The same on a real pseudo terminal and the wall clock, the controller in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import pytest
from serial_bench import Streamed, stream_motion

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.emulator.pty import Waits
from frictid_drivers.motoman.port import SerialPort
from frictid_hil.config.robot import load_robot
from frictid_hil.driver import Feedback, SetPoint
from frictid_hil.errors import FrictidError, HardwareBusy, HardwareError
from frictid_hil.plan import Hold, JointPlan, Sine

SERVE = """
import sys
from frictid_hil.jobs.emulate import emulate
emulate("motoman", announce=lambda port: print(port, flush=True), faults=sys.argv[1:])
"""


@contextmanager
def controller(*faults: str) -> Iterator[str]:
    """An emulated controller; its port."""
    process = subprocess.Popen([sys.executable, "-c", SERVE, *faults], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.terminate()
        assert process.wait(10) in (0, -15)


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


def test_six_joints_stream_over_a_pseudo_terminal(port: str) -> None:
    streamed = streamed_on(port)
    assert len(streamed.rows) > 100
    assert max(row[1] for row in streamed.rows) - streamed.rows[0][1] == pytest.approx(0.02, abs=2e-3)


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


def test_a_cable_pulled_while_the_arm_moves_stops_it(port: str) -> None:
    driver = driver_on(port)
    driver.open()
    exchange, cycles = driver.exchange, 0

    def until_pulled(set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        nonlocal cycles
        cycles += 1
        if cycles == 60:
            driver._open_line().port.close()
        return exchange(set_points)

    driver.exchange = until_pulled  # type: ignore[method-assign]
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


def test_the_emulator_tells_how_long_it_waited_for_a_late_host() -> None:
    waits = Waits()
    for passed_s in (0.004, 0.004):
        waits.begin()
        waits.last(passed_s)
    waits.end()
    waits.begin()
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
def test_faults_on_a_pseudo_terminal(fault: str) -> None:
    with controller(fault) as port:
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
