"""What one sample looks like inside an MCAP file: a message of fixed size that tools open and numpy reads at a glance.

The body is CDR as ROS 2 writes it, with a ``ros2msg`` schema for Foxglove and PlotJuggler. A chunk is an array of::

    opcode u1 | length u8 | channel u2 | sequence u4 | log_time u8 | publish_time u8 | body
    body:  00 01 00 00 | sec i4 | nanosec u4 | eight float64 | status u4 | error_code u4

``log_time`` is the run time in integer nanoseconds. A column that was not measured holds NaN.
"""

from __future__ import annotations

import json

import numpy as np

from frictid_hil.plan.linear_axis import linear_name

VALUES = (  # columns of float64, in order
    "position_rad",
    "velocity_rad_s",
    "torque_nm",
    "position_command_rad",
    "torque_command_nm",
    "external_torque_nm",
    "rigid_body_torque_nm",
    "temperature_c",
)

COUNTS = ("status", "error_code")  # columns of uint32, in order

MESSAGE_OPCODE = 0x05
CDR_LITTLE_ENDIAN = 0x0100  # the four bytes 00 01 00 00

RECORD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("encapsulation", "<u4"),
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        *((name, "<f8") for name in VALUES),
        *((name, "<u4") for name in COUNTS),
    ]
)
RECORD_LENGTH = RECORD.itemsize - 9  # what the ``length`` field of every sample's record says

MARKS_TOPIC = "/marks"
ROTARY, LINEAR = "frictid_msgs/msg/JointSample", "frictid_msgs/msg/LinearSample"


def topic_of(joint: str) -> str:
    """The channel's topic."""
    return f"/joint/{joint}"


def schema_text(*, prismatic: bool) -> str:
    """The ``ros2msg`` definition; a linear axis names the same fields m, m/s, N."""
    fields = [linear_name(name) if prismatic else name for name in VALUES]
    lines = ["builtin_interfaces/Time stamp", *(f"float64 {name}" for name in fields)]
    lines += [f"uint32 {name}" for name in COUNTS]
    lines += ["=" * 80, "MSG: builtin_interfaces/Time", "int32 sec", "uint32 nanosec", ""]
    return "\n".join(lines)


_MARK = {"joint": "string", "name": "string", "start_ns": "integer", "end_ns": "integer", "details": "object"}
_PROPERTIES = {name: {"type": kind} for name, kind in _MARK.items()}
MARK_SCHEMA = json.dumps({"title": "frictid.Mark", "type": "object", "properties": _PROPERTIES})
"""JSON schema of the messages on ``/marks``."""
