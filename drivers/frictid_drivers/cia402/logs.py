"""Logs: what this driver brings for replays (``protocol.frames``), and the decoder that plays a log again.

The same frames give the same rows as in the live cycle, bit for bit. A row begins at SYNC and ends where the live cycle
ended it: when the reply window was over, or the next SYNC came. Set-points of a row are those that its SYNC put into
force. A SYNC that repeats the counter of the one before it was sent by a quick stop, between two cycles: it ends the
row and begins none (before any report it is a doubled frame of a damaged log). Without SYNC (logs of event-driven
drives) a row begins where a report comes a second time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictid_drivers.cia402.codec import CommandDecoder, Decoder
from frictid_drivers.cia402.eds import frame_map_from_eds
from frictid_drivers.cia402.frame_map import SCHEMA, FrameMap
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import FD_FRAME, Feedback
from frictid_hil.protocol.frames import LoggedFrame

schema = SCHEMA

_NMT, _SYNC, _TIME = 0x000, 0x080, 0x100
_NMT_START = 0x01
_EXTENDED = 1 << 31
_SERVICES = {0x080: "EMCY", 0x580: "SDO answer", 0x600: "SDO request", 0x700: "heartbeat"}


@dataclass(frozen=True, slots=True)
class Row:
    """One cycle of a log."""

    t_ns: int
    # Of all joints, in the order of the frame map, with the set-points in force; reused from row to row.
    feedback: Sequence[Feedback]
    commands: CommandDecoder  # last set-points of all joints; reused from row to row


class LogDecoder:
    """Rows of one log."""

    def __init__(self, frame_map: FrameMap) -> None:
        self._sync = frame_map.sync_cob_id
        self._window_ns = frame_map.window_ns
        self._decoder = Decoder(frame_map)
        self._commands = CommandDecoder(frame_map)
        self._reports = {frame.cob_id for joint in frame_map.joints for frame in joint.reports}
        self._command_ids = {frame.cob_id for joint in frame_map.joints for frame in joint.commands}
        self._services = {_NMT, _TIME} | {base + joint.node for joint in frame_map.joints for base in (0x580, 0x600)}
        if frame_map.host_node:
            self._services.add(0x700 + frame_map.host_node)
        # Frames that are neither reports, commands, nor services of our nodes, counted by name.
        self.unknown: Counter[str] = Counter()
        self.services: Counter[str] = Counter()  # NMT, TIME, SDO and heartbeats around the cycles, counted by name
        self.repeated = 0  # reports that came a second time in their row (with SYNC only)
        self.backwards = 0  # frames whose time is before that of the frame before them

    def rows(self, frames: Iterable[LoggedFrame]) -> Iterator[Row]:
        """Decode frame by frame; whatever a log may hold, this does not raise."""
        decoder, commands = self._decoder, self._commands
        waiting: list[tuple[int, bytes]] = []
        opened_ns: int | None = None
        last_ns = 0
        counter = b""
        answered = False
        for t_ns, logged_id, data in frames:
            can_id = logged_id & ~FD_FRAME  # the same PDO, whichever kind of frame carries it
            if t_ns < last_ns:
                self.backwards += 1
            last_ns = t_ns
            is_sync, is_report = can_id == self._sync, can_id in self._reports
            again = is_report and opened_ns is not None and decoder.has(can_id)
            repeats = is_sync and data != b"" and data == counter
            if repeats and not answered:
                continue
            ends = is_sync or (again and self._sync is None)
            restarts = can_id == _NMT and data[:1] == bytes([_NMT_START])
            over = opened_ns is not None and 0 < self._window_ns < t_ns - opened_ns
            if opened_ns is not None and (ends or restarts or over):
                yield Row(opened_ns, decoder.finish(), commands)
                opened_ns = None
            begins = ends or (is_report and self._sync is None and opened_ns is None)
            if is_sync:
                begins, counter = not repeats, data
            if restarts:
                decoder.restart()
                commands.restart()
                waiting.clear()
                counter = b""
            if begins:
                for cob_id, command in waiting:
                    commands.feed(cob_id, command)
                waiting.clear()
                for report, position_rad in zip(decoder.feedback, commands.position_rad, strict=True):
                    report.position_command_rad = position_rad
                decoder.begin(t_ns)
                opened_ns = t_ns
                answered = False
            if is_sync:
                continue
            if can_id in self._command_ids:
                waiting.append((can_id, data))
                continue
            answered = answered or is_report
            if again and self._sync is not None:
                self.repeated += 1
            if not decoder.feed(t_ns, can_id, data):
                (self.services if can_id in self._services else self.unknown)[_name(can_id)] += 1
        if opened_ns is not None:
            yield Row(opened_ns, decoder.finish(), commands)


def _name(can_id: int) -> str:
    """A frame as a person would call it."""
    if can_id & _EXTENDED or can_id > 0x7FF:
        return f"extended frame {can_id & ~_EXTENDED:#010x}"
    for cob_id, name in ((_NMT, "NMT"), (_SYNC, "SYNC"), (_TIME, "TIME")):
        if can_id == cob_id:
            return name
    service = _SERVICES.get(can_id & 0x780)
    return f"{service} of node {can_id & 0x7F}" if service else f"frame {can_id:#05x}"


def decoder(frame_map: Mapping[str, Any]) -> LogDecoder:
    """A decoder for logs with this frame map; ``InvalidFields`` with every field of the map that is wrong."""
    return LogDecoder(FrameMap.from_mapping(frame_map))


def map_from_eds(path: Path, setup: RobotSetup) -> Mapping[str, Any]:
    """The frame map of drives that were mapped as their EDS or DCF file says; see ``eds.frame_map_from_eds``."""
    return frame_map_from_eds(path, setup).to_mapping()
