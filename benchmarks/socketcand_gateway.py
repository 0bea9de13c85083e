"""A CAN bus behind TCP, as the daemon ``socketcand`` serves it in raw mode: the drives' end of it.

Written after the daemon's description of its protocol (github.com/linux-can/socketcand, ``doc/protocol.md``). One
client, on 127.0.0.1, such as python-can's interface `socketcand`. Its frames arrive as ``< send ID LENGTH B0 ... >``,
and it is sent ``< frame ID SECONDS DATA >``.
"""

from __future__ import annotations

import re
import select
import socket
import time

import can

CHANNEL = "can0"
_COMMAND = re.compile(r"<\s*([^<>]*?)\s*>")
_WIDE = 3
"""Digits of an identifier of 11 bits; one of 29 has eight."""


class Gateway(can.BusABC):
    """The bus, as the drives see it.

    Args:
        port: to listen on; 0 for any.

    Attributes:
        port: that it listens on.
        refused: commands of the client that were answered with an error.
    """

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        self.refused: list[str] = []
        self._client: socket.socket | None = None
        self._raw = False
        self._text = ""
        self._waiting: list[can.Message] = []
        super().__init__(channel=CHANNEL)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """To the client; lost where there is none, as on a wire."""
        if self._raw:
            width = 8 if msg.is_extended_id else _WIDE
            self._tell(f"< frame {msg.arbitration_id:0{width}X} {time.time():.6f} {msg.data.hex().upper()} >")

    def cut(self) -> None:
        """Lose the connection for good, as a cable does that somebody trips over; from any thread."""
        self._listener.close()
        if self._client is not None:
            self._client.shutdown(socket.SHUT_RDWR)

    def shutdown(self) -> None:
        """Stop serving."""
        super().shutdown()
        self._leave()
        self._listener.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._waiting:
            self._listen(timeout)
        return (self._waiting.pop(0) if self._waiting else None), False

    def _listen(self, timeout: float | None) -> None:
        members = [one for one in (self._listener, self._client) if one is not None and one.fileno() >= 0]
        for ready in select.select(members, [], [], timeout)[0]:
            if ready is self._listener:
                self._leave()
                self._client, _ = self._listener.accept()
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._tell("< hi >")
                continue
            try:
                said = ready.recv(4096).decode("ascii")
            except OSError:
                said = ""
            if not said:
                self._leave()
                continue
            *commands, self._text = re.split(r"(?<=>)", self._text + said)
            for command in commands:
                self._obey(_COMMAND.search(command))

    def _obey(self, command: re.Match[str] | None) -> None:
        match command[1].split() if command else []:
            case ["open", channel] if channel == CHANNEL:
                self._tell("< ok >")
            case ["rawmode"]:
                self._raw = True
                self._tell("< ok >")
            case ["send", identifier, length, *data] if self._raw and int(length, 16) == len(data) <= 8:
                self._waiting.append(
                    can.Message(
                        arbitration_id=int(identifier, 16),
                        is_extended_id=len(identifier) > _WIDE,
                        data=[int(one, 16) for one in data],
                    )
                )
            case other:
                self.refused.append(" ".join(other))
                self._tell("< error unknown command >")

    def _tell(self, text: str) -> None:
        try:
            if self._client is not None:
                self._client.sendall(text.encode("ascii"))
        except OSError:
            self._leave()

    def _leave(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client, self._raw, self._text = None, False, ""
