"""The wire: one python-can bus held exclusively, with canopen's SDO, NMT and EMCY on it and no thread behind it.

canopen usually reads its bus from a notifier thread. Here whoever waits for an SDO answer reads the bus himself, so
that SDO phases are as deterministic in lock-step as the cycle is, nothing has to be stopped before cycling, and no
thread inherits the wrong scheduling class.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from frictid_drivers.cia402.access import Aborted, Drive
from frictid_drivers.cia402.quirks import Quirks
from frictid_hil.errors import HardwareError
from frictid_hil.protocol.can_bus import BUS_ERRORS
from frictid_hil.protocol.driver import FD_FRAME, FrameSink

# What it logs is told by our errors, with cause and next step; it must not reach stderr on its own.
logging.getLogger("canopen").addHandler(logging.NullHandler())

_SDO_BYTES = 8


class Wire(canopen.Network):
    """A canopen network without a notifier; every frame in or out passes the sink."""

    def __init__(self, bus: can.BusABC, sink: FrameSink | None, now_ns: Callable[[], int]) -> None:
        super().__init__(bus)
        self._wire = bus
        self._sink = sink
        self._now_ns = now_ns
        # canopen ends a broken transfer when its stream is collected, which may be in the middle of a frame.
        self.send_lock = threading.RLock()  # type: ignore[assignment]  # canopen's own is not re-entrant
        self._sink_lock = threading.RLock()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send one frame (canopen's own way out); ``InterfaceFailed`` where it cannot."""
        message = can.Message(arbitration_id=can_id, is_extended_id=False, data=bytes(data), is_remote_frame=remote)
        with self.send_lock:
            self._tell(can_id, message.data, True)
            with _working("send"):
                self._wire.send(message)

    def pump(self, timeout_s: float) -> bool:
        """Hand at most one frame to its subscribers; False where none came in time, ``InterfaceFailed`` on errors."""
        with _working("receive"):
            message = self._wire.recv(timeout_s)
        if message is None:
            return False
        if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
            self._tell(message.arbitration_id | FD_FRAME * message.is_fd, message.data, False)
            self.dispatch(message.arbitration_id, message.data, message.timestamp)
        return True

    def dispatch(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Hand a frame to canopen; what canopen cannot digest (a short EMCY) must not end the reception."""
        with contextlib.suppress(Exception):  # canopen's callbacks raise whatever struct or its own parsing does
            self.notify(can_id, data, timestamp)

    def drain(self) -> None:
        """Hand over everything that has already arrived."""
        while self.pump(0.0):
            pass

    def _tell(self, can_id: int, data: bytearray, sent: bool) -> None:
        if self._sink is not None:
            # The heartbeat timer sends from a thread of its own.
            with self._sink_lock:
                self._sink(self._now_ns(), can_id, bytes(data), sent)


class InterfaceFailed(HardwareError, can.CanError):
    """Send or receive failed. It is python-can's error, too, so that canopen tries a request again."""


@contextlib.contextmanager
def _working(doing: str) -> Iterator[None]:
    try:
        yield
    except BUS_ERRORS as error:
        raise InterfaceFailed(
            f"the interface cannot {doing}: {error}",
            where="bus",
            cause="an unplugged adapter, a link that is down, bus-off, or a failure of the adapter's driver",
            next_step="check adapter, link and wiring, then start again",
        ) from error


class InlineSdoClient(SdoClient):
    """canopen's SDO client that reads the bus itself while it waits."""

    network: Wire

    def send_request(self, request: bytes) -> None:
        """Send, after everything that is left from earlier requests is out of the way."""
        self.network.drain()
        while not self.responses.empty():
            self.responses.get_nowait()
        super().send_request(request)  # type: ignore[no-untyped-call]  # canopen is only partly typed

    def read_response(self) -> Any:
        """Wait for the answer by pumping the bus."""
        deadline = time.monotonic() + self.RESPONSE_TIMEOUT
        while self.responses.empty():
            remaining = deadline - time.monotonic()
            if remaining <= 0 or (not self.network.pump(remaining) and time.monotonic() >= deadline):
                raise SdoCommunicationError("No SDO response received")
        if len(self.responses.queue[0]) != _SDO_BYTES:  # canopen would look for the code of a refusal behind its end
            short = self.responses.get_nowait()
            raise SdoCommunicationError(f"an answer of {len(short)} bytes instead of {_SDO_BYTES}")
        return super().read_response()  # type: ignore[no-untyped-call]  # canopen is only partly typed


class Node(canopen.RemoteNode):
    """A remote node whose SDO client pumps inline."""

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> InlineSdoClient:
        """As canopen's, with our client."""
        client = InlineSdoClient(  # type: ignore[no-untyped-call]  # canopen is only partly typed
            rx_cobid, tx_cobid, self.object_dictionary
        )
        self.sdo_channels.append(client)
        if self.has_network():
            self.network.subscribe(client.tx_cobid, client.on_response)
        return client


class SdoDrive(Drive):
    """One node on a CANopen network."""

    def __init__(self, node: Node, joint: str, timeout_s: float) -> None:
        super().__init__(int(node.id or 0), joint)
        self._sdo = node.sdo
        self._sdo.RESPONSE_TIMEOUT = timeout_s

    def learn(self, quirks: Quirks) -> None:
        """As ``Drive.learn``; a drive may need more time for its answers."""
        super().learn(quirks)
        if quirks.sdo_timeout_s is not None:
            self._sdo.RESPONSE_TIMEOUT = max(self._sdo.RESPONSE_TIMEOUT, quirks.sdo_timeout_s)

    def upload(self, index: int, sub: int) -> bytes:
        """As ``Drive.upload``."""
        with self._told(index, sub):
            return bytes(self._sdo.upload(index, sub))

    def download(self, index: int, sub: int, data: bytes) -> None:
        """As ``Drive.download``."""
        with self._told(index, sub):
            self._sdo.download(index, sub, data)

    @contextlib.contextmanager
    def answering_within(self, timeout_s: float) -> Iterator[None]:
        """As ``Drive.answering_within``."""
        usual_s, self._sdo.RESPONSE_TIMEOUT = self._sdo.RESPONSE_TIMEOUT, timeout_s
        try:
            yield
        finally:
            self._sdo.RESPONSE_TIMEOUT = usual_s

    @contextlib.contextmanager
    def _told(self, index: int, sub: int) -> Iterator[None]:
        try:
            yield
        except SdoAbortedError as error:
            raise Aborted(error.code, str(error)) from error
        except SdoCommunicationError as error:
            said = "" if str(error) == "No SDO response received" else f" ({error})"
            raise HardwareError(
                f"no answer to SDO within {self._sdo.RESPONSE_TIMEOUT:g} s{said}",
                where=self.where(f"{index:04X}:{sub:02X}"),
                cause="the drive is off, has another node id or bitrate, or the bus is not terminated",
                next_step="check power, wiring and `node` in the robot file; watch the frames with `candump`",
            ) from error


class HeartbeatTimer:
    """The host's heartbeat while nobody cycles (the exchange sends its own): a thread that survives send errors."""

    def __init__(self, send: Callable[[], None], period_s: float) -> None:
        self._send = send
        self._period_s = period_s
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin; does nothing when already running."""
        if self._thread is None:
            self._stop.clear()
            self._thread = threading.Thread(target=self._run, name="frictid-heartbeat", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End; safe to call twice."""
        if self._thread is not None:
            self._stop.set()
            self._thread.join(1.0)
            self._thread = None

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            # A full buffer or a bus-off passes; the drives' watchdogs are the judge of how long is too long.
            with contextlib.suppress(HardwareError):
                self._send()
