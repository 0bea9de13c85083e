"""What this driver brings for replays (``protocol.frames``): decoders by frame map, and frame maps by EDS."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from frictid_drivers.cia402.eds import frame_map_from_eds
from frictid_drivers.cia402.frame_map import SCHEMA, FrameMap
from frictid_drivers.cia402.replay import LogDecoder
from frictid_hil.plan.setup import RobotSetup

schema = SCHEMA


def decoder(frame_map: Mapping[str, Any]) -> LogDecoder:
    """A decoder for logs with this frame map.

    Raises:
        InvalidFields: every field of the map that is wrong.
    """
    return LogDecoder(FrameMap.from_mapping(frame_map))


def map_from_eds(path: Path, setup: RobotSetup) -> Mapping[str, Any]:
    """The frame map of drives that were mapped as their EDS or DCF file says; see ``eds.frame_map_from_eds``."""
    return frame_map_from_eds(path, setup).to_mapping()
