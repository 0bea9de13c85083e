"""On the wall clock the cyclic loop is a process of its own; this file is both of its ends.

The child touches the driver, the supervisor and two shared rings, nothing else. The parent writes files, shows progress
and asks people. When the parent disappears, the child brings the joint to rest and ends; when the child disappears or
hangs, the drives' own heartbeat watchdogs do, and the parent says what may still have power.

::

    parent                         pipe                          child
    go / no  ------------------------------------------------->  Scheduler(driver, ...)
    <------------------  Preflight, PhaseStarted, JointRun, ...
    <------------------  outcome (None or a FrictidError)
    signals, as their handler gets them ------- pipe ---------->  read once per cycle
    <=========  sample and frame rings in shared memory
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from frictid_hil.errors import Defect, FrictidError, Interrupted, SafetyAbort
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import new_driver
from frictid_hil.runner.care import Care
from frictid_hil.runner.events import Event, JointRun, PhaseStarted, Preflight, Warned
from frictid_hil.runner.realtime import make_punctual, move_to_isolated_cpu
from frictid_hil.runner.ring import frame_ring, sample_ring
from frictid_hil.runner.scheduler import Recorder, Scheduler
from frictid_hil.runner.stop_signals import HeardStop, StopSignals

_PR_SET_PDEATHSIG = 1
_POLL_S = 0.05
_SILENT_S = 30.0  # configuring drives may take its time; what lasts longer without a word hangs ...
_SILENT_STOPPING_S = 5.0  # ... and so does what is silent for so long after a stop was asked for.
_ENDING_S = 15.0  # longest way from a stop to the end of the process
_WITHOUT_POWER = ("configure", "reference")  # phases of a joint in which no drive has power


class _Life:
    """How long the child has been silent. Only time in which this process could have heard the child counts."""

    def __init__(self) -> None:
        self._seen_rows = 0
        self._looked_s = time.monotonic()
        self._silent_s = 0.0
        self._asked_s = 0.0

    def look(self, rows: int, *, heard: bool, stop_asked: bool) -> bool:
        """False once the child has been silent for too long."""
        passed_s = min(2 * _POLL_S, time.monotonic() - self._looked_s)
        self._looked_s = time.monotonic()
        self._silent_s = 0.0 if heard or rows != self._seen_rows else self._silent_s + passed_s
        self._asked_s += passed_s * stop_asked
        self._seen_rows = rows
        return self._silent_s < (_SILENT_STOPPING_S if stop_asked else _SILENT_S) and self._asked_s < _ENDING_S


@dataclass(slots=True)
class _Listener:
    """This end of the pipe."""

    pipe: Connection
    notify: Callable[[Event], None]
    proceed: Callable[[Preflight], bool]
    stop: StopSignals
    drain: Callable[[], None]
    outcome: FrictidError | None = None  # error that ended the run in the child
    finished: bool = False  # the child has said how it ended
    powered: bool = False  # drives may have power

    def hear(self) -> bool:
        """Deal with one message; False where the child has closed its end."""
        try:
            message = self.pipe.recv()
        except EOFError:
            return False
        if isinstance(message, tuple):
            (self.outcome,) = message
            self.finished = True
        elif isinstance(message, Preflight):
            self.notify(message)
            self.pipe.send(self.stop.while_asking(lambda: self.proceed(message)))
        else:
            if isinstance(message, PhaseStarted | JointRun):
                self.powered = isinstance(message, PhaseStarted) and message.phase not in _WITHOUT_POWER
            self.drain()
            self.notify(message)
        return True


def run_in_own_process(
    driver: str,
    setup: RobotSetup,
    plan: Plan,
    recorder: Recorder,  # made of shared rings
    *,
    notify: Callable[[Event], None],  # called in this process for each event
    proceed: Callable[[Preflight], bool],  # asked in this process
    stop: StopSignals,  # passed on to the child
    drain: Callable[[], None],  # called every 50 ms to empty the rings
    care: Care,
) -> None:
    """Run the scheduler in a child process to its end; raises what ended it, ``SafetyAbort`` if it died or hung."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    heard, wire = context.Pipe(duplex=False)
    rings = recorder.samples.name, recorder.frames.name
    order = (driver, setup, plan, care, rings, os.getpid(), theirs, heard)
    child = context.Process(target=_child, args=order, name="frictid-hil-cycle")
    listener = _Listener(ours, notify, proceed, stop, drain)
    life, hangs = _Life(), False
    with stop.written_to(wire.fileno()):
        child.start()
        theirs.close()
        heard.close()
        try:
            while not listener.finished:
                told = ours.poll(_POLL_S)
                if told and not listener.hear():
                    break
                drain()
                if not life.look(recorder.samples.drained, heard=told, stop_asked=stop.level > 0):
                    hangs = True
                    break
            child.join(_ENDING_S if listener.finished else 0.0)
        finally:
            _end(child, hangs=hangs)
            drain()
            ours.close()
            wire.close()
    if listener.outcome is not None:
        raise listener.outcome
    if not listener.finished:
        raise _lost(child.exitcode, setup, hangs=hangs, powered=listener.powered)


def _end(child: SpawnProcess, *, hangs: bool) -> None:
    """End the child process, whatever it does."""
    if child.is_alive() and not hangs:
        child.terminate()
        child.join(_ENDING_S)
    if child.is_alive():
        child.kill()
        child.join()


def _lost(exit_code: int | None, setup: RobotSetup, *, hangs: bool, powered: bool) -> SafetyAbort:
    what = "hung, and was ended" if hangs else f"ended without a word (exit code {exit_code})"
    names = ", ".join(joint.name for joint in setup.joints)
    return SafetyAbort(
        f"the cyclic process {what}",
        cause="it was suspended, or a driver's library never returned"
        if hangs
        else "it was killed, or ran out of memory",
        next_step=f"joints {names} may still have power: press the emergency stop, then look at them; where the drives "
        "watch over their host they have stopped by themselves. Samples up to here are kept"
        if powered
        else "nothing had power by then; samples up to here are kept",
    )


def _unattended() -> SafetyAbort:
    return SafetyAbort(
        "the command took no samples for so long that they would soon be lost; the joint was brought to rest",
        cause="it was suspended (Ctrl-Z, SIGSTOP), or its disk does not answer",
        next_step="let it go on (`fg`), or look at the disk; samples up to here are kept",
    )


def _child(
    driver: str,
    setup: RobotSetup,
    plan: Plan,
    care: Care,
    rings: tuple[str, str],
    parent_pid: int,
    pipe: Connection,
    heard: Connection,
) -> None:
    """The cyclic process."""
    samples, frames = sample_ring(name=rings[0]), frame_ring(name=rings[1])
    stop = HeardStop(heard.fileno(), parent_pid, lambda: samples.half_full or frames.half_full)

    def terminated(_signal: int, _frame: object) -> None:
        stop.terminated = True

    # Ctrl-C and a closed terminal reach the whole process group; only the parent decides what they mean.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, terminated)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    outcome: FrictidError | None = None

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
        move_to_isolated_cpu()  # now that all threads and simulated drives are there, and stay on the others
        return bool(pipe.recv())

    try:
        for warning in make_punctual():
            tell(Warned(warning))
        hardware = new_driver(driver, setup)
        gc.freeze()
        Scheduler(
            hardware,
            setup,
            plan,
            Recorder(samples, frames),
            notify=lambda event: None if isinstance(event, Preflight) else tell(event),
            proceed=proceed,
            stop=stop,
            care=care,
        ).run()
    except Interrupted as error:
        outcome = _unattended() if stop.left_alone else error
    except FrictidError as error:
        outcome = error
    except Exception as error:  # the parent must learn of a defect here too
        traceback.print_exc()
        outcome = Defect.of(error)
    finally:
        samples.close()
        frames.close()
    with contextlib.suppress(OSError):  # the parent may be gone; the joint is at rest by now
        pipe.send((outcome,))
    pipe.close()
