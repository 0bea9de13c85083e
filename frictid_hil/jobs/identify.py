"""``frictid-hil identify``: the same mathematics on recorded data as on a live run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictid_hil.config.profile import Estimate, JointProfile, PairList, ProcedureUsed
from frictid_hil.driver import JointSetup
from frictid_hil.errors import IdentificationError
from frictid_hil.friction.identify import function_a
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.recording.samples import Mark, Samples


def identify_joint(samples: Samples, joint: JointSetup | None, *, method: str, late_cycles: int = 0) -> JointProfile:
    where = f"joint {samples.joint}"
    (mark,) = samples.marked("cycles")
    cycles = samples.during(mark)
    procedure = procedure_of(mark)
    pairs = function_a((cycles.time_ns - mark.start_ns) * 1e-9, cycles.velocity_rad_s, cycles.torque_nm, procedure, where=where)
    curve = pairs.curve(where=where)
    return JointProfile(
        method="function-a",
        velocity_rad_s=curve.velocity_rad_s,
        torque_nm=curve.torque_nm,
        coulomb_nm=Estimate(value=curve.coulomb_nm),
        torque_source=str(samples.meta.get("torque_source", "")),
        procedure=ProcedureUsed(
            amplitude_rad=procedure.amplitude_rad,
            velocity_rad_s=procedure.velocity_rad_s,
            cycles=procedure.cycles,
            ratio=procedure.ratio,
        ),
    )


def procedure_of(mark: Mark) -> Procedure:
    d = mark.details
    return Procedure(d["amplitude_rad"], d["velocity_rad_s"], int(d["cycles"]), d["ratio"])


def joint_result(profile: JointProfile) -> dict[str, Any]:
    """A joint's entry in the JSON."""
    return {
        "outcome": "ok" if all(gate.passed for gate in profile.gates) else "gate_failed",
        "velocity_rad_s": list(profile.velocity_rad_s),
        "torque_nm": list(profile.torque_nm),
        "coulomb_nm": profile.coulomb_nm.value,
        "inertia_kg_m2": profile.inertia_kg_m2.value,
        "prismatic": profile.prismatic,
        "remarks": [gate.message for gate in profile.gates if not gate.passed],
    }
