"""Kills of a moving run on the wall clock: its commander, its loop, or both, at moments that are drawn.

    python benchmarks/run_kills.py [--kills 60] [--seed 1] [--kept FILE]

Every run is `frictid-hil calibrate --realtime` of one simulated joint: commander, loop and drives are processes. One of
them is killed (SIGKILL) a while after the drive was first heard. The drive's own reports and answers on the bus, heard
from a second seat, tell whether the joint came to rest and lost its power; the files tell what was kept:

* **commander**: the loop sees it within a cycle and brings the joint to rest along its path, then power off;
* **loop**: the drive misses its heartbeat and stops by itself; the commander writes everything down and ends with 4;
* **both**: the drive stops by itself.

The recording must be readable and reach to the kill, but for the last half second that nobody had written yet.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import can
import psutil

from frictid_hil.errors import FrictidError
from frictid_hil.recording.mcap_reader import read_mcap

JOINT, NODE = "5", 6
COUNTS_PER_RAD = 131072 * 81.5 / (2 * math.pi)
VICTIMS = ("commander", "loop", "both")
LATEST_S = 18.0
"""The moment is drawn from so many seconds after the drive's first report: nearly the whole run."""
LISTENS_S = 3.0
STANDS_RAD_S = math.radians(1.0)
MOST_S = 1.2
"""From the kill to standstill: 0.5 s of the loop, or the drive's 0.15 s and its ramp; and what a busy computer adds."""
UNWRITTEN_S = 0.5 + 0.25


@dataclass
class Killed:
    """What one run showed."""

    number: int
    victim: str
    after_s: float
    speed_rad_s: float = 0.0
    rest_s: float = 0.0
    exit_code: int = 0
    lost_s: float = 0.0
    failures: list[str] = field(default_factory=list)


class Seat:
    """A second seat on the bus: what the drive reports, and when it was heard."""

    def __init__(self, channel: str) -> None:
        self.bus = _listen(channel)
        self.heard: list[tuple[float, float, int]] = []

    def listen(self, until_s: float) -> None:
        """Until then, or until the bus is gone."""
        with contextlib.suppress(can.CanError, OSError):
            while time.monotonic() < until_s:
                message = self.bus.recv(0.05)
                if message is not None and message.arbitration_id == 0x180 + NODE and len(message.data) >= 6:
                    status, counts = struct.unpack_from("<Hi", message.data, 0)
                    self.heard.append((time.monotonic(), counts / COUNTS_PER_RAD, status))

    def asked(self, index: int, layout: str) -> int | None:
        """An object of the drive; None where the bus is gone."""
        with contextlib.suppress(can.CanError, OSError):
            request = struct.pack("<BHB4x", 0x40, index, 0)
            self.bus.send(can.Message(arbitration_id=0x600 + NODE, data=request, is_extended_id=False))
            until_s = time.monotonic() + 2.0
            while time.monotonic() < until_s:
                message = self.bus.recv(0.5)
                if message is not None and message.arbitration_id == 0x580 + NODE:
                    return int(struct.unpack_from(layout, message.data, 4)[0])
        return None

    def speed_rad_s(self, at_s: float) -> float:
        """Of the joint about then."""
        near = [(t, q) for t, q, _ in self.heard if at_s - 0.05 <= t <= at_s]
        return (near[-1][1] - near[0][1]) / (near[-1][0] - near[0][0]) if len(near) > 2 else 0.0

    def rest_s(self, killed_s: float) -> float:
        """From the kill to the last motion that was reported."""
        after = [(t, q) for t, q, _ in self.heard if t > killed_s]
        last_s = killed_s
        for (t, q), (u, p) in zip(after, after[10:], strict=False):
            if abs(p - q) > STANDS_RAD_S * (u - t) + 1e-4:
                last_s = t
        return last_s - killed_s


def _listen(channel: str) -> can.BusABC:
    for _ in range(6000):
        with contextlib.suppress(can.CanError, OSError):
            return can.Bus(interface="frictid", channel=channel)
        time.sleep(0.1)
    raise SystemExit("the simulated bus never came up")


def kill(number: int, victim: str, after_s: float, folder: Path) -> Killed | None:
    """One run and its kill; None where it had ended by itself before."""
    channel, out = f"kill-{os.getpid()}-{number}", folder / f"run-{number}"
    asked = ("--robot", "hp3j", "--joint", JOINT, "--program", "quick", "--realtime", "--yes")
    program = str(Path(sys.executable).parent / "frictid-hil")
    command = [program, "calibrate", *asked, "--bus", f"virtual:{channel}", "--out", str(out)]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    seat, verdict = Seat(channel), Killed(number, victim, after_s)
    try:
        while not seat.heard and run.poll() is None:
            seat.listen(time.monotonic() + 0.2)
        seat.listen(time.monotonic() + after_s)
        (loop,) = [c for c in psutil.Process(run.pid).children() if "spawn_main" in " ".join(c.cmdline())]
        reached_s = _reached_s(out)
        for pid in {"commander": [run.pid], "loop": [loop.pid], "both": [run.pid, loop.pid]}[victim]:
            os.kill(pid, signal.SIGKILL)
    except (psutil.Error, ValueError, ProcessLookupError):
        return None
    finally:
        if sys.exc_info()[0] is not None:
            run.kill()
    killed_s = time.monotonic()
    seat.listen(killed_s + LISTENS_S)
    try:
        _judge(verdict, seat, killed_s, run, out, reached_s)
    finally:
        run.kill()
        seat.bus.shutdown()
    return verdict


def _judge(
    verdict: Killed, seat: Seat, killed_s: float, run: subprocess.Popen[str], out: Path, reached_s: float | None
) -> None:
    verdict.speed_rad_s = round(seat.speed_rad_s(killed_s), 3)
    verdict.rest_s = round(seat.rest_s(killed_s), 3)
    if verdict.rest_s > MOST_S:
        verdict.failures.append(f"at rest {verdict.rest_s:.2f} s after the kill")
    status = seat.asked(0x6041, "<H")
    if status is not None and status & 0x6F == 0x27:
        verdict.failures.append("the drive has power three seconds later")
    with contextlib.suppress(subprocess.TimeoutExpired):
        run.communicate(timeout=60)
    verdict.exit_code = run.poll() or 0
    if run.poll() is None:
        verdict.failures.append("the commander hangs")
    if verdict.victim == "loop" and verdict.exit_code != 4:
        verdict.failures.append(f"exit code {verdict.exit_code}")
    kept_s = _reached_s(out)
    if reached_s is not None and kept_s is not None:
        verdict.lost_s = round(max(0.0, reached_s - kept_s), 3)
    if reached_s is not None and (kept_s is None or kept_s < reached_s):
        verdict.failures.append(f"the recording held {reached_s:.2f} s before the kill, {kept_s} afterwards")


def _reached_s(out: Path) -> float | None:
    """Run time of the newest sample that can be read; None where there is none."""
    with contextlib.suppress(FrictidError):
        return max(float(samples.time_ns[-1]) * 1e-9 for samples in read_mcap(out / "samples.mcap"))
    return None


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kept", type=Path, help="goes on after an interruption")
    asked = parser.parse_args()
    lines = asked.kept.read_text().splitlines() if asked.kept and asked.kept.exists() else []
    verdicts = [Killed(**json.loads(line)) for line in lines]
    dice = random.Random(asked.seed)
    moments = [(number, VICTIMS[number % 3], dice.uniform(0.1, LATEST_S)) for number in range(asked.kills)]
    done = {verdict.number for verdict in verdicts}
    for number, victim, after_s in moments:
        if number in done:
            continue
        with tempfile.TemporaryDirectory() as folder:
            verdict = kill(number, victim, after_s, Path(folder))
        if verdict is None:
            print(f"{number} {victim} after {after_s:.1f} s: had ended by itself", flush=True)
            continue
        verdicts.append(verdict)
        if asked.kept:
            with asked.kept.open("a") as file:
                file.write(json.dumps(asdict(verdict)) + "\n")
        print(verdict, flush=True)
    moving = [verdict for verdict in verdicts if abs(verdict.speed_rad_s) > STANDS_RAD_S]
    print(
        f"{len(verdicts)} kills, {len(moving)} of them of a joint in motion; at rest after at most "
        f"{max((verdict.rest_s for verdict in verdicts), default=0.0):.2f} s; "
        f"{sum(bool(verdict.failures) for verdict in verdicts)} failed"
    )


if __name__ == "__main__":
    main()
