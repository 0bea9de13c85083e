"""What a simulator believes of a robot's joint, as the ``nominal.yaml`` of an experiment set.

The belief is the robot file's ``simulated`` joint without its effects, overruled by what a friction profile measured.
What neither says is left out; the diagnosis then says what it cannot conclude.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from frictid_hil.config.profile import JointProfile
from frictid_hil.gap.tolerances import stated_by
from frictid_hil.plan.setup import JointSetup
from frictid_hil.simulation.joint import CoulombViscous, JointModel

SIMULATED_CONTROL_HZ = 1000  # rate of the position loop inside a simulated drive
_PLAIN = ("inertia_kg_m2", "motor_inertia_share", "gravity_cos_nm", "gravity_sin_nm", "gear_ratio")
"""Keys of ``joint`` that the simulated joint has under the same names."""


@dataclass(frozen=True, slots=True)
class Belief:
    """Sections of ``nominal.yaml`` as far as they are known, and where they come from."""

    sections: Mapping[str, Any]
    sources: tuple[str, ...]

    @property
    def payload(self) -> bool:
        """True where a payload is known, so that experiments with it can be judged."""
        return "payload" in self.sections


def belief_of(
    joint: JointSetup, profile: JointProfile | None, *, profile_name: str = "", simulated_drive: bool = False
) -> Belief:
    """What is believed of a joint before its logs are looked at (``InvalidFields``: a wrong ``simulated`` mapping)."""
    sections: dict[str, Any] = {"joint": {"gear_ratio": joint.gear_ratio}}
    sources: list[str] = []
    if joint.simulated:
        sections = _of_model(JointModel.of(joint, joint.name), simulated_drive=simulated_drive)
        sources.append("robot file, `simulated` without its effects")
    if profile is not None:
        sections["joint"] = {**sections["joint"], **measured_by(profile)}
        sections["tolerance"] = stated_by(profile)
        sources.append(f"profile {profile_name}".strip())
    sections.setdefault("drive", {})["rated_torque_nm"] = joint.rated_torque_nm
    return Belief(sections, tuple(sources))


def read_back(sections: Mapping[str, Any], identity: Mapping[str, Any]) -> dict[str, Any]:
    """The sections with what the drive itself says of its torque and its encoder (fields of ``JointIdentity``)."""
    drive, encoder = dict(sections.get("drive", {})), dict(sections.get("encoder", {}))
    for section, key, value in (
        (drive, "rated_torque_nm", identity.get("rated_torque_nm")),
        (drive, "torque_quantum_nm", identity.get("torque_resolution_nm")),
        (encoder, "resolution_rad", identity.get("position_resolution_rad")),
    ):
        if value is not None and math.isfinite(value) and value > 0.0:
            section[key] = value
    return {**sections, "drive": drive, **({"encoder": encoder} if encoder else {})}


def _of_model(model: JointModel, *, simulated_drive: bool) -> dict[str, Any]:
    if isinstance(model.friction, CoulombViscous):
        friction: dict[str, Any] = asdict(model.friction)
    else:
        friction = {name: list(getattr(model.friction, name)) for name in ("velocity_rad_s", "torque_nm")}
    friction["presliding_stiffness_nm_per_rad"] = model.presliding_stiffness_nm_per_rad
    sections: dict[str, Any] = {
        "joint": {
            **{name: getattr(model, name) for name in _PLAIN},
            "friction": friction,
        },
        "drive": {
            "rated_torque_nm": model.drive.rated_torque_nm,
            "torque_quantum_nm": model.drive.torque_quantum_per_mille * 1e-3 * model.drive.rated_torque_nm,
        },
        "encoder": {
            "side": model.encoder.side,
            "resolution_rad": model.encoder.step_rad(model.gear_ratio),
            "velocity_filter_s": model.drive.velocity_filter_s,
        },
    }
    if model.payload is not None:
        sections["payload"] = {
            "inertia_kg_m2": model.payload.inertia_kg_m2,
            "gravity_torque_nm": model.payload.gravity_cos_nm,
        }
    if simulated_drive:
        sections["controller"] = {
            "type": "pid",
            "rate_hz": SIMULATED_CONTROL_HZ,
            "kp": model.servo.kp_nm_per_rad,
            "ki": model.servo.ki_nm_per_rad_s,
            "kd": model.servo.kd_nm_s_per_rad,
            "velocity_filter_s": model.drive.velocity_filter_s,
            "torque_limit_nm": model.drive.torque_limit_nm,
            "law": "kp*(cmd-q) + integral(ki*(cmd-q)) + kd*(d cmd/dt - filtered v)",
            # A drive in cyclic position mode knows only the set-points that have come.
            "command_rate": "backward",
            "integral_starts_at": "static holding torque; frozen while the limit is active",
        }
    return sections


def measured_by(profile: JointProfile) -> dict[str, Any]:
    """``joint`` of ``nominal.yaml`` as far as a profile knows it."""
    friction: dict[str, Any] = {
        "velocity_rad_s": list(profile.velocity_rad_s),
        "torque_nm": list(profile.torque_nm),
    }
    if profile.presliding_stiffness_nm_per_rad.value is not None and profile.presliding_yields != "unseen":
        friction["presliding_stiffness_nm_per_rad"] = profile.presliding_stiffness_nm_per_rad.value
        if profile.presliding_yields == "gradually":
            friction["presliding_yields"] = profile.presliding_yields
    values = {name: getattr(profile, name).value for name in ("inertia_kg_m2", "gravity_cos_nm", "gravity_sin_nm")}
    return {name: value for name, value in values.items() if value is not None} | {"friction": friction}
