"""A CAN bus over a local socket: python-can's interface ``frictid``, and the hub that joins its members.

python-can's own ``virtual`` bus does not leave its process; this one does. The hub belongs to the process that holds
the simulated drives; every client hears every frame but its own, as on a wire. A frame is one packet
(``SOCK_SEQPACKET`` keeps the boundaries), and a client too slow to read loses frames rather than holding up the bus, as
a controller with a full receive buffer would::

    can.Bus(interface="frictid", channel="hp3j")
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can

from frictid_drivers.virtual.channel import runtime_folder, socket_path
from frictid_hil.protocol.can_frames import SocketFrames
from frictid_hil.protocol.driver import FD_FRAME

CLASSICAL, FD = struct.Struct("<IBB2x8sQ"), struct.Struct("<IBB2x64sQ")
"""A packet: identifier with flags, length, 1 for a switched bit rate, and data as in SocketCAN, and when it was sent on
the machine's monotonic clock, ns."""

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
_BUFFER_BYTES = 1 << 20
_CONNECT_S = 0.2


def pack(can_id: int, data: bytes, stamp_ns: int, *, fd: bool = False) -> bytes:
    """One frame as a packet."""
    return (FD if fd else CLASSICAL).pack(can_id, len(data), fd, data, stamp_ns)


def unpacked(packet: bytes) -> tuple[int, bytes, int, bool] | None:
    """Identifier with flags, data, when it was sent, and whether it is a CAN FD frame; None for what is no packet."""
    if len(packet) not in (CLASSICAL.size, FD.size):
        return None
    fd = len(packet) == FD.size
    can_id, size, _, data, stamp_ns = (FD if fd else CLASSICAL).unpack(packet)
    return can_id, data[:size], stamp_ns, fd


def _prepare(end: socket.socket, poll: select.poll) -> None:
    """Large buffers, never waiting, and what comes is seen by ``poll``."""
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        end.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
    end.setblocking(False)
    poll.register(end, select.POLLIN)


class SocketBus(can.BusABC):
    """One member of the bus, by its name or the path of its socket; arguments of other interfaces mean nothing here.

    ``can.CanInitializationError`` where nobody simulates drives on this channel.
    """

    def __init__(self, channel: Any = "frictid", can_filters: Any = None, **arguments: Any) -> None:
        path = Path(channel) if "/" in str(channel) else socket_path(str(channel))
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._socket.settimeout(_CONNECT_S)
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise can.CanInitializationError(f"no simulated bus at {path}: {error.strerror or error}") from None
        self._poll = select.poll()
        _prepare(self._socket, self._poll)
        self.channel_info = f"simulated bus {channel}"
        super().__init__(channel=channel, can_filters=can_filters)
        self._can_protocol = can.CanProtocol.CAN_FD
        self.frames = None if can_filters else SocketFrames(self._socket, stamped=True)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame on the bus; ``can.CanOperationError`` where it is gone, or full for longer than ``timeout``."""
        flags = EXTENDED * msg.is_extended_id | REMOTE * msg.is_remote_frame | ERROR * msg.is_error_frame
        packet = pack(msg.arbitration_id | flags, bytes(msg.data), time.monotonic_ns(), fd=msg.is_fd)
        deadline_s = time.monotonic() + (timeout if timeout else 0.0)
        while True:
            try:
                self._socket.send(packet)
            except BlockingIOError:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    raise can.CanOperationError("the simulated bus takes no frames: transmit buffer full") from None
                select.select([], [self._socket], [], left_s)
            except OSError as error:
                raise can.CanOperationError(f"the simulated bus is gone: {error.strerror}") from None
            else:
                return

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while True:
            try:
                packet = self._socket.recv(FD.size)
            except BlockingIOError:
                if timeout == 0 or not self._poll.poll(None if timeout is None else max(0.0, timeout * 1e3)):
                    return None, False
                timeout = None if timeout is None else 0
                continue
            except OSError as error:
                raise can.CanOperationError(f"the simulated bus is gone: {error.strerror}") from None
            if not packet:
                raise can.CanOperationError("the simulated bus is gone: its process has ended")
            return message_of(packet, self.channel_info), False

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._socket.close()

    @staticmethod
    def _detect_available_configs() -> list[can.typechecking.AutoDetectedConfig]:
        return [{"interface": "frictid", "channel": path.stem} for path in sorted(runtime_folder().glob("*.sock"))]


def message_of(packet: bytes, channel: str | None = None) -> can.Message:
    """A packet as python-can's message."""
    found = unpacked(packet)
    assert found is not None, "the hub passes on nothing else"
    can_id, data, stamp_ns, fd = found
    return can.Message(
        timestamp=(time.time_ns() - time.monotonic_ns() + stamp_ns) * 1e-9,
        arbitration_id=can_id & 0x1FFFFFFF,
        is_extended_id=bool(can_id & EXTENDED),
        is_remote_frame=bool(can_id & REMOTE),
        is_error_frame=bool(can_id & ERROR),
        is_fd=fd,
        bitrate_switch=fd,
        dlc=len(data),
        data=None if can_id & REMOTE else data,
        channel=channel,
    )


class Hub:
    """The wire: accepts members on a socket of its own, hands every frame to all others and to the drives."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._inode = path.stat().st_ino
        self._listener.listen(16)
        self._listener.setblocking(False)
        self._poll = select.poll()
        self._poll.register(self._listener, select.POLLIN)
        self._members: dict[int, socket.socket] = {}
        # Called as (identifier with ``EXTENDED``, ``REMOTE`` and ``FD_FRAME``, data, when it was sent) for
        # every frame of a member but error frames.
        self.heard: Callable[[int, bytes, int], None] = lambda can_id, data, stamp_ns: None

    @property
    def members(self) -> int:
        """How many are connected."""
        return len(self._members)

    def send(self, can_id: int, data: bytes) -> None:
        """A frame of the drives, to all members."""
        fd = can_id & FD_FRAME != 0
        self._spread(pack(can_id & ~FD_FRAME, data, time.monotonic_ns(), fd=fd), -1)

    def wait(self, longest_s: float) -> None:
        """Return when there is something to serve, or after so long."""
        self._poll.poll(max(0.0, longest_s) * 1e3)

    def serve(self) -> None:
        """Deal with everything that has arrived."""
        for number, _ in self._poll.poll(0):
            if number == self._listener.fileno():
                self._accept()
            elif number in self._members:  # not dropped meanwhile, when a frame could not be passed on to it
                self._read(number)

    def close(self) -> None:
        """Unplug everybody."""
        for number in list(self._members):
            self._drop(number)
        self._listener.close()
        # A later hub may have taken the name while this one waited for its drives to come to rest.
        with contextlib.suppress(FileNotFoundError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            member, _ = self._listener.accept()
            _prepare(member, self._poll)
            self._members[member.fileno()] = member

    def _read(self, number: int) -> None:
        member = self._members[number]
        while True:
            try:
                packet = member.recv(FD.size)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._drop(number)
                return
            found = unpacked(packet)
            if found is not None:
                self._spread(packet, number)
                can_id, data, stamp_ns, fd = found
                if not can_id & ERROR:
                    self.heard(can_id | FD_FRAME if fd else can_id, data, stamp_ns)

    def _spread(self, packet: bytes, sender: int) -> None:
        for number, member in list(self._members.items()):
            if number != sender:
                try:
                    member.send(packet)
                except BlockingIOError:
                    continue  # too slow: its loss
                except OSError:
                    self._drop(number)

    def _drop(self, number: int) -> None:
        member = self._members.pop(number, None)
        if member is not None:
            self._poll.unregister(member)
            member.close()
