"""A serial port as the layers above need it: bytes out, bytes in within a time, and the time itself."""

from __future__ import annotations

import contextlib
import errno
import select
import termios
import time
from collections.abc import Callable
from typing import Protocol

import serial

from frictid_hil.errors import HardwareBusy, HardwareError

_REOPEN_EVERY_S = 0.5
_LOST = (serial.SerialException, OSError, termios.error)

Sink = Callable[[bytes, bool], None]  # told of every portion of bytes on the wire, with True for ours


def unheard(data: bytes, ours: bool) -> None:
    """The sink where nobody wants to be told."""


class BytePort(Protocol):
    """Bytes both ways, and the clock they run on."""

    def now_s(self) -> float:
        """Time now, from any origin."""

    def write(self, data: bytes) -> None:
        """Put bytes on the wire. ``HardwareError`` when the port is gone."""

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, waiting at most this long for a first byte. ``HardwareError`` when the port is gone."""

    def set_line(self, baud: int, parity: str) -> None:
        """Change speed and parity; bytes under way are sent first."""

    def reopen(self) -> None:
        """Try to have a port back that was lost. ``HardwareError`` where it is not there, after half a second."""

    def close(self) -> None:
        """Release the port; safe to call twice."""


class SerialPort:
    """A port of this machine, held exclusively, parity never changed silently; ``HardwareBusy``, ``HardwareError``."""

    def __init__(self, path: str, baud: int, parity: str) -> None:
        self._path = path
        self._line = (baud, parity)
        self._serial: serial.Serial | None = None
        self._connect()

    def _connect(self) -> None:
        path, (baud, parity) = self._path, self._line
        try:
            self._serial = serial.Serial(
                path, baud, bytesize=8, parity=parity, stopbits=1, timeout=0, write_timeout=1.0, exclusive=True
            )
            self._verify(baud, parity)
        except serial.SerialException as error:
            raise _not_opened(path, error) from None
        except termios.error as error:
            raise _bad_line(path, baud, parity, str(error)) from None

    def now_s(self) -> float:
        """The machine's monotonic clock."""
        return time.monotonic()

    def write(self, data: bytes) -> None:
        """Put bytes on the wire."""
        try:
            self._open().write(data)
        except serial.SerialTimeoutException:
            raise HardwareError(
                "the port accepts no more bytes", where=self._path, cause="flow control, or a stuck adapter"
            ) from None
        except _LOST as error:
            raise self._gone(error) from None

    def read(self, timeout_s: float) -> bytes:
        """Whatever has arrived, waiting at most ``timeout_s`` for the first byte."""
        port = self._open()
        try:
            ready, _, _ = select.select([port.fileno()], [], [], max(0.0, timeout_s))
            if not ready:
                return b""
            data: bytes = port.read(max(1, port.in_waiting))
        except _LOST as error:
            raise self._gone(error) from None
        return data

    def set_line(self, baud: int, parity: str) -> None:
        """Change speed and parity once everything written has left."""
        port = self._open()
        try:
            port.flush()
            port.baudrate = baud
            port.parity = parity
            self._verify(baud, parity)
        except (serial.SerialException, OSError) as error:
            raise self._gone(error) from None
        except (termios.error, ValueError) as error:
            raise _bad_line(self._path, baud, parity, str(error)) from None

    def reopen(self) -> None:
        """Open the same device again, at the speed that it was opened with."""
        self.close()
        time.sleep(_REOPEN_EVERY_S)
        self._connect()

    def close(self) -> None:
        """Release the port and its lock."""
        port, self._serial = self._serial, None
        if port is not None:
            # Where it was unplugged, the kernel has taken it back already.
            with contextlib.suppress(*_LOST):
                port.close()

    def _verify(self, baud: int, parity: str) -> None:
        """Read back: a pseudo terminal may drop the parity bit without a word."""
        flags = termios.tcgetattr(self._open().fileno())[2]
        odd = "O" if flags & termios.PARODD else "E"
        if (odd if flags & termios.PARENB else "N") != parity:
            self.close()
            raise _bad_line(self._path, baud, parity, "it reads back another parity")

    def _open(self) -> serial.Serial:
        if self._serial is None:
            raise HardwareError("the port is closed", where=self._path)
        return self._serial

    def _gone(self, error: Exception) -> HardwareError:
        return HardwareError(
            f"the port failed: {error}",
            where=self._path,
            cause="the adapter was unplugged or its cable pulled; the controller's watchdog stops the arm",
            next_step="plug it in again, check that the arm stands, then start again",
        )


def _not_opened(path: str, error: serial.SerialException) -> HardwareError:
    if "exclusively lock" in str(error) or error.errno in (errno.EBUSY, errno.EAGAIN):
        return HardwareBusy(
            "the port is held by another process",
            where=path,
            cause="another frictid-hil, or a terminal program",
            next_step=f"find it with `fuser {path}` and end it",
        )
    next_step = "check the cable and the name of the port"
    if error.errno == errno.EACCES:
        next_step = "add yourself to the group that owns the port (often `dialout`), then log in again"
    return HardwareError(f"cannot be opened: {error.strerror or error}", where=path, next_step=next_step)


def _bad_line(path: str, baud: int, parity: str, why: str) -> HardwareError:
    return HardwareError(
        f"does not accept {baud} baud with parity {parity}: {why}",
        where=path,
        cause="a pseudo terminal carries no parity, and not every adapter every speed",
        next_step="set `options.parity` (N for an emulator) and `options.baud` in the robot file",
    )
