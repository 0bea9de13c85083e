"""Objects of one drive by SDO: typed, read back after every write, and with errors that name node and object.

What was written and read back is remembered, so that configuring the next joint costs only what differs.
"""

from __future__ import annotations

import struct

import can
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from frictid_drivers.cia402.network import Node
from frictid_drivers.cia402.objects import Object
from frictid_hil.errors import HardwareError

_ABSENT = {0x06020000, 0x06090011, 0x08000024, 0x06010001}
"""Abort codes that say "there is no such object", "no such sub-index", "no data", "write only"."""


class Drive:
    """SDO access to one node.

    Args:
        node: connected.
        joint: name, for errors.
        timeout_s: how long an answer may take.
    """

    def __init__(self, node: Node, joint: str, timeout_s: float) -> None:
        self.node_id = int(node.id or 0)
        self.joint = joint
        self._sdo = node.sdo
        self._sdo.RESPONSE_TIMEOUT = timeout_s
        self._timeout_s = timeout_s
        self._confirmed: dict[tuple[int, int], int] = {}
        self._present: dict[tuple[int, int], bool] = {}

    def where(self, address: str) -> str:
        """How errors name an object of this drive."""
        return f"joint {self.joint} (node {self.node_id}), object {address}"

    def read(self, item: Object) -> int:
        """Value of an object that must be there.

        Raises:
            HardwareError: absent, or no answer.
        """
        value = self.find(item)
        if value is None:
            raise HardwareError(
                f"the drive has no {item.name}",
                where=self.where(item.address),
                cause="another drive than expected, or another firmware",
                next_step="compare the drive's EDS with docs/guides/connect-a-drive.md",
            )
        return value

    def find(self, item: Object) -> int | None:
        """Value of an object, None where the drive does not have it.

        Raises:
            HardwareError: no answer, or refused for another reason.
        """
        data = self._upload(item.index, item.sub, item.address)
        if data is None:
            return None
        try:
            return item.type.unpack(data)
        except struct.error as error:
            raise HardwareError(
                f"answered with {len(data)} bytes, expected a {item.type}",
                where=self.where(item.address),
                cause="the drive's object has another type than CiA 402 gives it",
            ) from error

    def asked_quickly(self, item: Object, timeout_s: float) -> int | None:
        """Value of an object, waiting for it no longer than this.

        Raises:
            HardwareError: no answer, or refused.
        """
        usual_s, self._sdo.RESPONSE_TIMEOUT = self._sdo.RESPONSE_TIMEOUT, timeout_s
        try:
            return self.find(item)
        finally:
            self._sdo.RESPONSE_TIMEOUT = usual_s

    def find_text(self, index: int) -> str:
        """A string object, "" where the drive does not have it."""
        data = self._upload(index, 0, f"{index:04X}:00")
        return "" if data is None else data.rstrip(b"\0").decode("ascii", "replace").strip()

    def has(self, item: Object) -> bool:
        """The drive has this object; asked once."""
        key = (item.index, item.sub)
        if key not in self._present:
            self._present[key] = self.find(item) is not None
        return self._present[key]

    def confirmed(self, item: Object) -> int | None:
        """What was last written and read back; None when that is not known."""
        return self._confirmed.get((item.index, item.sub))

    def write(self, item: Object, value: int, mask: int = -1) -> None:
        """Write and read back, unless this very value was confirmed before.

        Args:
            item: object.
            value: to write.
            mask: bits that must read back as written; drives keep some bits of a COB-ID to themselves.

        Raises:
            HardwareError: refused, or another value is read back.
        """
        if self._confirmed.get((item.index, item.sub)) == value:
            return
        self.write_blind(item, value)
        found = self.read(item)
        if (found ^ value) & mask:
            raise HardwareError(
                f"{item.name}: wrote {_shown(item, value)}, read back {_shown(item, found)}",
                where=self.where(item.address),
                cause="the drive limits, rounds or locks this setting",
                next_step="see the drive's manual on this object; nothing has moved",
            )
        self._confirmed[item.index, item.sub] = value

    def write_blind(self, item: Object, value: int) -> None:
        """Write without reading back (objects that change by themselves).

        Raises:
            HardwareError: refused.
        """
        self._confirmed.pop((item.index, item.sub), None)
        if not item.type.low <= value <= item.type.high:
            raise HardwareError(
                f"{item.name}: {value} does not fit a {item.type} ({item.type.low}..{item.type.high})",
                where=self.where(item.address),
                cause="a setting of the robot file is beyond what the drive can hold",
            )
        try:
            self._sdo.download(item.index, item.sub, item.type.pack(value))
        except SdoAbortedError as error:
            raise HardwareError(
                f"the drive refuses {item.name} = {_shown(item, value)}: {error}",
                where=self.where(item.address),
                cause="an object the drive lacks, a value it does not support, or a state in which it cannot be set",
                next_step="see the drive's manual on this object; nothing has moved",
            ) from error
        except (SdoCommunicationError, can.CanError) as error:
            raise self._silent(item.address, error) from error

    def forget(self, *items: Object) -> None:
        """These were changed by other means than SDO; with none given, all may have been (the drive was reset)."""
        if not items:
            self._confirmed.clear()
        for item in items:
            self._confirmed.pop((item.index, item.sub), None)

    def _upload(self, index: int, sub: int, address: str) -> bytes | None:
        try:
            return bytes(self._sdo.upload(index, sub))
        except SdoAbortedError as error:
            if error.code in _ABSENT:
                return None
            raise HardwareError(f"the drive refuses to be read: {error}", where=self.where(address)) from error
        except (SdoCommunicationError, can.CanError) as error:
            raise self._silent(address, error) from error

    def _silent(self, address: str, error: Exception) -> HardwareError:
        said = "" if str(error) == "No SDO response received" else f" ({error})"
        return HardwareError(
            f"no answer to SDO within {self._timeout_s:g} s{said}",
            where=self.where(address),
            cause="the drive is off, has another node id or bitrate, or the bus is not terminated",
            next_step="check power, wiring and `node` in the robot file; watch the frames with `candump`",
        )


def _shown(item: Object, value: int) -> str:
    return f"{value:#0{2 + item.type.bits // 4}x}" if item.type.bits == 32 and not item.type.signed else str(value)
