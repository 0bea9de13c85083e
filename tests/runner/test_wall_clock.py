"""On the wall clock: three processes, any of which may be killed at any moment."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import psutil
import pytest

from frictid_hil.errors import InputFileError
from frictid_hil.recording.bus_log import read_frames
from frictid_hil.recording.mcap_reader import read_mcap

pytestmark = [pytest.mark.slow, pytest.mark.wall_clock]

JOINT = "5"
NODE = 6
COUNTS_PER_RAD = 131072 * 81.5 / (2 * math.pi)
# A busy computer pauses a loop for less than these bounds, and that must not end a run.
CARE = {"silence_s": 0.2, "following_error_rad": 0.4}
ROBOT = {"schema": "frictid.robot/1", "extends": "hp3j", "name": "patient", "cycle_hz": 250, "care": CARE}


class Terminal:
    """A terminal that somebody watches until it is closed."""

    def __init__(self) -> None:
        self._ours, self.program_side = pty.openpty()
        self._shown = bytearray()
        self._closing = threading.Event()
        self._watch = threading.Thread(target=self._look)
        self._watch.start()

    def close(self) -> str:
        """What it has shown until now."""
        self._closing.set()
        self._watch.join()
        return self._shown.decode(errors="replace")

    def _look(self) -> None:
        with contextlib.suppress(OSError):  # nobody writes to it any more
            while not self._closing.is_set():
                if select.select([self._ours], [], [], 0.05)[0]:
                    self._shown += os.read(self._ours, 4096)
        os.close(self._ours)


class Running:
    """A calibration in the background, and an ear on its bus; of three cycles, the second of which is fast.

    Args:
        out: folder of the run.
        channel: of the bus.
        terminal: that it runs on; None for a pipe.
    """

    def __init__(self, out: Path, channel: str, terminal: Terminal | None = None) -> None:
        self.out = out
        out.mkdir(parents=True)
        robot = out.with_suffix(".yaml")
        robot.write_text(json.dumps(ROBOT))
        self.terminal = terminal
        shown_on = None if terminal is None else terminal.program_side
        program = Path(sys.executable).parent / "frictid-hil"
        self.parent = subprocess.Popen(
            [
                str(program),
                *("calibrate", "--robot", str(robot), "--joint", JOINT, "--cycles", "3", "--realtime", "--yes"),
                *("--bus", f"virtual:{channel}", "--out", str(out)),
            ],
            stdin=shown_on,
            stdout=subprocess.PIPE if shown_on is None else shown_on,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=terminal is not None,
            preexec_fn=None if terminal is None else lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        if shown_on is not None:
            os.close(shown_on)
        self.bus = self._listen(channel)

    def reaches_its_cycles(self) -> None:
        """Wait until it moves faster than the slow moves around the cycles do."""
        until = time.monotonic() + 60
        before: tuple[float, float] | None = None
        with contextlib.suppress(can.CanError):  # the simulated bus ends with its owner
            while time.monotonic() < until:
                at = self.position_rad()
                if before is not None and at is not None and at[0] - before[0] > 0.1:
                    if abs(at[1] - before[1]) / (at[0] - before[0]) > math.radians(60):
                        return
                    before = at
                before = before or at
        self.parent.terminate()
        raise AssertionError(f"the cycles never began: {self.last_words()}")

    def position_rad(self) -> tuple[float, float] | None:
        """(time it was sent, position) of the next report of the joint."""
        message = self.bus.recv(0.5)
        if message is None or message.arbitration_id != 0x180 + NODE or len(message.data) < 6:
            return None
        return message.timestamp, struct.unpack_from("<i", message.data, 2)[0] / COUNTS_PER_RAD

    def child(self) -> psutil.Process:
        """The process of the cyclic loop."""
        loops = [c for c in psutil.Process(self.parent.pid).children() if "spawn_main" in " ".join(c.cmdline())]
        assert loops, f"the run ended early: {self.last_words()}"
        return loops[0]

    def last_run_time_s(self) -> float:
        """Run time of the newest readable sample."""
        with contextlib.suppress(InputFileError):
            return max(float(samples.time_ns[-1]) * 1e-9 for samples in read_mcap(self.out / "samples.mcap"))
        return 0.0

    def last_words(self) -> str:
        """What the command printed until its end. Drives without a host live on while somebody listens to them."""
        self.bus.shutdown()
        said = self.parent.communicate(timeout=60)[0]
        return said if self.terminal is None else self.terminal.close()

    def end(self) -> None:
        """Whatever became of it."""
        self.parent.kill()
        self.parent.wait()
        self.bus.shutdown()
        if self.terminal is not None:
            self.terminal.close()

    @staticmethod
    def _listen(channel: str) -> can.BusABC:
        for _ in range(900):
            with contextlib.suppress(can.CanError, OSError):
                return can.Bus(interface="frictid", channel=channel)
            time.sleep(0.1)
        raise AssertionError("the simulated bus never came up")


@contextlib.contextmanager
def in_its_cycles(folder: Path, terminal: Terminal | None = None) -> Iterator[Running]:
    run = Running(folder / "run", f"kill-{os.getpid()}-{folder.name}", terminal)
    try:
        run.reaches_its_cycles()
        yield run
    finally:
        run.end()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    with in_its_cycles(tmp_path) as run:
        yield run


def positions_until_quiet(run: Running, seconds: float) -> list[float]:
    """Every position reported from now until the bus is gone or the time is over."""
    seen: list[float] = []
    until = time.monotonic() + seconds
    with contextlib.suppress(can.CanError):  # the simulated bus ends with its owner
        while time.monotonic() < until:
            at = run.position_rad()
            if at is not None:
                seen.append(at[1])
    return seen


def asked(run: Running, index: int, layout: str) -> int:
    """An object of the drive, read by SDO from the second seat on the bus."""
    run.bus.send(
        can.Message(arbitration_id=0x600 + NODE, data=struct.pack("<BHB4x", 0x40, index, 0), is_extended_id=False)
    )
    until = time.monotonic() + 2
    while time.monotonic() < until:
        message = run.bus.recv(0.5)
        if message is not None and message.arbitration_id == 0x580 + NODE:
            value: int = struct.unpack_from(layout, message.data, 4)[0]
            return value
    raise AssertionError(f"the drive did not answer for {index:04X}")


def test_a_killed_parent_loses_at_most_half_a_second_and_the_loop_stops_the_joint(running: Running) -> None:
    known_s, known_at = running.last_run_time_s(), time.monotonic()
    time.sleep(1.5)
    loop = running.child()
    running.parent.kill()
    killed_at = time.monotonic()
    last = positions_until_quiet(running, 5.0)[-50:]
    assert np.ptp(last) < math.radians(0.05), "the joint stood before the loop ended"
    loop.wait(timeout=5)
    running.parent.wait()
    assert running.last_run_time_s() >= known_s + (killed_at - known_at) - 0.5
    assert len(read_frames(running.out / "bus.blf")) > 1000


def test_a_killed_loop_leaves_the_joint_to_the_drives_watchdog(running: Running) -> None:
    running.child().send_signal(signal.SIGKILL)
    # The drive's heartbeat consumer is set to 100-200 ms; its quick stop ramps after that.
    positions_until_quiet(running, 1.0)
    before = asked(running, 0x6064, "<i")
    time.sleep(0.2)
    moved_rad = abs(asked(running, 0x6064, "<i") - before) / COUNTS_PER_RAD
    status = asked(running, 0x6041, "<H")
    assert moved_rad < math.radians(0.01)
    assert status & 0x6F != 0x27, "no longer in operation enabled"
    said = running.last_words()
    assert running.parent.returncode == 4, said
    assert "ended without a word" in said, said
    assert "Traceback" not in said
    assert running.last_run_time_s() > 3.0


def shared_memory() -> set[str]:
    return {path.name for path in Path("/dev/shm").glob("psm_*")}


def test_a_suspended_loop_does_not_hang_its_parent(running: Running) -> None:
    loop = running.child()
    mine = {path.split("/")[-1] for path in (m.path for m in loop.memory_maps()) if "/dev/shm/psm_" in path}
    assert mine
    loop.send_signal(signal.SIGSTOP)
    running.parent.send_signal(signal.SIGINT)
    said = running.last_words()
    assert running.parent.returncode == 4, said
    assert "hung" in said and "may still have power" in said, said
    assert "Traceback" not in said
    assert not loop.is_running() or loop.status() == psutil.STATUS_ZOMBIE
    assert not mine & shared_memory()


def test_a_hang_up_stops_the_run_like_ctrl_c_and_leaves_no_shared_memory(running: Running) -> None:
    mine = {m.path.split("/")[-1] for m in running.child().memory_maps() if "/dev/shm/psm_" in m.path}
    running.parent.send_signal(signal.SIGHUP)
    said = running.last_words()
    assert running.parent.returncode == 130, said
    assert "brought to rest" in said, said
    assert mine and not mine & shared_memory()


def test_a_closed_terminal_stops_the_run_like_ctrl_c(tmp_path: Path) -> None:
    with in_its_cycles(tmp_path, Terminal()) as run:
        assert run.terminal is not None
        run.terminal.close()
        positions_until_quiet(run, 0.5)
        run.bus.shutdown()
        run.parent.wait(60)
        manifest = (run.out / "manifest.json").read_text()
        assert run.parent.returncode == 130, manifest
        assert json.loads(manifest)["outcome"] == "interrupted"
        assert run.last_run_time_s() > 3.0


def speed_at_the_quick_stop_rad_s(run: Running) -> float:
    """Of the joint, as recorded, when its drive began its quick stop; that also ends a stop along the path."""
    frames = read_frames(run.out / "bus.blf")
    reports = np.flatnonzero((frames.can_id == 0x180 + NODE) & (frames.length >= 6))
    position = frames.data[reports, 2:6].copy().view("<i4")[:, 0] / COUNTS_PER_RAD
    began = int(np.flatnonzero(frames.data[reports, 0] & 0x6F == 0x07)[0])
    before = slice(began - 3, began)
    return float(np.ptp(position[before]) / np.ptp(frames.t_ns[reports][before]) * 1e9)


@pytest.mark.parametrize(("first", "second"), [(signal.SIGINT, signal.SIGTERM), (signal.SIGHUP, signal.SIGINT)])
def test_twice_stops_quickly(running: Running, first: int, second: int) -> None:
    running.parent.send_signal(first)
    running.parent.send_signal(second)
    said = running.last_words()
    assert running.parent.returncode == 130, said
    assert "Traceback" not in said
    assert speed_at_the_quick_stop_rad_s(running) > math.radians(10), said


def test_ctrl_c_decelerates_keeps_the_log_and_exits_130(running: Running) -> None:
    running.parent.send_signal(signal.SIGINT)
    said = running.last_words()
    assert running.parent.returncode == 130, said
    assert "brought to rest" in said, said
    assert "Traceback" not in said
    assert running.last_run_time_s() > 3.0
    assert speed_at_the_quick_stop_rad_s(running) < math.radians(2)
