"""``--live``: samples of a running job over Foxglove WebSocket, to the tools that robotics people already have open.

One channel per joint, ``/joint/<name>``, JSON with a schema, units in every name. Rows come from the ring that the
cyclic loop fills, in the process that writes files: the loop itself knows nothing of this, and a viewer that is slow or
gone costs it nothing. Loopback unless told otherwise: programs that reach the port can watch, and the pages that
``foxglove.py`` lets in; nobody can command.
"""

from __future__ import annotations

import ipaddress
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from frictid_hil.errors import UsageError
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.runner.ring import SAMPLE_ROW, Rows

if TYPE_CHECKING:
    from frictid_hil.jobs.foxglove import FoxgloveServer

DEFAULT_ADDRESS = "127.0.0.1:8765"
LIVE_HZ = 100.0  # messages a joint and second of run time; the recording has every sample
_MOST_TOLD = 10  # refused origins that a person hears of

_COLUMNS = tuple(name for name in SAMPLE_ROW.names or () if SAMPLE_ROW[name].kind == "f")
_SCHEMA = {
    "title": "frictid.sample",
    "type": "object",
    "properties": {name: {"type": "number"} for name in ("time_s", *_COLUMNS, "tracking_error_rad")},
}


class LiveWatcher:
    """Passes everything on to another watcher, and every joint's samples to whoever is connected."""

    def __init__(self, watcher: Watcher, server: FoxgloveServer, refused: deque[str]) -> None:
        self._watcher = watcher
        self._server = server
        self._refused = refused  # origins of pages that the server turned away; each is told once
        self._told: set[str] = set()
        self._due_ns: list[int] = []
        self._epoch_ns = time.time_ns()

    def plan(self, plan: Plan, setup: RobotSetup) -> None:
        """Announce a channel per joint."""
        self._server.advertise((f"/joint/{joint.name}" for joint in setup.joints), _SCHEMA)
        self._due_ns = [0] * len(setup.joints)
        self._watcher.plan(plan, setup)

    def __getattr__(self, name: str) -> Any:
        """Everything else is the other watcher's."""
        return getattr(self._watcher, name)

    def rows(self, rows: Rows) -> None:
        """Send each joint's rows, thinned to ``LIVE_HZ``."""
        messages = []
        for row in rows:
            index, t_ns = int(row["joint"]), int(row["t_ns"])
            if t_ns < self._due_ns[index]:
                continue
            self._due_ns[index] = t_ns + round(1e9 / LIVE_HZ)
            # Of a log time the viewers expect a date; run time goes along as it is.
            messages.append((index + 1, self._epoch_ns + t_ns, _message(row)))
        self._server.send(messages)
        self._tell_refused()
        self._watcher.rows(rows)

    def _tell_refused(self) -> None:
        while self._refused:
            origin = self._refused.popleft()
            if origin not in self._told and len(self._told) < _MOST_TOLD:
                self._told.add(origin)
                self._watcher.note(
                    f"warning: a page of {origin!r} wanted to watch and was refused; only Foxglove and pages of this "
                    "computer may"
                )


@contextmanager
def live(watcher: Watcher, address: str | None) -> Iterator[Watcher]:
    """The watcher, or while the job lasts one that streams as well (``UsageError``: no such place, no websockets)."""
    if address is None:
        yield watcher
        return
    host, port = _host_and_port(address)
    try:
        from frictid_hil.jobs.foxglove import FoxgloveServer
    except ImportError:
        raise UsageError(
            "--live needs the package websockets", next_step="install it with: pip install 'frictid-hil[live]'"
        ) from None
    refused: deque[str] = deque(maxlen=_MOST_TOLD)
    try:
        server = FoxgloveServer("frictid-hil", host, port, refused.append)
    except OSError as error:
        raise UsageError(
            f"cannot listen: {error}", where=address, next_step="choose another port with --live-at HOST:PORT"
        ) from None
    try:
        if not _is_loopback(host):
            watcher.note(
                f"warning: --live-at {address} is open to the network: everybody who reaches it can watch, unencrypted"
            )
        watcher.note(f"live: open ws://{host}:{server.port} in Foxglove (Open connection, Foxglove WebSocket)")
        yield cast(Watcher, LiveWatcher(watcher, server, refused))
    finally:
        server.close()


def _message(row: Any) -> dict[str, float]:
    """One row without the figures that are not known, because JSON has no NaN."""
    message = {"time_s": int(row["t_ns"]) * 1e-9}
    message |= {name: float(row[name]) for name in _COLUMNS if np.isfinite(row[name])}
    if "position_command_rad" in message and "position_rad" in message:
        message["tracking_error_rad"] = message["position_command_rad"] - message["position_rad"]
    return message


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name: where it leads is for its resolver to say


def _host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"{address!r} is not HOST:PORT", next_step=f"e.g. --live-at {DEFAULT_ADDRESS}")
    return host.strip("[]"), int(port)
