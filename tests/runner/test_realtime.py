"""How punctual this computer is: figures from lateness, and the rate that follows from them."""

import gc
import multiprocessing
import os
import subprocess
import sys

import numpy as np
import pytest

from frictid_hil.runner.realtime import Latency, judged, measure_latency


@pytest.mark.parametrize(
    ("late_ms", "highest_hz"),
    [([0.05] * 2000, 1000), ([0.05] * 1990 + [0.9] * 10, 500), ([0.05] * 1990 + [6.0] * 10, 50), ([4.9] * 2000, 100)],
)
def test_the_rate_is_one_at_which_nearly_all_cycles_begin_within_half_a_period(late_ms, highest_hz):
    found = judged(np.array(late_ms) * 1e-3, 2.0, [])
    assert found.highest_hz == highest_hz
    assert found.worst_s == pytest.approx(max(late_ms) * 1e-3)


def test_a_single_stall_is_reported_and_does_not_decide():
    found = judged(np.array([5e-5] * 5000 + [0.04]), 5.0, [])
    assert found.highest_hz == 1000 and found.worst_s == pytest.approx(0.04)


def test_measured_in_a_process_of_its_own_it_leaves_this_one_alone():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply(measure_latency, (0.2,))
    assert isinstance(found, Latency) and 0.0 <= found.p50_s <= found.p99_s <= found.p999_s <= found.worst_s
    assert gc.isenabled()


MOVED = """
import os, sys
from pathlib import Path
from frictid_hil.runner import realtime

realtime._ISOLATED = Path(sys.argv[1])
os.sched_setaffinity(0, {int(sys.argv[2])})
print(realtime.move_to_isolated_cpu(), *os.sched_getaffinity(0))
"""


@pytest.mark.parametrize(
    ("kernel_says", "taken"),
    [("{last}\n", True), ("{last}-{last},4000\n", True), ("\n", False), ("4000\n", False), (None, False)],
)
def test_the_loop_takes_an_isolated_processor_and_no_other(tmp_path, kernel_says, taken):
    first, *_, last = sorted(os.sched_getaffinity(0)) * 2
    if kernel_says is not None:
        (tmp_path / "isolated").write_text(kernel_says.format(last=last))
    command = [sys.executable, "-c", MOVED, tmp_path / "isolated", str(first)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    assert said.split() == ([str(last), str(last)] if taken else ["None", str(first)])


PUNCTUAL = """
import os, sys
from pathlib import Path
from frictid_hil.runner import realtime

realtime.WAKE_TIME = Path(sys.argv[1])
told = realtime.make_punctual()
held = any(os.path.realpath(f"/proc/self/fd/{number}") == sys.argv[1] for number in os.listdir("/proc/self/fd"))
print(held, any("awake" in line for line in told), bool(told))
"""


def punctual(wake_time) -> list[str]:
    command = [sys.executable, "-c", PUNCTUAL, str(wake_time)]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.split()


def test_idle_processors_are_kept_awake_while_the_process_lives(tmp_path):
    wake_time = tmp_path / "cpu_dma_latency"
    wake_time.write_bytes(b"")
    held, complained, _ = punctual(wake_time)
    assert (held, complained) == ("True", "False")
    assert wake_time.read_bytes() == bytes(4)


def test_a_computer_without_a_bound_of_wake_times_is_not_complained_about(tmp_path):
    assert punctual(tmp_path / "nothing")[:2] == ["False", "False"]


def test_processors_that_may_sleep_are_told_with_the_remedy(tmp_path):
    # A folder cannot be opened for writing by anybody, root included.
    held, complained, anything = punctual(tmp_path)
    assert held == "False" and anything == "True"
    # Where real-time scheduling is not permitted either, that is told first and alone.
    assert complained == "True" or os.geteuid() != 0
