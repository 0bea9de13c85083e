"""What a job recorded, fetched block by block: while it runs where the controller allows that, the rest afterwards.

Every block carries its own place and CRC, so a broken transfer goes on with the first sample that is missing. At 19200
baud the line carries more than a quarter of what a running job records beside the questions about it: the transfer is
shorter by that, and a port that is lost for good leaves what had come.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from frictid_drivers.motoman.batch import JobState
from frictid_drivers.motoman.controller_errors import BadReply, ControllerError, LinkError
from frictid_drivers.motoman.host_control import HostControl
from frictid_drivers.motoman.stream_frames import crc16
from frictid_hil.errors import HardwareError

_SAMPLES_AT_ONCE: Final = 17
"""While the job runs: as text they fit one block of the link, so that a stop waits for no more than 0.2 s at 19200."""
_SAMPLES_PER_REQUEST: Final = 32 * 18
_FETCH_ATTEMPTS: Final = 5

_SAMPLE_BYTES: Final = 10
_HEAD: Final = struct.Struct("<HIB")
_SHIFTS: Final = struct.Struct("<BB")

Rows = dict[int, tuple[int, int, int]]
"""Samples by number: encoder position in pulses, 0.1 pulse/s, uN m at the motor shaft."""


class JobRecord:
    """The samples of one job that are here so far."""

    def __init__(
        self,
        host: HostControl,
        number: int,
        *,
        while_running: bool,
        # Told the numbers [first, last) of samples that joined those that are here without a gap.
        arrived: Callable[[int, int], None] = lambda first, last: None,
    ) -> None:
        self._host = host
        self._number = number
        self._version = 2 if while_running else 1  # of FREAD: 2 hands blocks over while the job runs, too
        self._failures = 0
        self._arrived = arrived
        self._rows: Rows = {}
        self.count = 0  # of samples from the first on that are here without a gap
        self.dropped_pulses = 0  # by the speed limiter, as the newest state says

    def follow(self, state: JobState, within_s: float) -> bool:
        """While the job runs: fetch some of what waits, where it fills a block of the link; whether any came.

        Nothing that goes wrong may end the job, but a port that is gone (``HardwareError``): the rest comes later.
        """
        self.dropped_pulses = state.dropped_pulses
        behind = state.done_ticks - self.count
        if self._version == 1 or self._failures >= _FETCH_ATTEMPTS or behind < _SAMPLES_AT_ONCE:
            return False
        before = self.count
        try:
            self._read(_SAMPLES_AT_ONCE, state, within_s)
        except (LinkError, BadReply, ControllerError):
            self._failures += 1
        return self.count > before

    def complete(self, state: JobState, progress: Callable[[float], None]) -> None:
        """Fetch what is missing of a job that is over; ``LinkError`` after several attempts, ``BadReply`` for other."""
        self.dropped_pulses = state.dropped_pulses
        failures = 0
        while self.count < state.done_ticks:
            before = len(self._rows)
            where = f"FREAD from sample {self.count} on"
            failure: HardwareError = BadReply("no intact block in the reply", where=where)
            try:
                self._read(_SAMPLES_PER_REQUEST, state)
            except (LinkError, BadReply) as error:
                failure = error
            failures = 0 if len(self._rows) > before else failures + 1
            if failures >= _FETCH_ATTEMPTS:
                raise failure
            progress(self.count / state.done_ticks)

    def samples(self, first: int, last: int) -> NDArray[np.int64]:
        """Rows [first, last), shape (n, 3); see ``Rows``."""
        return np.array([self._rows[k] for k in range(first, last)], dtype=np.int64).reshape(last - first, 3)

    def _read(self, count: int, state: JobState, within_s: float | None = None) -> None:
        """FREAD from the first sample that is missing; whole blocks are kept also where the rest never comes."""
        shifts = None if self._version == 2 else (state.velocity_shift, state.torque_shift)
        collector = BlockCollector(self._number, self._rows, shifts)

        def take(text: str, index: int) -> None:
            collector.take(text, index)
            self._advance()

        self._host.ask(f"FREAD {self._version},{self._number},{self.count},{count}", take, within_s=within_s)
        collector.finish()
        self._advance()

    def _advance(self) -> None:
        before = self.count
        while self.count in self._rows:
            self.count += 1
        if self.count > before:
            self._arrived(before, self.count)


class BlockCollector:
    """Cuts the text of a reply into base64 blocks as it comes, and fills ``rows`` from every intact one of this job."""

    def __init__(self, number: int, rows: Rows, shifts: tuple[int, int] | None) -> None:
        self._number = number
        self._rows = rows
        self._shifts = shifts  # of velocity and torque for the whole job; None where every block carries its own
        self._head_bytes = _HEAD.size + (_SHIFTS.size if shifts is None else 0)
        self._text = ""

    def take(self, text: str, index: int) -> None:
        """The text of one BSC block."""
        self._text = text if index == 0 else self._text + text
        *whole, self._text = self._text.split(",")
        for coded in whole:
            self._keep(coded)

    def finish(self) -> None:
        """The reply is over: what is left is the last block."""
        self._keep(self._text)

    def _keep(self, coded: str) -> None:
        try:
            raw = base64.b64decode(coded, validate=True)
        except ValueError:
            return
        if len(raw) < self._head_bytes + 2 or crc16(raw[:-2]) != int.from_bytes(raw[-2:], "little"):
            return
        number, first, count = _HEAD.unpack_from(raw)
        if number != self._number or len(raw) != self._head_bytes + count * _SAMPLE_BYTES + 2:
            return
        velocity_shift, torque_shift = self._shifts or _SHIFTS.unpack_from(raw, _HEAD.size)
        for k in range(count):
            at = self._head_bytes + k * _SAMPLE_BYTES
            self._rows[first + k] = (
                int.from_bytes(raw[at : at + 4], "little", signed=True),
                int.from_bytes(raw[at + 4 : at + 7], "little", signed=True) << velocity_shift,
                int.from_bytes(raw[at + 7 : at + 10], "little", signed=True) << torque_shift,
            )
