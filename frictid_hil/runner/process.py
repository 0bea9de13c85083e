"""On the wall clock the cyclic loop is a process of its own; this file is both of its ends.

The child touches the driver, the supervisor and two shared rings, nothing else. The parent writes files, shows progress
and asks people. When the parent disappears, the child brings the joint to rest and ends; when the child disappears, the
drives' own heartbeat watchdogs do.

::

    parent                         pipe                          child
    go / no  ------------------------------------------------->  Scheduler(driver, ...)
    <------------------  Preflight, PhaseStarted, JointRun, ...
    <------------------  outcome (None or a FrictidError)
    stop level (one shared byte) ------------------------------>  read once per cycle
    <=========  sample and frame rings in shared memory
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

from frictid_hil.errors import FrictidError, HardwareError, Interrupted, SafetyAbort
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import load_driver
from frictid_hil.runner.care import Care
from frictid_hil.runner.cycle import DECELERATE, QUICK_STOP
from frictid_hil.runner.events import Event, Preflight, Warned
from frictid_hil.runner.ring import frame_ring, sample_ring
from frictid_hil.runner.scheduler import Recorder, Scheduler

if TYPE_CHECKING:
    from multiprocessing.sharedctypes import Synchronized

_PR_SET_PDEATHSIG = 1
_POLL_S = 0.05
_FIFO_PRIORITY = 60


@dataclass(frozen=True, slots=True)
class _Order:
    """All that the child needs to know; crosses the process border once."""

    driver: str
    setup: RobotSetup
    plan: Plan
    care: Care
    samples: str
    frames: str
    parent_pid: int


class _SharedStop:
    """The stop level in shared memory, raised also when the parent is gone."""

    def __init__(self, level: Synchronized[int], parent_pid: int) -> None:
        self._raw = level.get_obj()
        self._parent_pid = parent_pid
        self.terminated = False

    @property
    def level(self) -> int:
        """The highest level asked for so far."""
        if self.terminated or os.getppid() != self._parent_pid:
            return max(DECELERATE, self._raw.value)
        return int(self._raw.value)


def run_in_own_process(
    driver: str,
    setup: RobotSetup,
    plan: Plan,
    recorder: Recorder,
    *,
    notify: Callable[[Event], None],
    proceed: Callable[[Preflight], bool],
    stop_level: Callable[[], int],
    drain: Callable[[], None],
    care: Care,
) -> None:
    """Run the scheduler in a child process; returns when it has ended.

    Args:
        driver: entry-point name.
        setup: the robot.
        plan: what to do.
        recorder: made of shared rings.
        notify: called in this process for each event.
        proceed: asked in this process.
        stop_level: polled; passed on to the child.
        drain: called every 50 ms to empty the rings.
        care: bounds.

    Raises:
        FrictidError: whatever ended the run in the child.
        HardwareError: the child died without a word.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    level: Synchronized[int] = context.Value("b", 0)
    order = _Order(driver, setup, plan, care, recorder.samples.name, recorder.frames.name, os.getpid())
    child = context.Process(target=_child, args=(order, theirs, level), name="frictid-hil-cycle")
    child.start()
    theirs.close()
    outcome: FrictidError | None = None
    finished = False
    try:
        while not finished:
            # ``level.get_obj()`` needs no lock: one byte, one writer.
            level.get_obj().value = max(level.get_obj().value, stop_level())
            if ours.poll(_POLL_S):
                try:
                    message = ours.recv()
                except EOFError:
                    break
                if isinstance(message, Preflight):
                    notify(message)
                    ours.send(proceed(message))
                elif isinstance(message, tuple):
                    (outcome,) = message
                    finished = True
                else:
                    drain()
                    notify(message)
            drain()
        child.join(10.0)
    finally:
        if child.is_alive():
            child.terminate()
            child.join(2.0)
        drain()
        ours.close()
    if outcome is not None:
        raise outcome
    if not finished:
        raise SafetyAbort(
            f"the cyclic process ended without a word (exit code {child.exitcode})",
            cause="it was killed, or ran out of memory",
            next_step="the drives stop by their own heartbeat watchdogs; samples up to here are kept",
        )


def _child(order: _Order, pipe: Connection, level: Synchronized[int]) -> None:
    """The cyclic process."""
    stop = _SharedStop(level, order.parent_pid)

    def terminated(_signal: int, _frame: object) -> None:
        stop.terminated = True

    # Ctrl-C reaches the whole process group; only the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, terminated)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    outcome: FrictidError | None = None
    samples, frames = sample_ring(name=order.samples), frame_ring(name=order.frames)

    def tell(event: Event) -> None:
        try:
            pipe.send(event)
        except OSError:
            stop.terminated = True

    def proceed(preflight: Preflight) -> bool:
        tell(preflight)
        while not pipe.poll(_POLL_S):
            if stop.level:
                raise Interrupted("stopped before anything moved")
        return bool(pipe.recv())

    try:
        warning = _raise_priority()
        if warning:
            tell(Warned(warning))
        driver = load_driver(order.driver)(order.setup)  # type: ignore[call-arg]  # protocols carry no constructor
        gc.collect()
        gc.freeze()
        gc.disable()
        Scheduler(
            driver,
            order.setup,
            order.plan,
            Recorder(samples, frames),
            notify=lambda event: None if isinstance(event, Preflight) else tell(event),
            proceed=proceed,
            stop=stop,
            care=order.care,
        ).run()
    except FrictidError as error:
        outcome = error
    except Exception as error:  # the parent must learn of a defect here too
        outcome = HardwareError(f"defect in the cyclic process: {error}\n{traceback.format_exc()}")
    finally:
        samples.close()
        frames.close()
    with contextlib.suppress(OSError):  # the parent may be gone; the joint is at rest by now
        pipe.send((outcome,))
    pipe.close()


def _raise_priority() -> str:
    """Real-time scheduling where permitted, before any thread exists; "" or what a person should know."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    except OSError:
        return (
            "no permission for real-time scheduling; cycles may come late. "
            "Allow it with: sudo setcap cap_sys_nice+ep $(readlink -f $(which python3)), or LimitRTPRIO=99 in systemd"
        )
    return ""


__all__ = ["QUICK_STOP", "run_in_own_process"]
