"""One process that calibrates, compensates, recalibrates and replays, again and again: what does it keep?

    python benchmarks/soak.py [--minutes 120] [--wall-clock-every 5]

One joint of the shipped robot, other noise in every round. After every round: memory of this process, open files,
threads, children, held locks, segments of shared memory. What the run folders hold is deleted, as a person would. Every
so many rounds the calibration is on the wall clock, with processes and shared memory of its own. The first rounds load
libraries and fill caches: what is held is compared from the second round of either kind on. The median memory of the
last tenth of the rounds is to be within 1 % of that of the first tenth after it; everything else is to be the same.

Memory is counted after the C library has given back to the system what it keeps of freed memory for later
(``malloc_trim``), which depends on the order of allocations; what it was before that is told, too. Python's own
allocator gives back whole megabytes only, which one small object can hold: with ``PYTHONMALLOC=malloc`` in the
environment it is not used, and *in use* counts every object to the byte.

Two of Python's own caches are bounded, but fill for hours. Its table of interned names is doubled once, by 1.9 MB,
when enough short-lived names went through it; it is made to do so before the first round. Its cache of attributes keeps
up to 4,096 names, each of which may hold a page of freed memory; it is cleared after every round.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import os
import platform
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from frictid_hil.config.provenance import git_revision
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import FrictidError
from frictid_hil.friction.trajectory import Array
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.recalibrate import RecalibrateOptions, recalibrate
from frictid_hil.jobs.replay import ReplayOptions, replay
from frictid_hil.jobs.watch import Silent

JOINT = "5"
WITHIN = 0.01
SHORT_LIVED_NAMES = 200_000
MOST_ROUNDS = 20_000


@dataclass(frozen=True, slots=True)
class Held:
    """What this process holds at a moment.

    Attributes:
        files: open file descriptors.
        threads: of the system's counting.
        children: processes.
        locks: on files, of this process.
        shared: segments of shared memory that nobody has any more.
    """

    files: int
    threads: int
    children: int
    locks: int
    shared: int


def held() -> Held:
    """At this moment."""
    me = psutil.Process()
    locks = Path("/proc/locks").read_text().split("\n")
    return Held(
        files=me.num_fds(),
        threads=max(me.num_threads(), threading.active_count()),
        children=len(me.children(recursive=True)),
        locks=sum(line.split()[4:5] == [str(os.getpid())] for line in locks),
        shared=len(abandoned()),
    )


def abandoned() -> set[str]:
    """Segments of shared memory that no process has: a crash or a leak left them."""
    there = {path.name for path in Path("/dev/shm").glob("psm_*")}
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with contextlib.suppress(OSError):  # ended meanwhile, or another user's
            there -= {line.rpartition("/")[2] for line in maps.read_text().splitlines() if "/dev/shm/" in line}
    return there


class _Malloc(ctypes.Structure):
    """As ``mallinfo2`` of the C library returns it."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks")),
        *((name, ctypes.c_size_t) for name in ("hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")),
    ]


_C = ctypes.CDLL(None)
_C.mallinfo2.restype = _Malloc


def give_back_freed() -> None:
    """Python drops what it keeps for speed; the C library returns to the system what nobody uses."""
    gc.collect()
    sys._clear_type_cache()
    _C.malloc_trim(0)


def fill_the_table_of_names() -> None:
    """Names that nobody keeps, until Python's table of them has its lasting size."""
    for number in range(SHORT_LIVED_NAMES):
        sys.intern(f"a name that nobody keeps, {number}")


def own_memory_mb() -> float:
    """Without the pages of libraries' files, which the system takes away and brings back as it likes."""
    status = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith("RssAnon:")) * 1.024e-3


def in_use_mb() -> float:
    """What the C library has handed out and not got back."""
    told = _C.mallinfo2()
    return float(told.uordblks + told.hblkhd) * 1e-6


def robot_file(place: Path) -> str:
    """One joint, a short procedure."""
    values = load_robot("hp3j").values()
    values |= {"name": "soak", "bus": f"virtual:soak-{os.getpid()}"}
    values["procedure"] = {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3, "ratio": 0.8}
    values["policy"] = {"warm_up": {"fixed_s": 0.0}}
    values["joints"] = {JOINT: values["joints"][JOINT] | {"locked_position_rad": 0.0, "start_position_rad": 0.0}}
    path = place / "soak.yaml"
    path.write_text(dump(values))
    return str(path)


def one_round(robot: str, place: Path, number: int, *, wall_clock: bool = False) -> list[str]:
    """Each of the four once, or the first alone where it is stopped; returns their outcomes."""
    runs, store = place / "runs", place / "store"
    shutil.rmtree(runs, ignore_errors=True)
    runs.mkdir()
    measured = runs / "calibrated"
    options = CalibrateOptions(robot, out=measured, seed=number, realtime=wall_clock, store=store)
    try:
        done: list[dict[str, Any]] = [calibrate(options, Silent()).to_json()]
    except FrictidError as error:  # a busy computer may starve a run until it is stopped
        return [type(error).__name__]
    if not wall_clock:
        wanted = Wanted("hand", ("nc", "mop"), duration_s=2.0)
        profile = measured / "profile.yaml"
        told = CompensateOptions(robot, profile, JOINT, wanted, seed=number, out=runs / "hand", store=store)
        done.append(compensate(told, Silent()).to_json())
        done.append(recalibrate(RecalibrateOptions(robot, store=store, seed=number, out=runs / "night"), Silent()))
        done.append(replay(ReplayOptions(measured, robot)))
    return [str(one["outcome"]) for one in done]


@dataclass(frozen=True, slots=True)
class Soaked:
    """What the rounds showed.

    Attributes:
        memory_mb: after every round.
        with_freed_mb: the same, before freed memory was given back.
        in_use_mb: handed out by the C library.
        steady_from: first round after the second of either kind.
        before: held then.
        after: held at the end.
        outcomes: how often each.
        lasted_s: all rounds.
    """

    memory_mb: Array
    with_freed_mb: Array
    in_use_mb: Array
    steady_from: int
    before: Held
    after: Held
    outcomes: dict[str, int]
    lasted_s: float

    @property
    def growth(self) -> float:
        """Of memory, from the first tenth of the steady rounds to the last, as a share."""
        return _growth(self.memory_mb[self.steady_from :])

    @property
    def growth_with_freed(self) -> float:
        """The same, freed memory included."""
        return _growth(self.with_freed_mb[self.steady_from :])

    @property
    def growth_in_use(self) -> float:
        """The same of what is handed out."""
        return _growth(self.in_use_mb[self.steady_from :])


def _growth(memory_mb: Array) -> float:
    tenth = max(1, memory_mb.size // 10)
    return float(np.median(memory_mb[-tenth:]) / np.median(memory_mb[:tenth])) - 1.0


def soak(lasts_s: float, *, wall_clock_every: int = 5, tell: Callable[[str], None] = print) -> Soaked:
    """Rounds for so long, and at least one after the second of either kind."""
    began, outcomes, before = time.monotonic(), dict[str, int](), held()
    # All at once: a number kept on the heap after every round would hold a page of it.
    figures_mb, rounds, steady_from = np.full((MOST_ROUNDS, 3), np.nan), 0, wall_clock_every + 2
    fill_the_table_of_names()
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        robot = robot_file(place)
        while rounds < MOST_ROUNDS and (rounds <= steady_from or time.monotonic() - began < lasts_s):
            wall_clock = wall_clock_every > 0 and rounds % wall_clock_every == 1
            for outcome in one_round(robot, place, rounds, wall_clock=wall_clock):
                outcomes[outcome] = outcomes.get(outcome, 0) + 1
            with_freed_mb = own_memory_mb()
            give_back_freed()
            figures_mb[rounds] = own_memory_mb(), with_freed_mb, in_use_mb()
            if rounds == steady_from - 1:
                before = held()
            minutes, clock = (time.monotonic() - began) / 60, " on the wall clock" if wall_clock else ""
            now_mb = figures_mb[rounds]
            figures = f"{now_mb[0]:.2f} MB ({now_mb[1]:.1f} with what was freed), {now_mb[2]:.2f} in use"
            tell(f"{minutes:.1f} min, round {rounds}{clock}: {figures}, {astuple(held())}, {outcomes}")
            rounds += 1
    mb, with_freed, used = figures_mb[:rounds].T
    return Soaked(mb, with_freed, used, steady_from, before, held(), outcomes, time.monotonic() - began)


def main() -> int:
    """Print what it showed; 1 where something was kept."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--minutes", type=float, default=120.0)
    asked.add_argument("--wall-clock-every", type=int, default=5, help="rounds; 0 for never")
    options = asked.parse_args()
    found = soak(
        60.0 * options.minutes,
        wall_clock_every=options.wall_clock_every,
        tell=lambda line: print(line, file=sys.stderr, flush=True),
    )
    print(
        f"commit {git_revision()[:8]}, Python {platform.python_version()}: {len(found.memory_mb)} rounds in "
        f"{found.lasted_s / 60:.0f} min, outcomes {found.outcomes}"
    )
    steady_mb = found.memory_mb[found.steady_from :]
    print(
        f"memory {found.memory_mb[0]:.1f} MB after the first round, {min(steady_mb):.1f} to {max(steady_mb):.1f} MB "
        f"from round {found.steady_from} on; {100 * found.growth:+.2f} % from the first tenth of those to the last, "
        f"{100 * found.growth_with_freed:+.2f} % with what was freed"
    )
    used_mb = found.in_use_mb[found.steady_from :]
    print(f"in use {min(used_mb):.2f} to {max(used_mb):.2f} MB; {100 * found.growth_in_use:+.2f} % from early to late")
    print(f"held after {found.steady_from} rounds: {found.before}")
    print(f"held at the end:     {found.after}")
    return int(abs(found.growth) > WITHIN or found.after != found.before)


if __name__ == "__main__":
    sys.exit(main())
