"""A CAN bus for drivers whose devices answer a command with a report: exclusive, logged, with deadlines and a budget.

Identifiers carry the flags of ``FrameSink``: bit 31 for 29-bit identifiers, bit 29 for CAN FD.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from frictid_hil.errors import HardwareError
from frictid_hil.protocol.can_bus import (
    BUS_ERRORS,
    DEFAULT_BITRATE,
    DEFAULT_DATA_BITRATE,
    BusFactory,
    BusLock,
    open_bus,
)
from frictid_hil.protocol.can_frames import identifier_of, message_of
from frictid_hil.protocol.can_load import BitRates, highest_rate_hz
from frictid_hil.protocol.driver import Clock, FrameSink

_WIRE_FAILURES = 3


class CanLine:
    """An open bus. Nothing but its owner reads it.

    Raises:
        UsageError: not of the form ``interface:channel``.
        HardwareBusy: another process on this machine holds the bus.
        HardwareError: no such interface or channel, or no permission.
    """

    def __init__(
        self,
        bus: str,  # ``interface:channel`` as typed
        # Of the robot file; ``bitrate``, ``fd``, ``data_bitrate`` and a few others go to python-can.
        options: Mapping[str, Any],
        sink: FrameSink | None,  # told of every frame
        clock: Clock,  # run time to stamp frames with
        # Opens the bus instead of python-can (a simulated one); it is then not locked.
        bus_factory: BusFactory | None = None,
    ) -> None:
        self._name = bus
        self._rates = BitRates(
            int(options.get("bitrate", DEFAULT_BITRATE)),
            int(options.get("data_bitrate", DEFAULT_DATA_BITRATE)) if options.get("fd") else None,
        )
        self._sink = sink
        self._clock = clock
        self._failures = 0
        self._lock: BusLock | None = None
        if bus_factory is not None:
            self._bus = bus_factory()
            return
        self._lock = BusLock(bus)
        self._lock.acquire()
        try:
            self._bus = open_bus(bus, options)
        except BaseException:
            self._lock.release()
            raise

    def highest_rate_hz(self, cycle_frames: Iterable[tuple[int, int]]) -> float:
        """The highest whole rate at which the frames of a cycle (identifier, data bytes) leave a fifth of this bus."""
        return highest_rate_hz(cycle_frames, self._rates)

    def send(self, can_id: int, data: bytes) -> int:
        """Send one frame; the run time it was stamped with.

        Raises:
            HardwareError: several frames in a row could not be sent.
        """
        t_ns = self._clock.now_ns()
        try:
            self._bus.send(message_of(can_id, data))
        except BUS_ERRORS as error:
            self._failures += 1
            if self._failures >= _WIRE_FAILURES:
                self._failures = 0
                raise HardwareError(
                    f"{_WIRE_FAILURES} frames in a row could not be sent: {error}",
                    where=self._name,
                    cause="bus-off, an unplugged adapter, or nobody left on the bus to acknowledge",
                    next_step="check the wiring and termination; motors stop by their own watchdogs if they have any",
                ) from error
            return t_ns
        self._failures = 0
        if self._sink is not None:
            self._sink(t_ns, can_id, bytes(data), True)
        return t_ns

    def received(self, until_ns: int | None = None) -> Iterator[tuple[int, int, bytes]]:
        """Frames as they come: run time, identifier, data; waits for more until ``until_ns``."""
        while True:
            left_s = 0.0 if until_ns is None else max(0.0, (until_ns - self._clock.now_ns()) * 1e-9)
            # In lock-step answers are there when ``send`` returns: what is not there will not come.
            try:
                message = self._bus.recv(0.0 if self._clock.lock_step else left_s)
            except BUS_ERRORS as error:
                raise HardwareError(
                    f"cannot receive: {error}",
                    where=self._name,
                    cause="an unplugged adapter, or a failure of its driver",
                    next_step="check adapter and wiring; motors stop by their own watchdogs if they have any",
                ) from error
            if message is None:
                return
            if message.is_error_frame or message.is_remote_frame:
                continue
            t_ns, can_id, data = self._clock.now_ns(), identifier_of(message), bytes(message.data)
            if self._sink is not None:
                self._sink(t_ns, can_id, data, False)
            yield t_ns, can_id, data

    def close(self) -> None:
        """Release the bus; safe to call twice."""
        with contextlib.suppress(*BUS_ERRORS):
            self._bus.shutdown()
        if self._lock is not None:
            self._lock.release()
            self._lock = None
