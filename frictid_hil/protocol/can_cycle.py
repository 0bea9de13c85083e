"""The cycle of devices that answer each command with a report: commands out, reports in, stops and the way to rest."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable, Sequence

from frictid_hil.errors import FrictidError, SafetyAbort
from frictid_hil.protocol.can_bus import another_master
from frictid_hil.protocol.can_line import CanLine
from frictid_hil.protocol.driver import EXTENDED, FD_FRAME, Clock, Feedback, JointState, SetPoint
from frictid_hil.protocol.rows import Command, RowDecoder
from frictid_hil.protocol.wishes import Do, Order, Wish

SETTLE_S = 1.5
"""How long all joints may take to come to rest and off."""
_LAST_WORDS = 2


class CanCycle:
    """Cyclic traffic of all joints."""

    def __init__(
        self,
        line: CanLine,  # nobody else reads it meanwhile
        clock: Clock,  # run time
        rows: RowDecoder,  # given every frame, sent and received
        wishes: Sequence[Wish],  # one per joint, with the feedback that ``rows`` fills
        frame: Callable[[int, Order], tuple[int, bytes]],  # of a joint (index) for an order
        cycle_hz: float,  # rate
        window: float = 0.8,  # share of a cycle that reports are waited for
    ) -> None:
        self._line, self._clock, self._rows, self._frame = line, clock, rows, frame
        self.wishes = list(wishes)
        self._period_ns = round(1e9 / cycle_hz)
        self._window_ns = round(window * self._period_ns)
        self._told: deque[tuple[int, bytes]] = deque(maxlen=2 * len(self.wishes))  # frames sent last
        self._stranger: tuple[int, int] | None = None  # (joint, identifier) of a command that we did not send
        self._stopping = False  # told to stop, because of a stranger or by ``stop``
        self.may_be_powered: tuple[str, ...] = ()  # joints that were not seen to be off when ``stop`` ended

    def wish(self, joint: str) -> Wish:
        """Of the joint with that name."""
        return next(wish for wish in self.wishes if wish.joint.name == joint)

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """All commands, then the reports as they come.

        Raises:
            SafetyAbort: a set-point is not a number, or somebody else commands a joint; every joint was told to stop.
                The latter is raised once; later exchanges go on, so that the stop can be watched.
            HardwareError: frames cannot be sent.
        """
        line, rows = self._line, self._rows
        for heard in line.received():
            self._hear(*heard)
        self._check_stranger()
        deadline_ns = self._clock.now_ns() + self._window_ns
        refused: SafetyAbort | None = None
        frames = []
        for at, (wish, set_point) in enumerate(zip(self.wishes, set_points, strict=True)):
            try:
                order = wish.order(set_point)
            except SafetyAbort as abort:
                refused, order = abort, Order(Do.BRAKE)
            frames.append(self._frame(at, order))
        # Only now: the first command makes all reports a cycle older, and orders go by fresh ones.
        for frame in frames:
            rows.feed(self._send(*frame), *frame)
        if refused is not None:
            self.quick_stop()
            raise refused
        if rows.waiting():
            for heard in line.received(deadline_ns):
                self._hear(*heard)
                if not rows.waiting():
                    break
        self._check_stranger()
        return rows.feedback

    def quick_stop(self) -> None:
        """Brake every joint under power, the others off; never raises."""
        for at, wish in enumerate(self.wishes):
            with contextlib.suppress(Exception):
                wish.stop()
                on = wish.feedback.state is JointState.ENABLED
                self._send(*self._frame(at, Order(Do.BRAKE if on else Do.REST)))

    def stop(self) -> None:
        """Cycle until every joint is at rest and off; in the end all are told twice, for a frame may be lost.

        What they say to that counts: somebody else may have switched one on again.

        Raises:
            SafetyAbort: a joint still reports power, or does not report; or somebody else began to command one.
        """
        alarmed, self._stopping = self._stopping, True
        for wish in self.wishes:
            wish.disable()
        set_points = [SetPoint() for _ in self.wishes]
        powered: list[str] = []
        try:
            for _ in range(max(2, math.ceil(SETTLE_S * 1e9 / self._period_ns))):
                self._clock.wait_until(self._clock.now_ns() + self._period_ns)
                reports = zip(self.wishes, self.exchange(set_points), strict=True)
                powered = [w.joint.name for w, r in reports if r.age_cycles or r.state is JointState.ENABLED]
                if not powered:
                    break
        finally:
            for _ in range(_LAST_WORDS):
                self._all_off()
            self.may_be_powered = tuple(
                wish.joint.name for wish in self.wishes if wish.feedback.state is JointState.ENABLED
            )
        powered = powered or list(self.may_be_powered)
        if powered:
            raise SafetyAbort(
                f"did not come to rest and off within {SETTLE_S:g} s",
                where=", ".join(f"joint {name}" for name in powered),
                next_step="switch its supply off, then look at the drive",
            )
        if self._stranger is not None and not alarmed:
            raise self._another_master(*self._stranger)

    def _send(self, can_id: int, data: bytes) -> int:
        self._told.append((can_id, data))
        return self._line.send(can_id, data)

    def _hear(self, t_ns: int, can_id: int, data: bytes) -> None:
        """A frame from outside. A command among them is an echo of our own, as some adapters give it, or a stranger's.

        A joint that a stranger goes on commanding is not braked by us: it loses its power.
        """
        seen = self._rows.decode(can_id, data)
        if not isinstance(seen, Command):
            self._rows.take(t_ns, seen)
        elif (can_id, data) not in self._told:
            if self._stopping:
                self.wishes[seen.joint].let_go()
            self._stranger = self._stranger or (seen.joint, can_id)

    def _check_stranger(self) -> None:
        """Stop where somebody else commands a joint, and tell; once."""
        if self._stranger is not None and not self._stopping:
            self._stopping = True
            self.quick_stop()
            raise self._another_master(*self._stranger)

    def _another_master(self, at: int, can_id: int) -> SafetyAbort:
        return another_master(f"joint {self.wishes[at].joint.name}", can_id & ~(EXTENDED | FD_FRAME))

    def _all_off(self) -> None:
        """Every joint is told, and heard for one cycle; never raises ``FrictidError``."""
        for at in range(len(self.wishes)):
            with contextlib.suppress(FrictidError):
                frame = self._frame(at, Order(Do.REST))
                self._rows.feed(self._send(*frame), *frame)
        with contextlib.suppress(FrictidError):
            for heard in self._line.received(self._clock.now_ns() + self._period_ns):
                self._hear(*heard)
