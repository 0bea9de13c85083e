"""What this driver brings for replays (``protocol.frames``): the same readers, made from a run's frame map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from frictid_drivers.mit.actuator import Reader
from frictid_drivers.mit.families import FAMILIES, Motor
from frictid_drivers.mit.frames import Ranges
from frictid_drivers.mit.settings import JointSettings
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.rows import Command, Report, RowDecoder, RowLog, Service

schema = "frictid.mit-frames/1"


def frame_map_values(setup: RobotSetup, settings: Mapping[str, JointSettings]) -> dict[str, Any]:
    """Which frame carries what, with the ranges in force."""
    return {
        "schema": schema,
        "joints": {
            joint.name: {
                "family": settings[joint.name].family.name,
                "direction": joint.direction,
                "motor": asdict(settings[joint.name].motor),
            }
            for joint in setup.joints
        },
    }


def row_decoder(readers: Sequence[Reader]) -> RowDecoder:
    """Frames of several actuators; whatever belongs to none of them is a service."""

    def decode(can_id: int, data: bytes) -> Command | Report | Service | None:
        for reader in readers:
            seen = reader.decode(can_id, data)
            if seen is not None:
                return seen
        return Service(f"frame {can_id & 0x1FFF_FFFF:#x}")

    return RowDecoder([reader.feedback for reader in readers], decode)


def decoder(frame_map: Mapping[str, Any]) -> RowLog:
    """A decoder for logs with this frame map; ``InvalidFields`` where it is not what ``frame_map_values`` writes."""
    try:
        readers = []
        for at, joint in enumerate(frame_map["joints"].values()):
            motor = joint["motor"]
            numbers = int(motor["id"]), int(motor["reply_id"]), Ranges(**motor["ranges"]), int(motor.get("flags", 0))
            settings = JointSettings("", FAMILIES[joint["family"]], Motor(*numbers), 0.0, 0.0, 0.0, 0.0)
            readers.append(Reader(at, int(joint["direction"]), settings))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InvalidFields([FieldProblem(("joints",), f"not a frame map of MIT-mode actuators: {error!r}")]) from None
    return RowLog(row_decoder(readers))
