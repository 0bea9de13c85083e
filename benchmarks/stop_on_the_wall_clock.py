"""From SIGINT to standstill on the wall clock, at moments that are drawn: three processes, and an ear on the bus.

    python benchmarks/stop_on_the_wall_clock.py [--runs 20] [--seed 1] [--docs PAGE]

Every run is `frictid-hil calibrate --realtime` of one simulated joint, with its first motions (units, move, rehearsal)
and fast cycles. At a drawn moment after the drive was first heard it gets SIGINT. The joint's own reports on the bus,
not the host's recording, tell when it stood and where it was. This process hears them late on a busy computer, so the
figures are upper bounds.
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
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np

from frictid_hil.config.provenance import git_revision
from frictid_hil.units import degrees

JOINT, NODE = "5", 6
COUNTS_PER_RAD = 131072 * 81.5 / (2 * math.pi)
ASKED = ("calibrate", "--robot", "hp3j", "--joint", JOINT, "--cycles", "3")
LATEST_S = 20.0
"""The moment is drawn from so many seconds after the drive's first report: the whole of the run's motion."""
STANDS_RAD_S, WINDOW_S = math.radians(0.5), 0.02
"""A joint that goes less than this in every window of so long stands."""
UNITS_RAD = math.radians(0.5)
"""The proof of units goes so far to either side of where the joint stands."""
BEGIN, END = "<!-- written by benchmarks/stop_on_the_wall_clock.py -->", "<!-- end of what it wrote -->"


@dataclass(frozen=True, slots=True)
class Stopped:
    """What one run showed.

    Attributes:
        speed_rad_s: of the joint when it was asked to stop.
        stop_s: from the signal to standstill; 0 where it stood.
        beyond_rad: how far it ever was outside the planned travel.
        exit_code: of the command.
    """

    speed_rad_s: float
    stop_s: float
    beyond_rad: float
    exit_code: int


def judged(
    times_s: list[float], positions_rad: list[float], asked_s: float, travel_rad: tuple[float, float], exit_code: int
) -> Stopped:
    """Standstill and travel from the reports of one run, as they were heard."""
    times, positions = np.asarray(times_s), np.asarray(positions_rad)
    earlier = np.interp(times - WINDOW_S, times, positions)
    speed = np.abs(positions - earlier) / WINDOW_S
    moving = times[(speed > STANDS_RAD_S) & (times > asked_s)]
    beyond = max(travel_rad[0] - positions.min(), positions.max() - travel_rad[1], 0.0)
    stop_s = float(moving[-1]) - WINDOW_S - asked_s if moving.size else 0.0
    return Stopped(float(np.interp(asked_s, times, speed)), max(0.0, stop_s), float(beyond), exit_code)


def planned_travel() -> tuple[float, float]:
    """Of the joint, with the way there and the proof of units."""
    told = subprocess.run([_program(), *ASKED, "--dry-run", "--json"], capture_output=True, text=True, check=True)
    (joint,) = json.loads(told.stdout)["plan"]["joints"]
    here_rad = joint["motions"][0]["from_rad"]
    low, high = joint["travel_rad"]
    return min(low, here_rad - UNITS_RAD), max(high, here_rad + UNITS_RAD)


def one_run(place: Path, wait_s: float, travel_rad: tuple[float, float]) -> Stopped | None:
    """Start, listen, interrupt after ``wait_s``, listen until the bus is gone; None where the run ended before that."""
    channel = f"stop-{os.getpid()}-{place.name}"
    command = [_program(), *ASKED, "--realtime", "--yes", "--bus", f"virtual:{channel}", "--out", str(place)]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    bus = _listen(channel)
    times_s: list[float] = []
    positions_rad: list[float] = []
    asked_s = math.inf
    try:
        with contextlib.suppress(can.CanError):  # the simulated bus ends with the run
            while run.poll() is None:
                message = bus.recv(0.05)
                now_s = time.monotonic()
                if message is not None and message.arbitration_id == 0x180 + NODE and len(message.data) >= 6:
                    times_s.append(now_s)
                    positions_rad.append(struct.unpack_from("<i", message.data, 2)[0] / COUNTS_PER_RAD)
                if times_s and asked_s == math.inf and now_s - times_s[0] >= wait_s:
                    asked_s = time.monotonic()
                    run.send_signal(signal.SIGINT)
        exit_code = run.wait(60)
    finally:
        run.kill()
        bus.shutdown()
    if asked_s == math.inf:
        return None
    return judged(times_s, positions_rad, asked_s, travel_rad, exit_code)


def _program() -> str:
    return str(Path(sys.executable).parent / "frictid-hil")


def _listen(channel: str) -> can.BusABC:
    for _ in range(600):
        with contextlib.suppress(can.CanError, OSError):
            return can.Bus(interface="frictid", channel=channel)
        time.sleep(0.1)
    raise SystemExit("the simulated bus never came up")


def told(runs: list[Stopped], command: str) -> str:
    """The figures in words."""
    moving = [run for run in runs if run.speed_rad_s > STANDS_RAD_S]
    times_ms = [1e3 * run.stop_s for run in moving]
    fastest = max(degrees(run.speed_rad_s) for run in runs)
    beyond = max(degrees(run.beyond_rad) for run in runs)
    return (
        f"`{command}`, commit {git_revision()[:8]}: SIGINT came in {len(runs)} runs, and found the joint in motion in "
        f"{len(moving)} of them, at up to {fastest:.0f} deg/s.\n"
        f"From SIGINT to standstill: median {np.median(times_ms):.0f} ms, longest {max(times_ms):.0f} ms. Outside the "
        f"planned travel by at most {beyond:.2f} deg.\n"
        f"Exit code 130 in {sum(run.exit_code == 130 for run in runs)} of {len(runs)}.\n"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--docs", type=Path, help="page whose marked part is written anew")
    asked = parser.parse_args()
    # A shell lets what it starts in the background ignore SIGINT; the runs shall hear it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    dice, travel_rad = random.Random(asked.seed), planned_travel()
    runs: list[Stopped] = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(asked.runs):
            wait_s = dice.uniform(0.1, LATEST_S)
            stopped = one_run(Path(folder) / str(number), wait_s, travel_rad)
            print(f"after {wait_s:5.2f} s: {stopped or 'had ended by itself'}", file=sys.stderr, flush=True)
            runs += [stopped] if stopped else []
    text = told(runs, f"python benchmarks/stop_on_the_wall_clock.py --runs {asked.runs} --seed {asked.seed}")
    print(text)
    if asked.docs:
        before, rest = asked.docs.read_text().split(BEGIN)
        asked.docs.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
