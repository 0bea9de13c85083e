"""Three units of every servo family, calibrated and then compensated on the tracking test.

    python benchmarks/servo_compensation.py               all families (3 min)
    python benchmarks/servo_compensation.py dynamixel     this

Units are those of ``drive_families``. Servos that take positions only are compensated by moving their goal, those that
take currents also in torque mode. Promised is that no run is stopped and that every mode follows better than none.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drive_families import SERVOS, UNITS, found, robot_file

from frictid_drivers.servos.models import MODELS
from frictid_hil.config.profile import LOOP_STIFFNESS, load_profile
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.wanted import MODES, Wanted
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.mode import Mode


def tracked(folder: Path, family: str, unit: int, mode: Mode) -> dict[str, Any]:
    """The tracking test of a unit that ``found`` has calibrated."""
    path, profile = folder / f"{family} {unit}.yaml", folder / f"{family} {unit} run" / "profile.yaml"
    wanted = Wanted("track", drive_mode=mode, duration_s=6.0)
    out = folder / f"{family} {unit} {mode.name}"
    return compensate(CompensateOptions(str(path), profile, "0", wanted, seed=unit, out=out), Silent()).to_json()


def main(families: Sequence[str]) -> int:
    """Print a line per unit and drive mode; 1 where one fails."""
    os.environ.setdefault("XDG_STATE_HOME", tempfile.mkdtemp())
    good = True
    print(f"{'family':16} unit drive mode  spring N m/rad  " + "  ".join(f"{mode:>13}" for mode in MODES[1:]))
    for family in families or SERVOS:
        for unit in UNITS:
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                robot_file(folder, family, unit)
                good &= found(folder, family, unit).outcome == "ok"
                entry = load_profile(folder / f"{family} {unit} run" / "profile.yaml").joint("0")
                takes_currents = MODELS[SERVOS[family]].registers.goal_current
                for mode in (Mode.POSITION, Mode.TORQUE) if takes_currents else (Mode.POSITION,):
                    result = tracked(folder, family, unit, mode)
                    less = [result["modes"].get(one, {}).get("reduction_percent") or 0.0 for one in MODES[1:]]
                    good &= result["outcome"] == "ok" and min(less) > 0.0
                    told = "  ".join(f"{percent:11.1f} %" for percent in less)
                    print(f"{family:16} {unit:4} {mode.name.lower():10}  {entry.quality[LOOP_STIFFNESS]:14.1f}  {told}")
    return int(not good)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
