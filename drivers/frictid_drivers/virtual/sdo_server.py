"""An SDO server: one client, expedited and segmented transfers in both directions (CiA 301, 7.2.4).

Frames in, frames out, and the object dictionary in between. Whatever is not understood is answered by an abort, never
by silence - except frames that are not 8 bytes long, which CiA 301 does not count as SDO at all, and the client's own
aborts. Block transfer is refused with "command specifier not valid", as a server without it must.
"""

from __future__ import annotations

from dataclasses import dataclass

from frictid_drivers.virtual.object_dictionary import Abort, ObjectDictionary, SdoAbort
from frictid_drivers.virtual.objects import Key

_MAX_TRANSFER_BYTES = 1024


@dataclass(slots=True)
class _Transfer:
    command: int  # of its segments: 3 uploads, 0 downloads
    address: Key
    data: bytearray
    size: int | None = None  # of a download, where the client told it
    sent: int = 0
    toggle: int = 0


class SdoServer:
    """Answers one client at a time; a new request ends whatever transfer was under way."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self._transfer: _Transfer | None = None

    def reset(self) -> None:
        """Forget the transfer under way."""
        self._transfer = None

    def answer(self, request: bytes) -> bytes | None:
        """The 8 bytes to send back, or None where nothing is to be sent."""
        if len(request) != 8:
            return None
        command = request[0] >> 5
        if command == 4:  # the client gave up
            self._transfer = None
            return None
        transfer = self._transfer
        address = request[2] << 16 | request[1] << 8 | request[3]
        if command in (0, 3) and transfer is not None:
            address = transfer.address
        try:
            if command == 1:
                return self._start_download(address, request)
            if command == 2:
                return self._start_upload(address)
            if transfer is None or transfer.command != command:
                raise SdoAbort(Abort.UNKNOWN_COMMAND)
            if request[0] >> 4 & 1 != transfer.toggle:
                raise SdoAbort(Abort.TOGGLE_NOT_ALTERNATED)
            transfer.toggle ^= 1
            return self._upload_segment(transfer) if command == 3 else self._download_segment(transfer, request)
        except SdoAbort as abort:
            self._transfer = None
            return _frame(0x80, address, abort.code)

    def _start_upload(self, address: Key) -> bytes:
        self._transfer = None
        data = self._dictionary.upload(address)
        if 0 < len(data) <= 4:
            return _frame(0x43 | (4 - len(data)) << 2, address, int.from_bytes(data, "little"))
        self._transfer = _Transfer(3, address, bytearray(data))
        return _frame(0x41, address, len(data))

    def _upload_segment(self, transfer: _Transfer) -> bytes:
        piece = transfer.data[transfer.sent : transfer.sent + 7]
        transfer.sent += len(piece)
        last = transfer.sent >= len(transfer.data)
        command = (transfer.toggle ^ 1) << 4 | (7 - len(piece)) << 1 | last
        if last:
            self._transfer = None
        return bytes([command]) + piece.ljust(7, b"\0")

    def _start_download(self, address: Key, request: bytes) -> bytes:
        self._transfer = None
        expedited, size_given = request[0] >> 1 & 1, request[0] & 1
        if expedited:
            # Without a size the type decides how many of the four bytes count.
            size = 4 - (request[0] >> 2 & 3) if size_given else self._size_of(address)
            self._dictionary.download(address, request[4 : 4 + size])
        else:
            self._dictionary.entry(address)
            size_bytes = int.from_bytes(request[4:8], "little") if size_given else None
            if size_bytes is not None and size_bytes > _MAX_TRANSFER_BYTES:
                raise SdoAbort(Abort.TOO_LONG)
            self._transfer = _Transfer(0, address, bytearray(), size_bytes)
        return _frame(0x60, address, 0)

    def _size_of(self, address: Key) -> int:
        return min(4, len(self._dictionary.upload(address)) or 4)

    def _download_segment(self, transfer: _Transfer, request: bytes) -> bytes:
        transfer.data += request[1 : 8 - (request[0] >> 1 & 7)]
        limit = _MAX_TRANSFER_BYTES if transfer.size is None else transfer.size
        if len(transfer.data) > limit:
            raise SdoAbort(Abort.LENGTH_MISMATCH if transfer.size is not None else Abort.TOO_LONG)
        if request[0] & 1:
            self._transfer = None
            if transfer.size is not None and len(transfer.data) != transfer.size:
                raise SdoAbort(Abort.LENGTH_MISMATCH)
            self._dictionary.download(transfer.address, bytes(transfer.data))
        return bytes([0x20 | (transfer.toggle ^ 1) << 4]) + bytes(7)


def _frame(command: int, address: Key, value: int) -> bytes:
    return bytes([command, address >> 8 & 0xFF, address >> 16, address & 0xFF]) + value.to_bytes(4, "little")
