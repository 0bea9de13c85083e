"""Objects of a simulated drive written past the host driver, by a second member of the bus.

What a person's hand does to a joint, or a payload on it, is no part of a robot's control; it must not take the host's
SDO client, nor wait for its cycle.
"""

from __future__ import annotations

import time

import can

from frictid_drivers.virtual.objects import OBJECTS, SIZE_BYTES, key, key_text
from frictid_hil.errors import HardwareError

_TIMEOUT_S = 2.0
_ACCEPTED = 0x60


def write(bus: can.BusABC, node: int, index: int, subindex: int, value: int) -> None:
    """One expedited SDO download.

    Raises:
        HardwareError: refused, or no answer.
    """
    address = key(index, subindex)
    size = next(
        SIZE_BYTES[entry.kind] for record in OBJECTS if record.index == index for entry in record.entries
        if entry.key == address
    )  # fmt: skip
    header = bytes([0x23 | (4 - size) << 2, index & 0xFF, index >> 8, subindex])
    data = header + (value & 0xFFFFFFFF).to_bytes(4, "little")
    bus.send(can.Message(arbitration_id=0x600 + node, data=data, is_extended_id=False))
    deadline_s = time.monotonic() + _TIMEOUT_S
    while (left_s := deadline_s - time.monotonic()) > 0:
        reply = bus.recv(left_s)
        if reply is not None and reply.arbitration_id == 0x580 + node and bytes(reply.data[1:4]) == header[1:]:
            if reply.data[0] == _ACCEPTED:
                return
            code = int.from_bytes(reply.data[4:8], "little")
            raise HardwareError(f"refused with {code:08X}h", where=f"node {node}, object {key_text(address)}")
    raise HardwareError("no answer", where=f"node {node}, object {key_text(address)}")
