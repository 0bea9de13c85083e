"""Runs a plan on the clock of its driver, and gives every row to a keeper.

A lock-step driver runs in this process, and the rings are drained between its cycles. A wall-clock driver runs in a
process of its own (``runner.process``). The caller sees no difference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Driver, new_driver
from frictid_hil.runner.care import Care
from frictid_hil.runner.events import Event, Preflight
from frictid_hil.runner.process import run_in_own_process
from frictid_hil.runner.ring import Rows, frame_ring, sample_ring
from frictid_hil.runner.scheduler import Recorder, Scheduler
from frictid_hil.runner.stop_signals import StopSignals


class Keeper(Protocol):
    """Keeps what was measured."""

    def samples(self, rows: Rows) -> None:
        """Rows of ``ring.SAMPLE_ROW``, in order."""

    def frames(self, rows: Rows) -> None:
        """Rows of ``ring.FRAME_ROW``, in order."""


def run_plan(
    driver_name: str,  # entry-point name of the driver
    setup: RobotSetup,  # the robot as the driver knows it
    plan: Plan,  # what moves
    keeper: Keeper,  # given every row, also after an error
    *,
    notify: Callable[[Event], None],  # told what happens
    proceed: Callable[[Preflight], bool],  # asked once, after the preflight and before anything moves
    care: Care | None = None,  # bounds
    # Called with the driver before it is opened, for what only a simulated robot can do (hands, payloads); on the wall
    # clock with a twin of the driver, since the one that runs is in another process.
    prepare: Callable[[Driver], None] | None = None,
) -> int:
    """Run a plan, checked against limits, to its end; returns how many rows were lost by writing too slowly (or 0).

    Raises as ``Scheduler.run``; what was measured has been given to the keeper by then.
    """
    care = care or Care()
    driver = new_driver(driver_name, setup)
    own_process = not driver.clock.lock_step
    with sample_ring(shared=own_process) as samples, frame_ring(shared=own_process) as frames:
        recorder = Recorder(samples, frames)

        def drain() -> None:
            for ring, keep in ((samples, keeper.samples), (frames, keeper.frames)):
                rows = ring.drain()
                if rows.size:
                    keep(rows)

        def after_draining(event: Event) -> None:
            drain()
            notify(event)

        if prepare is not None:
            prepare(driver)
        with StopSignals() as stop:
            try:
                if own_process:
                    run_in_own_process(
                        driver_name,
                        setup,
                        plan,
                        recorder,
                        notify=after_draining,
                        proceed=proceed,
                        stop=stop,
                        drain=drain,
                        care=care,
                    )
                else:
                    Scheduler(
                        driver,
                        setup,
                        plan,
                        recorder,
                        notify=after_draining,
                        proceed=lambda preflight: stop.while_asking(lambda: proceed(preflight)),
                        stop=stop,
                        pump=drain,
                        care=care,
                    ).run()
            finally:
                drain()
        return samples.dropped + frames.dropped
