"""Makes the cyclic loop as punctual as this account may, and measures how punctual this computer is.

Real-time scheduling, locked memory and processors that stay awake are asked for before any thread exists, and garbage
collection is off while the loop runs: each alone makes the tail of the lateness many times longer. A processor of its
own the loop takes only where one was isolated for such work: bound to an ordinary one it comes later, because it can't
leave it when that stalls.
"""

from __future__ import annotations

import ctypes
import gc
import os
import struct
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from frictid_hil.friction.trajectory import Array

FIFO_PRIORITY = 60
RATES_HZ = (1000, 800, 500, 400, 250, 200, 125, 100, 50)
_MEASURED_HZ = 1000
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_HOLDS_PERCENTILE = 99.9
_ISOLATED = Path("/sys/devices/system/cpu/isolated")
WAKE_TIME = Path("/dev/cpu_dma_latency")


def make_punctual() -> list[str]:
    """Ask for real-time scheduling, locked memory, awake processors, no gc; returns what was refused, with remedies."""
    # For a process of its own: what it was given lasts until it ends.
    told = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except OSError:
        told.append(
            "no permission for real-time scheduling; cycles may come late. "
            "Allow it with: sudo setcap cap_sys_nice,cap_ipc_lock+ep $(readlink -f $(which python3)), "
            "or LimitRTPRIO=99 and LimitMEMLOCK=infinity in systemd"
        )
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0 and not told:
        told.append(
            "no permission to lock memory; a page that was swapped out makes a cycle late. "
            "Allow it with: ulimit -l unlimited, or LimitMEMLOCK=infinity in systemd"
        )
    if not _keep_processors_awake() and not told:
        told.append(
            "no permission to keep idle processors awake; cycles begin later after each sleep. "
            f"Allow it until the next boot with: sudo setfacl -m u:$USER:rw {WAKE_TIME}"
        )
    gc.collect()
    gc.freeze()
    gc.disable()
    return told


def _keep_processors_awake() -> bool:
    """Keep every processor awake for as long as this process lives; False where that was not permitted."""
    # The bound holds while the file is open. Source: Documentation/power/pm_qos_interface.rst.
    try:
        kept_open = os.open(WAKE_TIME, os.O_WRONLY)
        os.write(kept_open, struct.pack("i", 0))
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return True


def move_to_isolated_cpu() -> int | None:
    """Bind this thread, and what it starts, to a processor that is free of other work (``isolcpus=``); None without."""
    isolated = [cpu for cpu in _numbers(_ISOLATED) if _allowed(cpu)]
    if not isolated:
        return None
    cpu = isolated[os.getpid() % len(isolated)]  # loops of several runs spread over them
    os.sched_setaffinity(0, {cpu})
    return cpu


def _numbers(path: Path) -> list[int]:
    """Read the kernel's lists, like ``2-3,6``; empty where there is no such file."""
    try:
        ranges = [part.split("-") for part in path.read_text().split(",") if part.strip()]
    except OSError:
        return []
    return [number for one in ranges for number in range(int(one[0]), int(one[-1]) + 1)]


def _allowed(cpu: int) -> bool:
    """The control group lets this process onto that processor, whether or not it has been on it so far."""
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError:
        return False
    os.sched_setaffinity(0, before)
    return True


@dataclass(frozen=True, slots=True)
class Latency:
    """How late an empty loop is on this computer: percentiles, and the latest, of the cycles of ``duration_s``."""

    duration_s: float
    p50_s: float
    p99_s: float
    p999_s: float
    worst_s: float
    highest_hz: int  # the highest usual rate at which 99.9 % of the cycles begin within half a period; 0 for none
    told: tuple[str, ...]  # what was not permitted, and the remedy
    isolated_cpu: int | None  # processor that the loop had to itself; None where none is isolated


def judged(late_s: Array, duration_s: float, told: list[str], isolated_cpu: int | None = None) -> Latency:
    """Form the figures of a measurement."""
    p50, p99, p999 = (float(value) for value in np.percentile(late_s, (50, 99, _HOLDS_PERCENTILE)))
    held = [rate for rate in RATES_HZ if p999 <= 0.5 / rate]
    return Latency(duration_s, p50, p99, p999, float(late_s.max()), max(held, default=0), tuple(told), isolated_cpu)


def measure_latency(duration_s: float) -> Latency:
    """Wait for a deadline every millisecond, as the loop does, for 0.1 s or longer, and see how late it returns."""
    told, cpu = make_punctual(), move_to_isolated_cpu()
    period_ns = round(1e9 / _MEASURED_HZ)
    late_ns = np.zeros(max(100, round(duration_s * _MEASURED_HZ)), np.int64)
    deadline_ns = time.monotonic_ns() + period_ns
    for at in range(late_ns.size):
        remaining_s = (deadline_ns - time.monotonic_ns()) * 1e-9
        if remaining_s > 0:
            time.sleep(remaining_s)
        late = late_ns[at] = time.monotonic_ns() - deadline_ns
        # A stall is one late cycle, not a burst of them.
        deadline_ns += period_ns * (1 + int(late) // period_ns)
    return judged(late_ns * 1e-9, duration_s, told, cpu)
