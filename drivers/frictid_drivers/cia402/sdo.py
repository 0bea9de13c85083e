"""Objects by CANopen's SDO."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from frictid_drivers.cia402.access import Aborted, Drive
from frictid_drivers.cia402.network import Node
from frictid_drivers.cia402.quirks import Quirks
from frictid_hil.errors import HardwareError


class SdoDrive(Drive):
    """One node on a CANopen network.

    Args:
        node: connected.
        joint: name, for errors.
        timeout_s: how long an answer may take.
    """

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
