"""Any python-can bus with a bad cable, a bad interface or bad drives: python-can's interface ``faulty``.

::

    can.Bus(interface="faulty", channel="socketcan:can0", faults=[{"kind": "drop", "frames": "tpdo1", "count": 3}])

In a robot file it is ``bus: faulty:socketcan:can0`` with ``options.faults``; ``faults`` has the list of kinds. Those of
simulated drives need simulated drives.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import can

from frictid_drivers.virtual.faults import HOST_KINDS, SERVICES, Fault, read_faults
from frictid_drivers.virtual.wire_faults import SYNC_ID, FaultAtWork, Late, OccupiedWire, WireFaults
from frictid_hil.errors import InvalidFields

_ERRORS: Mapping[str, Callable[[], Exception]] = {
    "can": lambda: can.CanOperationError("injected: the controller refuses"),
    "os": lambda: OSError(105, "injected: no buffer space available"),
    "runtime": lambda: RuntimeError("injected: the vendor's library failed"),
    "value": lambda: ValueError("injected: the vendor's library saw a wrong value"),
}
_BUS_OFF = can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, data=bytes(8))
_OF_A_NODE = frozenset(base for name, bases in SERVICES.items() if name != "host_heartbeat" for base in bases)


class FaultyBus(can.BusABC):
    """A bus in front of a bus; ``can.CanInitializationError`` where a fault is not described as it must be."""

    def __init__(
        self,
        # ``interface:channel`` of the good bus, or the bus itself; it is shut down together with this.
        channel: str | can.BusABC,
        faults: Sequence[Fault] | Sequence[Mapping[str, Any]] | None = None,  # as read, or as a robot file lists them
        now_ns: Callable[[], int] = time.monotonic_ns,  # run time; the monotonic clock unless told
        stand_still: Callable[[float], None] = time.sleep,
        **arguments: Any,
    ) -> None:
        known = _described(faults)
        if isinstance(channel, can.BusABC):
            self._bus = channel
        else:
            interface, _, inner = channel.partition(":")
            self._bus = can.Bus(interface=interface, channel=inner, **arguments)
        self._clock = now_ns
        self._start_ns: int | None = None
        self._outgoing, self._incoming = WireFaults(known), WireFaults(known)
        injected = (fault for fault in known if fault.kind in ("reset", "emcy"))
        self._injected = sorted(injected, key=lambda fault: fault.begin_s)
        self._at_work = {kind: [FaultAtWork(fault) for fault in known if fault.kind == kind] for kind in HOST_KINDS}
        self._stand_still = stand_still
        rates = [fault.level for fault in known if fault.kind == "occupied"]
        self._wire = OccupiedWire(min(rates)) if rates else None
        self._told_off = False
        self._late_out, self._late_in = Late(), Late()
        self._received: list[can.Message] = []
        self.channel_info = f"{self._bus.channel_info}, with a bad cable"
        super().__init__(channel="faulty")
        self._can_protocol = self._bus.protocol

    def begin(self) -> None:
        """Times of faults count from here; a SYNC says so by itself."""
        self._start_ns = self._clock()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send what the cable makes of the frame; raises whatever the faults say."""
        if msg.arbitration_id == SYNC_ID and self._start_ns is None:
            self.begin()
        self._fail("send_error")
        if self._is_off():
            raise can.CanOperationError("injected: the bus is off")
        for stall in self._at_work["stall"]:
            if stall.strikes(self._elapsed_ns()):
                self._stand_still(stall.fault.delay_s)
        self._run_late()
        self._inject()
        now_ns, elapsed_ns = self._clock(), self._elapsed_ns()
        self._incoming.hear(msg.arbitration_id, bytes(msg.data))
        passed = self._outgoing.through(now_ns, elapsed_ns, msg.arbitration_id, bytes(msg.data))
        for number, (due_ns, can_id, data) in enumerate(passed):
            frame = _changed(msg, can_id, data)
            if number and can_id in self._outgoing.foreign:
                self._received.append(frame)  # whoever sent it, the host hears it as well as the drives
            if due_ns > now_ns:
                self._late_out.put(due_ns, partial(self._pass, self._bus.send, frame))
            else:
                self._pass(partial(self._bus.send, timeout=timeout), frame)
        self._run_late()

    def _pass(self, deliver: Callable[[can.Message], None], frame: can.Message) -> None:
        """Over the wire, which takes time where it is occupied."""
        if self._wire is None:
            deliver(frame)
        else:
            self._wire.put(self._clock(), frame.arbitration_id, bytes(frame.data), partial(deliver, frame))

    def _run_late(self) -> None:
        now_ns = self._clock()
        self._late_out.run(now_ns)
        self._late_in.run(now_ns)
        if self._wire is not None:
            self._wire.run(now_ns)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._fail("receive_error")
        deadline_s = None if timeout is None else time.monotonic() + timeout
        while True:
            self._run_late()
            self._inject()
            if (off := self._is_off()) and not self._told_off:
                self._told_off = True
                return _BUS_OFF, False
            if self._received:
                return self._received.pop(0), False
            left_s = 0.01 if deadline_s is None else min(0.01, max(0.0, deadline_s - time.monotonic()))
            if self._wire is not None:
                left_s = min(left_s, max(0.0, (self._wire.next_ns - self._clock()) * 1e-9))
            msg = self._bus.recv(left_s)
            if msg is None:
                if deadline_s is not None and time.monotonic() >= deadline_s:
                    return None, False
            elif not off:
                self._arrive(msg)

    def _arrive(self, msg: can.Message) -> None:
        now_ns = self._clock()
        passed = self._incoming.through(now_ns, self._elapsed_ns(), msg.arbitration_id, bytes(msg.data))
        for due_ns, can_id, data in passed:
            frame = _changed(msg, can_id, data)
            if due_ns <= now_ns:
                self._pass(self._received.append, frame)
            else:
                self._late_in.put(due_ns, partial(self._pass, self._received.append, frame))

    def shutdown(self) -> None:
        """Both buses."""
        super().shutdown()
        self._bus.shutdown()

    def _inject(self) -> None:
        """Frames that nobody sent, in their time: resets and warnings, for a bus whose drives know no faults."""
        while self._start_ns is not None and self._injected and self._injected[0].begin_s * 1e9 <= self._elapsed_ns():
            fault = self._injected.pop(0)
            for node in fault.nodes:
                if fault.kind == "reset":
                    self._bus.send(can.Message(arbitration_id=0x000, data=[0x81, node], is_extended_id=False))
                    continue
                for _ in range(fault.times):
                    data = fault.code.to_bytes(2, "little") + b"\x81" + bytes(5)
                    self._received.append(can.Message(time.time(), SYNC_ID + node, is_extended_id=False, data=data))

    def _fail(self, kind: str) -> None:
        for work in self._at_work[kind]:
            if work.strikes(self._elapsed_ns()):
                raise _ERRORS[work.fault.error]()

    def _is_off(self) -> bool:
        return any(work.strikes(self._elapsed_ns()) for work in self._at_work["bus_off"])

    def _elapsed_ns(self) -> int:
        return -1 if self._start_ns is None else self._clock() - self._start_ns

    @staticmethod
    def _detect_available_configs() -> list[can.typechecking.AutoDetectedConfig]:
        return []


def _described(faults: Sequence[Fault] | Sequence[Mapping[str, Any]] | None) -> list[Fault]:
    read: list[Fault] = []
    try:
        for fault in faults or ():
            read += [fault] if isinstance(fault, Fault) else read_faults([fault], {})
    except InvalidFields as problem:
        raise can.CanInitializationError(f"options.faults: {problem}") from None
    # A mute node as a cable sees it: none of its frames pass.
    return [
        replace(fault, kind="drop", cob_ids=frozenset(base + node for base in _OF_A_NODE for node in fault.nodes))
        if fault.kind == "mute"
        else fault
        for fault in read
    ]


def _changed(msg: can.Message, can_id: int, data: bytes) -> can.Message:
    if can_id == msg.arbitration_id and data == msg.data:
        return msg
    return can.Message(
        timestamp=msg.timestamp,
        arbitration_id=can_id,
        is_extended_id=msg.is_extended_id,
        data=data,
        channel=msg.channel,
        is_fd=msg.is_fd,
        bitrate_switch=msg.bitrate_switch,
    )
