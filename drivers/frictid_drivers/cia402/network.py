"""The wire: one python-can bus held exclusively, with canopen's SDO, NMT and EMCY on it and no thread behind it.

canopen usually reads its bus from a notifier thread. Here whoever waits for an SDO answer reads the bus himself, so
that SDO phases are as deterministic in lock-step as the cycle is, nothing has to be stopped before cycling, and no
thread inherits the wrong scheduling class.
"""

from __future__ import annotations

import logging
import re
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import can
import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoCommunicationError
from filelock import FileLock, Timeout

from frictid_hil.errors import HardwareBusy, HardwareError, UsageError
from frictid_hil.protocol.driver import FD_FRAME, FrameSink

BusFactory = Callable[[], can.BusABC]

for _library in ("canopen", "can"):
    # What they log is told by our errors, with cause and next step; it must not reach stderr on its own.
    logging.getLogger(_library).addHandler(logging.NullHandler())

DEFAULT_BITRATE = 1_000_000
DEFAULT_DATA_BITRATE = 2_000_000
FORWARDED = (
    "bitrate", "tty_baudrate", "sleep_after_open", "port", "hop_limit", "app_name", "serial", "index", "host",
    "tcp_tune",
)  # fmt: skip
"""Robot-file options that are handed to python-can as they are, when given."""

_FD_BY_LINK = ("socketcan", "udp_multicast", "frictid", "faulty")
_FD_BY_RATES = ("ixxat", "neovi")
_FD_BY_TIMING = ("pcan", "kvaser", "vector", "slcan", "nixnet")
_FD_CLOCK_HZ = 80_000_000
_LINKS = Path("/sys/class/net")
_CLASSICAL_MTU = 16
"""Of a SocketCAN link; one with CAN FD has 72."""


def split_bus(bus: str) -> tuple[str, str]:
    """``"socketcan:can0"`` to interface and channel.

    Raises:
        UsageError: no colon.
    """
    interface, colon, channel = bus.partition(":")
    if not (interface and colon and channel):
        raise UsageError(
            f"bus {bus!r} is not of the form interface:channel",
            next_step="write it as e.g. socketcan:can0 or pcan:PCAN_USBBUS1",
        )
    return interface, channel


def open_bus(bus: str, options: Mapping[str, Any]) -> can.BusABC:
    """Open any python-can interface.

    Args:
        bus: ``interface:channel``.
        options: of the robot file; bit rates and a few others go to the interface.

    Raises:
        UsageError: not of that form, or faults for a bus that injects none.
        HardwareError: interface unknown or without CAN FD where that is wanted, channel absent, or no permission.
    """
    interface, channel = split_bus(bus)
    settings = {key: options[key] for key in FORWARDED if key in options}
    if interface not in ("socketcan", "virtual"):
        # A SocketCAN link carries its bitrate already; everybody else must be told.
        settings.setdefault("bitrate", DEFAULT_BITRATE)
    if interface == "faulty":
        settings["faults"] = options.get("faults")
    elif "faults" in options:
        raise UsageError(
            "`options: faults` spoil a bus that says so in its name, and this one does not",
            where=bus,
            next_step=f"leave `faults` out, or write the bus as faulty:{bus}",
        )
    fd = bool(options.get("fd"))
    try:
        if fd:
            settings = _fd_settings(bus, interface, settings, options)
        opened = can.Bus(interface=interface, channel=channel, **settings)
    except can.CanInterfaceNotImplementedError as error:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise HardwareError(
            f"python-can has no working interface {interface!r}: {error}",
            where=bus,
            cause="a misspelt interface, or its vendor library is not installed",
            next_step=f"choose one of {known}",
        ) from error
    except PermissionError as error:
        raise HardwareError(
            f"no permission to open the bus: {error}",
            where=bus,
            next_step="add your user to the group that owns the device",
        ) from error
    except (can.CanError, OSError, ValueError, TypeError, ImportError, AttributeError) as error:
        # Interfaces raise whatever their vendor library does; none of it is the user's to debug.
        raise HardwareError(
            f"cannot open the bus: {error}",
            where=bus,
            cause=_likely_cause(error),
            next_step=(
                _link_command(channel, options)
                if interface == "socketcan"
                else "check the adapter, its driver and the channel's name"
            ),
        ) from error
    # slcan calls itself classical whatever it was told.
    classical = opened.protocol is can.CanProtocol.CAN_20 and interface != "slcan"
    if fd and (classical or _classical_link(interface, channel)):
        opened.shutdown()
        raise HardwareError(
            "the bus carries classical CAN frames only, but the robot file says `fd: true`",
            where=bus,
            cause="a link that was brought up without CAN FD, or an adapter that cannot do it",
            next_step=(
                f"sudo ip link set {channel} down; {_link_command(channel, options)}"
                if interface == "socketcan"
                else "leave `fd` out of the robot file's options, or use another adapter"
            ),
        )
    return opened


def _fd_settings(bus: str, interface: str, settings: dict[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """What makes an interface CAN FD; each family of python-can's has its own way of being told.

    Raises:
        HardwareError: an interface that python-can cannot make CAN FD.
    """
    bitrate = int(options.get("bitrate", DEFAULT_BITRATE))
    data_bitrate = int(options.get("data_bitrate", max(DEFAULT_DATA_BITRATE, bitrate)))
    if interface in _FD_BY_LINK:
        return {**settings, "fd": True}
    if interface in _FD_BY_RATES:
        return {**settings, "bitrate": bitrate, "fd": True, "data_bitrate": data_bitrate}
    if interface == "virtual":
        return {**settings, "protocol": can.CanProtocol.CAN_FD}
    if interface in _FD_BY_TIMING:
        timing = can.BitTimingFd.from_sample_point(_FD_CLOCK_HZ, bitrate, 80.0, data_bitrate, 75.0)
        return {**{key: value for key, value in settings.items() if key != "bitrate"}, "timing": timing}
    raise HardwareError(
        f"python-can's interface {interface!r} is not known to speak CAN FD",
        where=bus,
        next_step="leave `fd` out of the robot file's options, or use one of "
        + ", ".join(sorted({*_FD_BY_LINK, *_FD_BY_RATES, *_FD_BY_TIMING})),
    )


def _classical_link(interface: str, channel: str) -> bool:
    """A SocketCAN link whose frames hold 8 bytes; it would refuse the first CAN FD frame."""
    size = _LINKS / channel / "mtu"
    return interface == "socketcan" and size.exists() and int(size.read_text()) == _CLASSICAL_MTU


def _link_command(channel: str, options: Mapping[str, Any]) -> str:
    bitrate = options.get("bitrate", DEFAULT_BITRATE)
    fd = f" dbitrate {options.get('data_bitrate', DEFAULT_DATA_BITRATE)} fd on" if options.get("fd") else ""
    return f"sudo ip link set {channel} up type can bitrate {bitrate}{fd}"


def _likely_cause(error: BaseException) -> str:
    if isinstance(error, OSError) and error.errno == 19:
        return "there is no such CAN interface on this machine"
    return "the adapter is absent, the link is down, or an option does not suit the interface"


def logged_id(message: can.Message) -> int:
    """The identifier as a ``FrameSink`` takes it."""
    return message.arbitration_id | FD_FRAME if message.is_fd else message.arbitration_id


BUS_OFF = "bus-off"
_PASSIVE = "error-passive"


def controller_state(message: can.Message) -> str:
    """What an error frame of the interface says of our own CAN controller, by name; "" for passing errors.

    Source: Linux SocketCAN, ``linux/can/error.h``: the class is in the identifier (0x40 bus-off, 0x04 controller, 0x20
    nobody acknowledged), the controller's state in byte 1 (0x10, 0x20 error-passive).
    """
    if message.arbitration_id & 0x40:
        return BUS_OFF
    if message.arbitration_id & 0x04 and len(message.data) > 1 and message.data[1] & 0x30:
        return _PASSIVE
    return "no acknowledgement" if message.arbitration_id & 0x20 else ""


CONTROLLER_STATES = {
    BUS_OFF: "our CAN controller went bus-off: a short circuit, a wrong bit rate, or missing termination",
    _PASSIVE: "our CAN controller is error-passive: frames are destroyed by a bad cable, termination or bit rate",
    "no acknowledgement": "nobody acknowledges our frames: no other device is on the bus, or all have another bit rate",
}


class BusLock:
    """Exclusive use of one bus among all processes of this machine; released by the system when we die."""

    def __init__(self, bus: str) -> None:
        self._bus = bus
        name = re.sub(r"[^A-Za-z0-9.]+", "-", bus)
        self.path = Path(tempfile.gettempdir()) / f"frictid-hil-{name}.lock"
        self._lock = FileLock(self.path, mode=0o666)

    def acquire(self) -> None:
        """Take the bus.

        Raises:
            HardwareBusy: another process has it.
            HardwareError: the lock file cannot be written.
        """
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise HardwareBusy(
                "held by another process",
                where=self._bus,
                cause="another frictid-hil is running on this bus",
                next_step=f"wait for it to end, or see who holds it: fuser {self.path}",
            ) from error
        except OSError as error:
            raise HardwareError(
                f"cannot lock the bus: {error}",
                where=str(self.path),
                next_step="check the file's owner and permissions",
            ) from error

    def release(self) -> None:
        """Give it back; safe to call twice."""
        self._lock.release()


class Wire(canopen.Network):
    """A canopen network without a notifier; every frame in or out passes the sink.

    Args:
        bus: opened.
        sink: told of every frame.
        now_ns: run time to stamp frames with.
    """

    def __init__(self, bus: can.BusABC, sink: FrameSink | None, now_ns: Callable[[], int]) -> None:
        super().__init__(bus)
        self._wire = bus
        self._sink = sink
        self._now_ns = now_ns
        self._sink_lock = threading.Lock()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send one frame (canopen's own way out)."""
        message = can.Message(arbitration_id=can_id, is_extended_id=False, data=bytes(data), is_remote_frame=remote)
        with self.send_lock:
            self._tell(can_id, message.data, True)
            self._wire.send(message)

    def pump(self, timeout_s: float) -> bool:
        """Receive at most one frame and hand it to its subscribers; False when none came in time."""
        message = self._wire.recv(timeout_s)
        if message is None:
            return False
        if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
            self._tell(logged_id(message), message.data, False)
            self.dispatch(message.arbitration_id, message.data, message.timestamp)
        return True

    def dispatch(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Hand a frame to canopen; what canopen cannot digest (a short EMCY) must not end the reception."""
        try:
            self.notify(can_id, data, timestamp)
        except Exception:  # canopen's callbacks raise whatever struct or its own parsing does
            return

    def drain(self) -> None:
        """Hand over everything that has already arrived."""
        while self.pump(0.0):
            pass

    def _tell(self, can_id: int, data: bytearray, sent: bool) -> None:
        if self._sink is not None:
            # The heartbeat timer sends from a thread of its own.
            with self._sink_lock:
                self._sink(self._now_ns(), can_id, bytes(data), sent)


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


class HeartbeatTimer:
    """The host's heartbeat while nobody cycles: a small thread that survives send errors.

    While cycling the exchange sends it; in lock-step, where time stands still outside the cycle, nobody needs to.
    """

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
            try:
                self._send()
            except can.CanError:
                # A full buffer or a bus-off passes; the drives' watchdogs are the judge of how long is too long.
                continue
