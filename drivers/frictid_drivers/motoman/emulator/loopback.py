"""The host's end of a wire to an emulator in the same process, in virtual time: as fast as the processor allows."""

from __future__ import annotations

from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_hil.errors import HardwareError


class LoopbackPort:
    """A serial port to a driver; time passes only while it reads, and at another speed or parity bytes are lost."""

    def __init__(self, emulator: Emulator, baud: int, parity: str) -> None:
        self.emulator = emulator
        self._line = (baud, parity)
        self.open = True

    def now_s(self) -> float:
        """Time of the controller."""
        return self.emulator.now_s

    def write(self, data: bytes) -> None:
        """Put bytes on the wire."""
        self._check()
        if self._line == self.emulator.line:
            self.emulator.hear(data)

    def read(self, timeout_s: float) -> bytes:
        """What arrives next, letting at most this much time pass."""
        emulator = self.emulator
        until_s = emulator.now_s + max(0.0, timeout_s)
        while True:
            self._check()
            data = emulator.take(self._line)
            if data or emulator.now_s >= until_s:
                return data
            emulator.advance(min(until_s, emulator.next_event_s()))

    def set_line(self, baud: int, parity: str) -> None:
        """The host changes its speed."""
        self._check()
        self._line = (baud, parity)

    def reopen(self) -> None:
        """Try to have it back; half a second passes where it is still gone."""
        self.open = True
        if self.emulator.gone:
            self.emulator.advance(self.emulator.now_s + 0.5)
        self._check()

    def close(self) -> None:
        """Hang up."""
        self.open = False

    def _check(self) -> None:
        if self.emulator.gone or not self.open:
            raise HardwareError("the port is gone", where="loopback", cause="unplugged")
