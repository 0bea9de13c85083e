"""One geared joint as a value: what a robot file's ``simulated`` mapping says, checked.

torque = inertia * acceleration + gravity + friction, on the joint side of the gear; friction is a rate curve behind an
elasto-plastic presliding spring, and everything beyond that is an effect by name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from frictid_hil.errors import FieldProblem, IdentificationError, InvalidFields
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.fields import Fields

PRESLIDING_TRAVEL_RAD = 5e-4  # travel from rest to full sliding where a file gives no presliding stiffness


@dataclass(frozen=True, slots=True)
class CoulombViscous:
    """The simplest friction: a level and a slope."""

    coulomb_nm: float
    viscous_nm_s_per_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Payload:
    """What can be mounted on the link; added to its inertia and gravity."""

    inertia_kg_m2: float
    gravity_cos_nm: float


@dataclass(frozen=True, slots=True)
class Encoder:
    """Where the position comes from."""

    side: str = "motor"  # ``motor`` or ``link``
    counts_per_revolution: float = 131072.0  # of the shaft it sits on; 0 is continuous

    def step_rad(self, gear_ratio: float) -> float:
        """One count as an angle of the joint; 0 where continuous."""
        if self.counts_per_revolution <= 0:
            return 0.0
        return 2 * math.pi / self.counts_per_revolution / (gear_ratio if self.side == "motor" else 1.0)


@dataclass(frozen=True, slots=True)
class Drive:
    """The power stage and what it reports."""

    rated_torque_nm: float  # 1000 per mille, joint side
    torque_limit_nm: float  # the largest torque it gives, joint side
    torque_quantum_per_mille: float = 1.0  # step of the reported torque
    torque_noise_per_mille: float = 5.0  # standard deviation of the reported torque
    velocity_filter_s: float = 0.001  # first-order smoothing of differenced position, in its own loop and in its report
    torque_filter_s: float = 0.0  # first-order smoothing of the torque that a drive on a bus reports


@dataclass(frozen=True, slots=True)
class ServoGains:
    """The drive's position loop: kp * error + integral(ki * error) + kd * (velocity command - velocity)."""

    kp_nm_per_rad: float
    ki_nm_per_rad_s: float
    kd_nm_s_per_rad: float

    @staticmethod
    def for_inertia(inertia_kg_m2: float, bandwidth_rad_s: float = 100.0) -> ServoGains:
        """Well-damped gains for a rigid joint and about 2 ms of delay in the loop."""
        return ServoGains(
            kp_nm_per_rad=inertia_kg_m2 * bandwidth_rad_s**2,
            ki_nm_per_rad_s=inertia_kg_m2 * bandwidth_rad_s**3 / 5.0,
            kd_nm_s_per_rad=inertia_kg_m2 * bandwidth_rad_s * 1.6,
        )


@dataclass(frozen=True, slots=True)
class HandImpedance:
    """A person's arm that guides the joint: torque = stiffness * (q_hand - q) + damping * (dq_hand - dq)."""

    stiffness_nm_per_rad: float
    damping_nm_s_per_rad: float


class Simulated(Protocol):
    """What a robot file tells of a joint that is simulated."""

    @property
    def simulated(self) -> Mapping[str, Any]:
        """The mapping, as read from YAML."""

    @property
    def gear_ratio(self) -> float:
        """Motor revolutions per joint revolution."""

    @property
    def rated_torque_nm(self) -> float:
        """Joint side."""

    @property
    def max_torque_nm(self) -> float:
        """Limit of the joint."""


@dataclass(frozen=True, slots=True)
class JointModel:
    """One joint; see the module's first page. Built by ``from_mapping``."""

    inertia_kg_m2: float  # whole inertia, motor's part included, payload excluded
    motor_inertia_share: float  # the motor's part, 0..1
    gravity_cos_nm: float  # gravity = gravity_cos * cos(q) + gravity_sin * sin(q)
    gravity_sin_nm: float
    gear_ratio: float  # motor revolutions per joint revolution
    friction: FrictionCurve | CoulombViscous  # rate-dependent friction in steady sliding, before effects
    presliding_stiffness_nm_per_rad: float  # of the slip spring
    encoder: Encoder  # position sensor
    drive: Drive  # power stage
    servo: ServoGains  # gains of the drive's position loop
    payload: Payload | None = None  # mounted on request
    hand: HandImpedance | None = None  # the simulated person
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # parameters by effect name; complete

    @staticmethod
    def from_mapping(
        mapping: Mapping[str, Any], *, gear_ratio: float, rated_torque_nm: float, max_torque_nm: float
    ) -> JointModel:
        """The joint of a robot file's ``simulated`` mapping, whose ``servo`` may lower the drive's torque limit.

        Every unknown key or effect, missing or out-of-range value is told by an ``InvalidFields``, with its path.
        """
        top = Fields(mapping)
        inertia = top.number("inertia_kg_m2", low=1e-6, high=1e6)
        friction = _read_friction(top.part("friction"), required="friction" in top, top=top)
        level = friction.coulomb_nm
        encoder = top.part("encoder")
        drive, gains = Drive(rated_torque_nm, math.inf), ServoGains.for_inertia(inertia)
        model = JointModel(
            inertia_kg_m2=inertia,
            motor_inertia_share=top.number("motor_inertia_share", 0.3, low=0.01, high=0.99),
            gravity_cos_nm=top.number("gravity_cos_nm", 0.0, low=-1e6, high=1e6),
            gravity_sin_nm=top.number("gravity_sin_nm", 0.0, low=-1e6, high=1e6),
            gear_ratio=gear_ratio,
            friction=friction,
            presliding_stiffness_nm_per_rad=top.number(
                "presliding_stiffness_nm_per_rad", max(level, 1e-3) / PRESLIDING_TRAVEL_RAD, low=1e-3, high=1e9
            ),
            encoder=Encoder(encoder.choice("side", "motor", ("motor", "link")), **_numbers(encoder, _ENCODER, _COUNTS)),
            drive=replace(drive, **_numbers(top.part("drive"), _DRIVE, asdict(drive))),
            servo=gains,
            payload=Payload(**_numbers(top.part("payload"), _PAYLOAD)) if "payload" in top else None,
            hand=HandImpedance(**_numbers(top.part("hand"), _HAND)) if "hand" in top else None,
            effects=_read_effects(top.part("effects")),
        )
        limits = {**_SERVO, "torque_limit_nm": (0.0, max_torque_nm * (1 + 1e-9))}
        servo = _numbers(top.part("servo"), limits, {**asdict(gains), "torque_limit_nm": max_torque_nm})
        top.part("payload"), top.part("hand")
        top.no_others()
        top.finish()
        drive = replace(model.drive, torque_limit_nm=servo.pop("torque_limit_nm"))
        return replace(model, servo=ServoGains(**servo), drive=drive)

    @staticmethod
    def of(joint: Simulated, name: str) -> JointModel:
        """The simulated joint of a robot file or driver; ``InvalidFields`` by ``joints.NAME.simulated.KEY``."""
        try:
            return JointModel.from_mapping(
                joint.simulated,
                gear_ratio=joint.gear_ratio,
                rated_torque_nm=joint.rated_torque_nm,
                max_torque_nm=joint.max_torque_nm,
            )
        except InvalidFields as error:
            place = ("joints", name, "simulated")
            raise InvalidFields([FieldProblem((*place, *p.path), p.message) for p in error.problems]) from None

    def to_mapping(self) -> dict[str, Any]:
        """The robot file's ``simulated`` form: plain values; ``from_mapping`` of it gives an equal joint."""
        mapping: dict[str, Any] = {
            "inertia_kg_m2": self.inertia_kg_m2,
            "motor_inertia_share": self.motor_inertia_share,
            "gravity_cos_nm": self.gravity_cos_nm,
            "gravity_sin_nm": self.gravity_sin_nm,
            "friction": {n: list(v) if isinstance(v, tuple) else v for n, v in asdict(self.friction).items()},
            "presliding_stiffness_nm_per_rad": self.presliding_stiffness_nm_per_rad,
        }
        if self.payload is not None:
            mapping["payload"] = asdict(self.payload)
        mapping["encoder"] = asdict(self.encoder)
        mapping["drive"] = {name: getattr(self.drive, name) for name in _DRIVE}
        mapping["servo"] = {**asdict(self.servo), "torque_limit_nm": self.drive.torque_limit_nm}
        if self.hand is not None:
            mapping["hand"] = asdict(self.hand)
        mapping["effects"] = {name: dict(parameters) for name, parameters in self.effects.items()}
        return mapping

    def with_effects(self, effects: Mapping[str, Mapping[str, float]]) -> JointModel:
        """The same joint with these effects alone; ``InvalidFields`` for what is unknown or out of bounds."""
        fields = Fields(effects, ("effects",))
        complete = _read_effects(fields)
        fields.finish()
        return replace(self, effects=complete)


def _read_friction(fields: Fields, *, required: bool, top: Fields) -> FrictionCurve | CoulombViscous:
    if not required:
        top.problem("friction", "is required: coulomb_nm and viscous_nm_s_per_rad, or velocity_rad_s and torque_nm")
        return CoulombViscous(0.0)
    if "velocity_rad_s" not in fields and "torque_nm" not in fields:
        return CoulombViscous(**_numbers(fields, _FRICTION, {"viscous_nm_s_per_rad": 0.0}))
    velocity, torque = fields.numbers("velocity_rad_s"), fields.numbers("torque_nm")
    fields.no_others()
    if velocity and torque:
        try:
            return FrictionCurve.through(np.array(velocity), np.array(torque))
        except IdentificationError as error:
            fields.problem("velocity_rad_s", error.what)
    return CoulombViscous(0.0)


_Bounds = Mapping[str, tuple[float, float]]
_FRICTION: _Bounds = {"coulomb_nm": (0.0, 1e6), "viscous_nm_s_per_rad": (0.0, 1e6)}
_ENCODER: _Bounds = {"counts_per_revolution": (0.0, 1e12)}
_COUNTS = asdict(Encoder())
_DRIVE: _Bounds = {
    "torque_quantum_per_mille": (0.0, 1000.0),
    "torque_noise_per_mille": (0.0, 1000.0),
    "velocity_filter_s": (0.0, 1.0),
    "torque_filter_s": (0.0, 1.0),
}
_SERVO: _Bounds = {"kp_nm_per_rad": (0.0, 1e9), "ki_nm_per_rad_s": (0.0, 1e12), "kd_nm_s_per_rad": (0.0, 1e9)}
_PAYLOAD: _Bounds = {"inertia_kg_m2": (0.0, 1e6), "gravity_cos_nm": (-1e6, 1e6)}
_HAND: _Bounds = {"stiffness_nm_per_rad": (0.0, 1e6), "damping_nm_s_per_rad": (0.0, 1e6)}


def _numbers(fields: Fields, bounds: _Bounds, defaults: Mapping[str, Any] | None = None) -> dict[str, float]:
    """A part of the joint that holds numbers; those without a default are required."""
    told = {n: fields.number(n, (defaults or {}).get(n), low=low, high=high) for n, (low, high) in bounds.items()}
    fields.no_others()
    return told


def _read_effects(fields: Fields) -> dict[str, dict[str, float]]:
    known = all_effects()
    effects: dict[str, dict[str, float]] = {}
    for name in fields.keys():  # noqa: SIM118 - Fields is no mapping
        effect = known.get(name)
        if effect is None:
            fields.problem(name, f"is no known effect; known are {', '.join(known)}")
            continue
        part = fields.part(name)
        off = effect.off
        effects[name] = {p.name: part.number(p.name, off[p.name], low=p.lower, high=p.upper) for p in effect.parameters}
        part.no_others()
    return effects
