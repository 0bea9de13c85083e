"""``nominal.yaml`` of an experiment set: what a simulator believes of one joint, and which recordings test it.

Only ``joint`` and ``experiments`` are required. People keep notes in these files, so keys that mean nothing here are
left alone - unless one looks like a misspelt key that is missing, which would quietly drop a belief.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from frictid_hil.config.schema import Numbers, Strict, as_tuple, validated
from frictid_hil.config.yaml import Document, KeyPath, read
from frictid_hil.errors import ConfigError, FieldProblem

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Open(Strict):
    """A section that may hold further keys."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True, allow_inf_nan=False)


class Friction(Open):
    """Either pairs of the sliding curve, or Coulomb level and viscosity."""

    velocity_rad_s: Numbers | None = None  # speeds of the pairs, positive
    torque_nm: Numbers | None = None  # friction at these speeds
    coulomb_nm: float | None = None  # level, in place of pairs
    viscous_nm_s_per_rad: float | None = None  # slope over speed, beside ``coulomb_nm``
    # slope of friction over position where friction passes zero; if not stated, what fits the recordings
    presliding_stiffness_nm_per_rad: Positive | None = None
    # ``at once`` as a spring that slips, ``gradually`` as Dahl's and the LuGre model; read off the recordings unless
    # stated
    presliding_yields: Literal["at once", "gradually"] | None = None

    @model_validator(mode="after")
    def _one_curve(self) -> Friction:
        if (self.velocity_rad_s is None) != (self.torque_nm is None):
            raise ValueError("velocity_rad_s and torque_nm belong together")
        if self.velocity_rad_s is not None and self.torque_nm is not None:
            if self.coulomb_nm is not None:
                raise ValueError("give pairs of velocity_rad_s and torque_nm, or coulomb_nm, not both")
            if len(self.velocity_rad_s) != len(self.torque_nm):
                raise ValueError(f"{len(self.velocity_rad_s)} velocities and {len(self.torque_nm)} torques")
            if len(self.velocity_rad_s) < 2:
                raise ValueError("a curve needs at least 2 pairs")
            if min(self.velocity_rad_s) <= 0 or len(set(self.velocity_rad_s)) != len(self.velocity_rad_s):
                raise ValueError("velocity_rad_s must be positive and each given once")
        return self


class Joint(Open):
    """``tau = inertia*acc + gravity_cos*cos(q) + gravity_sin*sin(q) + friction``; gravity_torque_nm is the cosine's."""

    # of the whole joint; 0 says that the logs contain it in ``rigid_body_torque_nm``
    inertia_kg_m2: NotNegative | None = None
    motor_inertia_share: float | None = Field(default=None, ge=0, le=1)  # part of the inertia in front of the gear
    gravity_torque_nm: float | None = None  # another name of ``gravity_cos_nm``
    gravity_cos_nm: float | None = None  # gravity torque at q = 0
    gravity_sin_nm: float | None = None  # gravity torque at q = 90 deg
    gear_ratio: Positive | None = None  # motor revolutions per joint revolution
    gear: str | None = None  # remark
    continuous: bool = False  # the joint turns without end
    friction: Friction | None = None  # the believed friction

    @model_validator(mode="after")
    def _one_cosine(self) -> Joint:
        if self.gravity_torque_nm is not None and self.gravity_cos_nm is not None:
            raise ValueError("gravity_torque_nm and gravity_cos_nm are two names of one figure")
        return self


class PayloadFile(Open):
    """What is mounted on the link where an experiment says so."""

    inertia_kg_m2: NotNegative | None = None  # that it adds
    gravity_torque_nm: float | None = None  # that it adds, at q = 0


class FeedForward(Strict):
    """What a controller adds along its command: ``inertia*acc + gravity(cmd) + coulomb*sign(v) + viscous*v``."""

    inertia_kg_m2: float = 0.0  # that multiplies the command's acceleration
    gravity_cos_nm: float = 0.0  # at the command's cosine
    gravity_sin_nm: float = 0.0  # at the command's sine
    coulomb_nm: float = 0.0  # in the direction of the command's velocity
    viscous_nm_s_per_rad: float = 0.0  # that multiplies the command's velocity


def _law(name: Any) -> Any:
    """Other names of the same laws."""
    plain = name.lower().replace("-", "_") if isinstance(name, str) else name
    return {"p_pi": "cascade", "p_pi_cascade": "cascade", "pd": "pid", "pid_feedforward": "pid"}.get(plain, plain)


class ControllerFile(Open):
    """The position loop: what law it follows, and its numbers.

    ``pid``: ``kp*e + integral(ki*e) + kd*(dcommand/dt - v)``. ``cascade``: ``kv*w + integral(ki*w)`` with ``w = kp*e +
    velocity_feedforward*dcommand/dt - v``. ``columns``: each log brings its demand as ``torque_demand_nm``.
    ``unknown``: like no controller at all.
    """

    type: Annotated[Literal["pid", "cascade", "columns", "unknown"], BeforeValidator(_law)] = "pid"  # the law
    rate_hz: Positive | None = None  # at which it is computed; ``pid`` and ``cascade`` need it
    kp: NotNegative | None = None  # gain of the position error
    ki: NotNegative | None = None  # gain of the integral
    kd: NotNegative | None = None  # gain of the velocity error, ``pid``
    kv: NotNegative | None = None  # gain of the inner loop, ``cascade``
    velocity_feedforward: NotNegative = 0.0  # share of the command's velocity, ``cascade``
    velocity_filter_s: NotNegative | None = None  # time constant of the low-pass on the velocity that it uses
    torque_limit_nm: Positive | None = None  # of its demand
    # that it uses: of the moment, or the difference of its last two positions; unless stated the recordings tell
    velocity: Literal["now", "difference"] | None = None
    command_rate: Literal["central", "backward"] | None = None  # difference of the command that makes dcommand/dt
    feedforward: FeedForward | None = None  # what it adds along its command

    @model_validator(mode="after")
    def _whole(self) -> ControllerFile:
        needed = {"pid": ("rate_hz", "kp"), "cascade": ("rate_hz", "kp", "kv")}.get(self.type, ())
        for name in needed:
            if getattr(self, name) is None:
                near = difflib.get_close_matches(name, self.model_extra or {}, n=1, cutoff=0.6)
                hint = f"; did you write it as {near[0]}?" if near else ""
                raise ValueError(f"{name}: missing in a controller of type {self.type}{hint}")
        if self.type == "cascade" and self.kd is not None:
            raise ValueError("a cascade has kp, kv and perhaps ki; kd belongs to type: pid")
        if self.type == "cascade" and self.ki and not (self.kp and self.kv):
            raise ValueError("ki: the integral of a cascade's inner loop needs a kp and a kv above 0")
        return self


class ReportFilter(Strict):
    """A low-pass that the drive's reported torque has passed."""

    order: Annotated[int, Field(ge=1, le=8)] = 1  # first-order lags in a row
    time_constant_s: NotNegative  # of each lag; 0 is no filter


class Drive(Open):
    """What the drive is known to do."""

    rated_torque_nm: Positive | None = None  # at the joint
    torque_quantum_nm: NotNegative | None = None  # step of the reported torque
    torque_delay_s: NotNegative | None = None  # from demand to torque
    current_lag_s: NotNegative | None = None  # time constant from demand to current
    torque_report_filter: ReportFilter | None = None  # low-pass on the reported torque
    torque_smoothed_hz: Positive | None = None  # low-pass, forwards and backwards, on the recorded torque


class Encoder(Open):
    """What the encoder is known to do."""

    side: str | None = None  # ``motor`` or ``link``
    resolution_rad: NotNegative | None = None  # its step, at the joint
    zero_offset_rad: float | None = None  # of its zero
    velocity_filter_s: NotNegative | None = None  # time constant of the low-pass on the reported velocity


REMARKS = ("law", "integral_starts_at", "note", "comment", "description", "side", "name")
"""Further keys of any section in which people and our own writers tell something that nothing reads."""
ABSOLUTE_ONLY = ("zero_offset_rad", "torque_delay_s", "current_lag_s", "velocity_filter_s")
"""Numbers whose usual value is 0, so that a share of them says nothing."""

Share = NotNegative | Literal["data_sheet", "cad", "profile"]
"""One-sigma over the number, or what the number was taken from."""


class Tolerance(Strict):
    """One-sigma beliefs: relative here, in the number's own unit under ``absolute``."""

    inertia_kg_m2: Share | None = None  # of the joint's inertia
    gravity_torque_nm: Share | None = None  # of the gravity torque
    friction_torque: Share | None = None  # of the whole friction curve
    viscous: Share | None = None  # of the part of friction that depends on speed
    presliding_stiffness: Share | None = None  # of the stiffness before friction slips
    torque_constant: Share | None = None  # of the torque that the drive reports
    controller_gains: Share | None = None  # of each gain
    rigid_body_torque: Share | None = None  # of the column that the logs bring
    # the same, and those of zero offset, delay, lag and filter, in N m, kg m2, rad and s
    absolute: Mapping[str, NotNegative] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known(self) -> Tolerance:
        known = {*ABSOLUTE_ONLY, *type(self).model_fields} - {"absolute"}
        for name in self.absolute:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                raise ValueError(f"absolute: unknown number {name}" + (f"; did you mean {near[0]}?" if near else ""))
        return self


class ExperimentFile(Open):
    """One recording."""

    name: str = Field(min_length=1)  # of the experiment
    file: str | None = None  # beside ``nominal.yaml``; the name with ``.csv`` unless given
    role: Literal["identification", "validation"] = "identification"  # whether it is fitted or judged on
    payload: bool = False  # whether the payload was mounted
    run_order: int | None = None  # place in the sequence, for effects of time
    duration_s: NotNegative | None = None  # remark


class NominalFile(Open):
    """What a simulator believes of one joint, and which recordings test it."""

    joint: Joint  # the rigid body and its friction
    payload: PayloadFile | None = None  # what some experiments mount
    controller: ControllerFile | None = None  # the position loop
    drive: Drive | None = None  # what is known of it
    encoder: Encoder | None = None  # what is known of it
    tolerance: Tolerance | None = None  # how sure the numbers are
    experiments: Annotated[tuple[ExperimentFile, ...], BeforeValidator(as_tuple)] = ()  # the recordings


@dataclass(frozen=True, slots=True)
class NominalSet:
    """A ``nominal.yaml``, read and checked; ``document.data`` is the plain mapping, further keys included."""

    file: NominalFile
    document: Document


def load_nominal(path: Path, *, logs: bool = True) -> NominalSet:
    """Read and check a ``nominal.yaml``, or that of a folder (``ConfigError``: every problem with its place)."""
    if path.is_dir():
        path = path / "nominal.yaml"
        if not path.exists():
            raise ConfigError("no nominal.yaml in this folder", where=str(path.parent), cause="not an experiment set")
    document = read(path)
    file = validated(document, NominalFile)
    misspelt = list(_misspelt(file, ()))
    if misspelt:
        raise document.error(misspelt, at_key=[problem.path for problem in misspelt])
    if logs and not file.experiments:
        raise document.error([FieldProblem(("experiments",), "missing: at least one log must be listed")])
    twice = list(_named_twice(file))
    if twice:
        raise document.error(twice)
    return NominalSet(file, document)


def further_keys(file: NominalFile) -> tuple[str, ...]:
    """Keys of joint, friction, payload, controller, drive and encoder that nothing reads, with their section.

    Remarks are for people.
    """
    sections = {name: getattr(file, name) for name in ("joint", "payload", "controller", "drive", "encoder")}
    sections["joint.friction"] = file.joint.friction
    told = {name: section.model_extra or {} for name, section in sections.items() if section}
    return tuple(f"{name}.{key}" for name, extra in told.items() for key in extra if key not in REMARKS)


def _misspelt(section: Any, path: KeyPath) -> Iterator[FieldProblem]:
    """Further keys that look like a known one which is missing."""
    if isinstance(section, tuple):
        for index, item in enumerate(section):
            yield from _misspelt(item, (*path, index))
    if not isinstance(section, Open):
        return
    absent = [name for name in type(section).model_fields if name not in section.model_fields_set]
    for key in section.model_extra or {}:
        near = difflib.get_close_matches(key, absent, n=1, cutoff=0.8)
        if near:
            yield FieldProblem((*path, key), f"unknown key; did you mean {near[0]}?")
    for name in section.model_fields_set & set(type(section).model_fields):
        yield from _misspelt(getattr(section, name), (*path, name))


def _named_twice(file: NominalFile) -> Iterator[FieldProblem]:
    seen: dict[str, int] = {}
    for index, experiment in enumerate(file.experiments):
        first = seen.setdefault(experiment.name, index)
        if first != index:
            yield FieldProblem(("experiments", index, "name"), f"{experiment.name!r} is also experiment {first}")
