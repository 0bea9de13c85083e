"""Any python-can bus, opened as the robot file says and held by one process: classical or CAN FD."""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import can
from filelock import FileLock, Timeout

from frictid_hil.errors import HardwareBusy, HardwareError, SafetyAbort, UsageError

BusFactory = Callable[[], can.BusABC]

BUS_ERRORS = (can.CanError, OSError, RuntimeError, ValueError)
"""What python-can's interfaces raise from send and receive, whatever their vendor's library is."""

# What it logs is told by our errors, with cause and next step; it must not reach stderr on its own.
logging.getLogger("can").addHandler(logging.NullHandler())

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
_CLASSICAL_MTU = 16  # of a SocketCAN link; one with CAN FD has 72


def split_bus(bus: str) -> tuple[str, str]:
    """``"socketcan:can0"`` to interface and channel; ``UsageError`` for anything else."""
    interface, colon, channel = bus.partition(":")
    if not (interface and colon and channel):
        raise UsageError(
            f"bus {bus!r} is not of the form interface:channel",
            next_step="write it as e.g. socketcan:can0 or pcan:PCAN_USBBUS1",
        )
    return interface, channel


def open_bus(bus: str, options: Mapping[str, Any]) -> can.BusABC:
    """Open any python-can interface; bit rates and a few other options of the robot file go to it.

    Raises:
        UsageError: not of that form, or faults for a bus that injects none.
        HardwareError: interface unknown or without CAN FD where that is wanted, channel absent, or no permission.
    """
    interface, channel = split_bus(bus)
    settings = _settings(bus, interface, options)
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


def _settings(bus: str, interface: str, options: Mapping[str, Any]) -> dict[str, Any]:
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
    return settings


def _fd_settings(bus: str, interface: str, settings: dict[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """What makes an interface CAN FD; each family of python-can's has its own way of being told."""
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


def another_master(where: str, identifier: int) -> SafetyAbort:
    """What to tell where a command came that we did not send; the identifier without flags."""
    return SafetyAbort(
        f"somebody else commands this drive: identifier {identifier:#05x} came with other data than ours",
        where=where,
        cause="a second master on the bus: a controller, a vendor's tool, or a run on another computer",
        next_step="stop it or take it off the bus, then run `frictid-hil check`",
    )


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
