"""Another author's CANopen on a real SocketCAN link; runs inside ``kernel_with_can``, as root, on ``vcan0``.

The node is built on `durand`, in a process of its own, as in ``strangers``; each frame is answered before the next one
is sent, so that the stalls of this kernel change no figure. Written to ``found.json`` in the folder, by family.

    python benchmarks/kernel_with_can.py benchmarks/socketcan_strangers.py FOLDER
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import strangers

FAMILIES = ("elmo", "nanotec")
"""All would take this kernel a quarter of an hour."""


def main() -> dict[str, Any]:
    """`check` and `calibrate` of each family."""
    found = {}
    with tempfile.TemporaryDirectory() as home:
        strangers.register(Path(home))
        for family in FAMILIES:
            place = Path(home) / family
            place.mkdir()
            one = strangers.calibrated(place, family, strangers.SOCKETCAN)
            ended = {"outcome": one.run["outcome"], "error": one.run.get("error"), "surprises": one.surprises}
            found[family] = {**ended, "check": one.check["ok"], "good": one.good, "off_percent": one.off_percent}
            print(family, found[family], flush=True)
    return found


if __name__ == "__main__":
    (Path(sys.argv[1]) / "found.json").write_text(json.dumps(main(), indent=1))
