"""An experiment set: what a simulator believes of one joint, and recordings of the real one.

A folder holds ``nominal.yaml`` and one CSV per experiment (gzip too). Only ``joint`` and ``experiments`` are required
there, only ``time_s``, ``position_rad`` and one of torque and command in a log; what is absent is None here, and the
diagnosis says what it cannot conclude without it.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config import nominal as config
from frictid_hil.config.nominal import NominalFile, load_nominal
from frictid_hil.errors import ConfigError, InputFileError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.recording.csv import read_csv
from frictid_hil.recording.samples import Samples
from frictid_hil.simulation.effects import all_effects

MAX_ROWS = 2_000_000
"""Rows of one log that are read; a longer one is refused with advice, not quietly cut."""


@dataclass(frozen=True, slots=True)
class Controller:
    """The digital position loop: ``kp*e + integral(ki*e) + kd*(dcommand/dt - filtered velocity)``, joint side.

    Attributes:
        rate_hz: control rate.
        kp_nm_per_rad: proportional gain.
        ki_nm_per_rad_s: integral gain; the integral freezes while the limit is active.
        kd_nm_s_per_rad: gain on the velocity error.
        velocity_filter_s: time constant of the velocity's first-order filter.
        torque_limit_nm: limit of the demand.
        command_rate: how dcommand/dt is formed, ``central`` or ``backward`` (a drive that follows set-points as they
            come).
    """

    rate_hz: float
    kp_nm_per_rad: float
    ki_nm_per_rad_s: float
    kd_nm_s_per_rad: float
    velocity_filter_s: float = 0.0
    torque_limit_nm: float = float("inf")
    command_rate: str = "central"


@dataclass(frozen=True, slots=True)
class Payload:
    """A body mounted on the link for some experiments."""

    inertia_kg_m2: float
    gravity_cos_nm: float


@dataclass(frozen=True, slots=True)
class Nominal:
    """What the simulator believes. None: it does not say.

    Attributes:
        inertia_kg_m2: of the whole joint, motor included.
        motor_inertia_share: motor's part of it, 0..1.
        gravity_cos_nm: gravity torque is ``gravity_cos*cos(q) + gravity_sin*sin(q)``.
        gravity_sin_nm: see there.
        gear_ratio: motor turns per joint turn.
        curve: friction over speed.
        presliding_stiffness_nm_per_rad: of the friction's spring before it slips.
        payload: what is mounted where an experiment says so.
        controller: of the position loop.
        rated_torque_nm: of the drive, joint side.
        torque_quantum_nm: step of the reported torque.
        believed_effects: what the file already says of the drive (its delay, its current loop), as effects by name.
        encoder_resolution_rad: step of the reported position, joint side.
        velocity_filter_s: known time constant of the reported velocity.
        document: the whole file, for writing an improved one.
    """

    inertia_kg_m2: float | None = None
    motor_inertia_share: float | None = None
    gravity_cos_nm: float = 0.0
    gravity_sin_nm: float = 0.0
    gear_ratio: float | None = None
    curve: FrictionCurve | None = None
    presliding_stiffness_nm_per_rad: float | None = None
    payload: Payload | None = None
    controller: Controller | None = None
    rated_torque_nm: float | None = None
    torque_quantum_nm: float | None = None
    believed_effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    encoder_resolution_rad: float | None = None
    velocity_filter_s: float = 0.0
    document: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Experiment:
    """One recording with its part in the diagnosis; columns have shape (n,), absent ones are None.

    Attributes:
        name: of the experiment.
        validation: judged on, never fitted.
        payload: the payload was mounted.
        run_order: place in time among the experiments (temperature carries over).
        time_s: strictly increasing.
        position_rad: measured.
        velocity_rad_s: the drive's own.
        torque_nm: the drive's own.
        position_command_rad: commanded.
        rigid_body_torque_nm: the part that the user's own rigid-body model explains.
        temperature_c: of motor or gear.
    """

    name: str
    validation: bool
    payload: bool
    run_order: int
    time_s: Array
    position_rad: Array
    velocity_rad_s: Array | None = None
    torque_nm: Array | None = None
    position_command_rad: Array | None = None
    rigid_body_torque_nm: Array | None = None
    temperature_c: Array | None = None


@dataclass(frozen=True, slots=True)
class ExperimentSet:
    """Nominal joint and its experiments, in run order."""

    name: str
    nominal: Nominal
    experiments: tuple[Experiment, ...]

    @staticmethod
    def load(folder: Path) -> ExperimentSet:
        """Read a folder.

        Raises:
            ConfigError: nominal.yaml is missing or wrong.
            InputFileError: a log is missing, unreadable or unusable; the message names file, column and row.
        """
        told = load_nominal(folder / "nominal.yaml")
        where = str(folder / "nominal.yaml")
        experiments = [_experiment(folder, entry, index) for index, entry in enumerate(told.file.experiments)]
        return ExperimentSet(
            str(told.document.data.get("case", folder.name)),
            _nominal(told.file, told.document.data, where),
            tuple(sorted(experiments, key=lambda e: e.run_order)),
        )


def _nominal(file: NominalFile, document: Mapping[str, Any], where: str) -> Nominal:
    """The belief of a checked file."""
    joint, drive, encoder = file.joint, file.drive, file.encoder
    gravity_cos = joint.gravity_torque_nm if joint.gravity_torque_nm is not None else joint.gravity_cos_nm
    return Nominal(
        inertia_kg_m2=joint.inertia_kg_m2,
        motor_inertia_share=joint.motor_inertia_share,
        gravity_cos_nm=gravity_cos or 0.0,
        gravity_sin_nm=joint.gravity_sin_nm or 0.0,
        gear_ratio=joint.gear_ratio,
        curve=_curve(joint.friction, where),
        presliding_stiffness_nm_per_rad=joint.friction.presliding_stiffness_nm_per_rad if joint.friction else None,
        payload=None
        if file.payload is None
        else Payload(file.payload.inertia_kg_m2 or 0.0, file.payload.gravity_torque_nm or 0.0),
        controller=None if file.controller is None else _controller(file.controller),
        rated_torque_nm=drive.rated_torque_nm if drive else None,
        torque_quantum_nm=drive.torque_quantum_nm if drive else None,
        believed_effects=_believed_effects(document.get("drive") or {}),
        encoder_resolution_rad=encoder.resolution_rad if encoder else None,
        velocity_filter_s=(encoder.velocity_filter_s if encoder else None) or 0.0,
        document=document,
    )


def _controller(told: config.Controller) -> Controller:
    return Controller(
        rate_hz=told.rate_hz,
        kp_nm_per_rad=told.kp,
        ki_nm_per_rad_s=told.ki or 0.0,
        kd_nm_s_per_rad=told.kd or 0.0,
        velocity_filter_s=told.velocity_filter_s or 0.0,
        torque_limit_nm=told.torque_limit_nm or float("inf"),
        command_rate=told.command_rate or "central",
    )


def _believed_effects(drive: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    found = {}
    for name, effect in all_effects().items():
        form = effect.actuation
        value = drive.get(form.believed_as) if form is not None and form.believed_as else None
        if form is not None and value:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ConfigError(f"drive.{form.believed_as} must be a number, found {value!r}")
            found[name] = {form.parameter: float(value)}
    return found


def _curve(friction: config.Friction | None, where: str) -> FrictionCurve | None:
    if friction is None:
        return None
    if friction.velocity_rad_s is not None and friction.torque_nm is not None:
        return FrictionCurve.through(np.array(friction.velocity_rad_s), np.array(friction.torque_nm), where=where)
    if friction.coulomb_nm is None:
        return None
    speeds = np.array([1.0, 2.0])
    viscous = friction.viscous_nm_s_per_rad or 0.0
    return FrictionCurve.through(speeds, friction.coulomb_nm + viscous * speeds, where=where)


def _experiment(folder: Path, told: config.Experiment, index: int) -> Experiment:
    path = folder / (told.file or f"{told.name}.csv")
    if not path.exists() and path.with_name(path.name + ".gz").exists():
        path = path.with_name(path.name + ".gz")
    if not path.exists():
        raise InputFileError("no such log", where=str(path), next_step="correct `file` in nominal.yaml")
    samples = read_log(path)
    return Experiment(
        name=told.name,
        validation=told.role == "validation",
        payload=told.payload,
        run_order=index if told.run_order is None else told.run_order,
        time_s=samples.time_s,
        position_rad=samples.position_rad,
        velocity_rad_s=samples.velocity_rad_s,
        torque_nm=samples.torque_nm,
        position_command_rad=samples.position_command_rad,
        rigid_body_torque_nm=samples.rigid_body_torque_nm,
        temperature_c=samples.temperature_c,
    )


def read_log(path: Path) -> Samples:
    """One CSV log, checked as every recording is.

    Raises:
        InputFileError: see ``ExperimentSet.load``.
    """
    # Checked before anything is parsed: ten million rows take minutes and gigabytes, and tell no more than a tenth.
    opener = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rb") as binary:
            rows = sum(block.count(b"\n") for block in iter(lambda: binary.read(1 << 20), b""))
    except (OSError, EOFError, zlib.error) as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from error
    if rows > MAX_ROWS + 1:
        raise InputFileError(
            f"{rows - 1} rows; at most {MAX_ROWS} are read",
            where=str(path),
            next_step="cut the recording or thin it to 500 Hz",
        )
    (samples,) = read_csv(path)
    return samples
