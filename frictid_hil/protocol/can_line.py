"""A CAN bus for drivers whose devices answer a command with a report: exclusive, logged, with deadlines and a budget.

Identifiers carry the flags of ``FrameSink``: bit 31 for 29-bit identifiers, bit 29 for CAN FD.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import can
from filelock import FileLock, Timeout

from frictid_hil.errors import HardwareBusy, HardwareError, UsageError
from frictid_hil.protocol.driver import FD_FRAME, Clock, FrameSink

EXTENDED = 1 << 31
"""Bit of an identifier, here and in bus logs, that says: 29 bits."""
BUSIEST = 0.8
"""Share of a bus that frames of the cycle may take; above, one repeated frame makes the next cycle late."""

BusFactory = Callable[[], can.BusABC]

_FORWARDED = ("bitrate", "tty_baudrate", "sleep_after_open", "port", "app_name", "serial", "index", "host", "tcp_tune")
_BITRATE = 1_000_000
_WIRE_FAILURES = 3


def worst_frame_bits(can_id: int, data_bytes: int) -> int:
    """Length of a classical data frame with the most stuffing there can be and the inter-frame space, bits.

    An 11-bit frame has 44 + 8n bits of which 34 + 8n are stuffed, a 29-bit one 64 + 8n and 54 + 8n; at worst every
    fourth bit after the first of these is followed by a stuff bit; 3 bits lie between frames (ISO 11898-1).
    """
    if not 0 <= data_bytes <= 8:
        raise ValueError(f"a classical CAN frame carries 0..8 bytes, not {data_bytes}")
    more = 20 if can_id & EXTENDED else 0
    return 44 + more + 8 * data_bytes + (34 + more + 8 * data_bytes - 1) // 4 + 3


def highest_rate_hz(cycle_frames: Iterable[tuple[int, int]], bitrate: int) -> float:
    """The highest whole rate at which these frames, each an identifier and its bytes, leave a fifth of the bus."""
    bits = sum(worst_frame_bits(can_id, data_bytes) for can_id, data_bytes in cycle_frames)
    return float(int(BUSIEST * bitrate / bits)) if bits else float("inf")


class CanLine:
    """An open bus. Nothing but its owner reads it.

    Args:
        bus: ``interface:channel`` as typed.
        options: of the robot file; ``bitrate`` and a few others go to python-can.
        sink: told of every frame.
        clock: run time to stamp frames with.
        bus_factory: opens the bus instead of python-can (a simulated one); it is then not locked.

    Raises:
        UsageError: not of the form ``interface:channel``.
        HardwareBusy: another process on this machine holds the bus.
        HardwareError: no such interface or channel, or no permission.
    """

    def __init__(
        self,
        bus: str,
        options: Mapping[str, Any],
        sink: FrameSink | None,
        clock: Clock,
        bus_factory: BusFactory | None = None,
    ) -> None:
        self._name = bus
        self._sink = sink
        self._clock = clock
        self._failures = 0
        self._lock: FileLock | None = None
        if bus_factory is not None:
            self._bus = bus_factory()
            return
        self._lock = _taken(bus)
        try:
            self._bus = _opened(bus, options)
        except BaseException:
            self._lock.release()
            raise

    def send(self, can_id: int, data: bytes) -> int:
        """Send one frame; the run time it was stamped with.

        Raises:
            HardwareError: several frames in a row could not be sent.
        """
        t_ns = self._clock.now_ns()
        message = can.Message(
            arbitration_id=can_id & 0x1FFF_FFFF,
            is_extended_id=bool(can_id & EXTENDED),
            # Bytes of its own: some interfaces pad the message that they are given.
            data=bytearray(data),
        )
        try:
            self._bus.send(message)
        except (can.CanError, OSError) as error:
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
        """Frames as they come: run time, identifier, data.

        Args:
            until_ns: wait for more until then; None for those that are here already.
        """
        while True:
            left_s = 0.0 if until_ns is None else max(0.0, (until_ns - self._clock.now_ns()) * 1e-9)
            # In lock-step answers are there when ``send`` returns: what is not there will not come.
            try:
                message = self._bus.recv(0.0 if self._clock.lock_step else left_s)
            except (can.CanError, OSError) as error:
                raise HardwareError(f"cannot receive: {error}", where=self._name) from error
            if message is None:
                return
            if message.is_error_frame or message.is_remote_frame:
                continue
            can_id = (
                message.arbitration_id
                | (EXTENDED if message.is_extended_id else 0)
                | (FD_FRAME if message.is_fd else 0)
            )
            t_ns, data = self._clock.now_ns(), bytes(message.data)
            if self._sink is not None:
                self._sink(t_ns, can_id, data, False)
            yield t_ns, can_id, data

    def close(self) -> None:
        """Release the bus; safe to call twice."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()
        if self._lock is not None:
            self._lock.release()
            self._lock = None


def _taken(bus: str) -> FileLock:
    path = Path(tempfile.gettempdir()) / f"frictid-hil-{re.sub(r'[^A-Za-z0-9.]+', '-', bus)}.lock"
    lock = FileLock(path, mode=0o666)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise HardwareBusy(
            "held by another process", where=bus, next_step=f"wait for it to end, or see who holds it: fuser {path}"
        ) from None
    except OSError as error:
        raise HardwareError(f"cannot lock the bus: {error}", where=str(path)) from error
    return lock


def _opened(bus: str, options: Mapping[str, Any]) -> can.BusABC:
    interface, colon, channel = bus.partition(":")
    if not (interface and colon and channel):
        raise UsageError(f"bus {bus!r} is not of the form interface:channel", next_step="e.g. socketcan:can0")
    settings = {key: options[key] for key in _FORWARDED if key in options}
    if interface not in ("socketcan", "virtual"):
        # A SocketCAN link carries its bitrate already; everybody else must be told.
        settings.setdefault("bitrate", _BITRATE)
    try:
        return can.Bus(interface=interface, channel=channel, **settings)
    except Exception as error:  # interfaces raise whatever their vendor library does; none of it is the user's to debug
        link = f"sudo ip link set {channel} up type can bitrate {options.get('bitrate', _BITRATE)}"
        raise HardwareError(
            f"cannot open the bus: {error}",
            where=bus,
            cause="the adapter is absent, the link is down, or the interface is misspelt",
            next_step=link if interface == "socketcan" else "check the adapter, its driver and the channel's name",
        ) from error
