"""Frames of a log back into figures: what a driver brings so that a replay decodes exactly as its live cycle does.

Decoders are found through the entry-point group ``frictid_hil.frame_decoders``, like drivers through theirs, and are
told apart by the ``schema`` of the frame map that they understand.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Feedback

GROUP = "frictid_hil.frame_decoders"

LoggedFrame = tuple[int, int, bytes]
"""Run time in ns, CAN id (flags as in ``FrameSink``), data."""


class DecodedRow(Protocol):
    """One cycle of a log; what it holds is reused from row to row."""

    @property
    def t_ns(self) -> int:
        """Run time at which the row began."""

    @property
    def feedback(self) -> Sequence[Feedback]:
        """Of all joints, in the order of the frame map, with the set-points in force."""


class LogDecoder(Protocol):
    """Decodes one log, once."""

    unknown: Counter[str]  # frames that nothing describes, by name
    services: Counter[str]  # frames around the cycles (network management, parameters), by name
    repeated: int  # reports that came twice in a row
    backwards: int  # frames with a time before that of the frame before them

    def rows(self, frames: Iterable[LoggedFrame]) -> Iterator[DecodedRow]:
        """Row by row; raises nothing, whatever the log holds."""


class FrameDecoders(Protocol):
    """What an entry point of the group gives: a class or module; ``map_from_eds`` where its drives have EDS files."""

    schema: str  # of the frame maps it understands

    def decoder(self, frame_map: Mapping[str, Any]) -> LogDecoder:
        """A decoder for logs with this frame map; ``InvalidFields`` names every field of the map that is wrong."""

    def map_from_eds(self, path: Path, setup: RobotSetup) -> Mapping[str, Any]:
        """The frame map of drives that were mapped as their EDS or DCF file says.

        Raises:
            InputFileError: unreadable, or it maps no position.
        """


def frame_decoders(schema: str) -> FrameDecoders:
    """The decoders for frame maps of this schema; ``InvalidFields`` where nobody installed understands it."""
    known = []
    for point in entry_points(group=GROUP):
        loaded: FrameDecoders = point.load()
        if loaded.schema == schema:
            return loaded
        known.append(loaded.schema)
    raise InvalidFields([FieldProblem(("schema",), f"no decoder for {schema!r}; known: {', '.join(known) or 'none'}")])


def joint_names(frame_map: Mapping[str, Any]) -> list[str]:
    """Joints of a frame map in its order, which is that of the decoded feedback."""
    return [str(name) for name in frame_map["joints"]]
