"""An experiment set: what a simulator believes of one joint, and recordings of the real one.

A folder holds ``nominal.yaml`` and one CSV per experiment (gzip too). Only ``joint`` and ``experiments`` are required
there, only ``time_s``, ``position_rad`` and one of torque and command in a log; what is absent is None here, and the
diagnosis says what it cannot conclude without it.
"""

from __future__ import annotations

import gzip
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.errors import ConfigError, InputFileError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effects import all_effects

MAX_ROWS = 2_000_000
"""Rows of one log that are read; a longer one is refused with advice, not quietly cut."""

COLUMNS = (
    "time_s",
    "position_rad",
    "velocity_rad_s",
    "torque_nm",
    "position_command_rad",
    "rigid_body_torque_nm",
    "external_torque_nm",
    "temperature_c",
)


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
        path = folder / "nominal.yaml"
        document = _read_yaml(path)
        nominal = nominal_from_mapping(document, str(path))
        listed = document.get("experiments")
        if not isinstance(listed, list) or not listed:
            raise ConfigError("no `experiments` listed", where=str(path))
        experiments = [_experiment(folder, entry, index, str(path)) for index, entry in enumerate(listed)]
        names = [e.name for e in experiments]
        if len(set(names)) != len(names):
            raise ConfigError("two experiments have the same name", where=str(path))
        return ExperimentSet(
            str(document.get("case", folder.name)), nominal, tuple(sorted(experiments, key=lambda e: e.run_order))
        )


def nominal_from_mapping(document: Mapping[str, Any], where: str) -> Nominal:
    """The nominal joint of an already parsed nominal.yaml.

    Raises:
        ConfigError: a figure is missing or no number.
    """
    joint = _section(document, "joint", where)
    if joint is None:
        raise ConfigError("no `joint` section", where=where)
    number = _Numbers(where)
    friction = _section(joint, "friction", where) or {}
    controller = _section(document, "controller", where)
    payload = _section(document, "payload", where)
    drive = _section(document, "drive", where) or {}
    encoder = _section(document, "encoder", where) or {}
    gravity_cos = number.optional(joint, "gravity_torque_nm")
    if gravity_cos is None:
        gravity_cos = number.optional(joint, "gravity_cos_nm") or 0.0
    return Nominal(
        inertia_kg_m2=number.optional(joint, "inertia_kg_m2"),
        motor_inertia_share=number.optional(joint, "motor_inertia_share"),
        gravity_cos_nm=gravity_cos,
        gravity_sin_nm=number.optional(joint, "gravity_sin_nm") or 0.0,
        gear_ratio=number.optional(joint, "gear_ratio"),
        curve=_curve(friction, number, where),
        presliding_stiffness_nm_per_rad=number.optional(friction, "presliding_stiffness_nm_per_rad"),
        payload=None
        if payload is None
        else Payload(
            number.optional(payload, "inertia_kg_m2") or 0.0, number.optional(payload, "gravity_torque_nm") or 0.0
        ),
        controller=None
        if controller is None
        else Controller(
            rate_hz=number.required(controller, "rate_hz"),
            kp_nm_per_rad=number.required(controller, "kp"),
            ki_nm_per_rad_s=number.optional(controller, "ki") or 0.0,
            kd_nm_s_per_rad=number.optional(controller, "kd") or 0.0,
            velocity_filter_s=number.optional(controller, "velocity_filter_s") or 0.0,
            torque_limit_nm=number.optional(controller, "torque_limit_nm") or float("inf"),
            command_rate=_command_rate(controller, where),
        ),
        rated_torque_nm=number.optional(drive, "rated_torque_nm"),
        torque_quantum_nm=number.optional(drive, "torque_quantum_nm"),
        believed_effects=_believed_effects(drive, number),
        encoder_resolution_rad=number.optional(encoder, "resolution_rad"),
        velocity_filter_s=number.optional(encoder, "velocity_filter_s") or 0.0,
        document=document,
    )


class _Numbers:
    """Reads numbers of a mapping, and says where one is wrong."""

    def __init__(self, where: str) -> None:
        self._where = where

    def optional(self, mapping: Mapping[str, Any], key: str) -> float | None:
        value = mapping.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise ConfigError(f"`{key}` must be a finite number, found {value!r}", where=self._where)
        return float(value)

    def required(self, mapping: Mapping[str, Any], key: str) -> float:
        value = self.optional(mapping, key)
        if value is None:
            raise ConfigError(f"`{key}` is missing", where=self._where)
        return value


def _believed_effects(drive: Mapping[str, Any], number: _Numbers) -> dict[str, dict[str, float]]:
    found = {}
    for name, effect in all_effects().items():
        form = effect.actuation
        if form is not None and form.believed_as and (value := number.optional(drive, form.believed_as)):
            found[name] = {form.parameter: value}
    return found


def _command_rate(controller: Mapping[str, Any], where: str) -> str:
    value = controller.get("command_rate", "central")
    if value not in ("central", "backward"):
        raise ConfigError(f"`command_rate` is {value!r}; it is central or backward", where=where)
    return str(value)


def _section(document: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any] | None:
    value = document.get(key)
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise ConfigError(f"`{key}` must be a mapping", where=where)
    return value


def _curve(friction: Mapping[str, Any], number: _Numbers, where: str) -> FrictionCurve | None:
    speeds, torques = friction.get("velocity_rad_s"), friction.get("torque_nm")
    if speeds is not None and torques is not None:
        try:
            return FrictionCurve.through(
                np.asarray(speeds, dtype=np.float64), np.asarray(torques, dtype=np.float64), where=where
            )
        except (TypeError, ValueError) as error:
            raise ConfigError(f"the friction curve is not two lists of numbers: {error}", where=where) from error
    coulomb = number.optional(friction, "coulomb_nm")
    if coulomb is None:
        return None
    viscous = number.optional(friction, "viscous_nm_s_per_rad") or 0.0
    return FrictionCurve.through(np.array([1.0, 2.0]), coulomb + viscous * np.array([1.0, 2.0]), where=where)


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(
            "no such file", where=str(path), next_step="give a folder with nominal.yaml and its logs"
        ) from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path)) from error
    if not isinstance(document, Mapping):
        raise ConfigError("must be a mapping with `joint` and `experiments`", where=str(path))
    return document


def _experiment(folder: Path, entry: Any, index: int, where: str) -> Experiment:
    if not isinstance(entry, Mapping) or "name" not in entry:
        raise ConfigError(f"experiments[{index}] must be a mapping with `name` and `role`", where=where)
    name = str(entry["name"])
    role = str(entry.get("role", "identification"))
    if role not in ("identification", "validation"):
        raise ConfigError(f"experiment {name}: role is {role!r}; it is identification or validation", where=where)
    path = folder / str(entry.get("file", f"{name}.csv"))
    if not path.exists() and path.with_name(path.name + ".gz").exists():
        path = path.with_name(path.name + ".gz")
    columns = read_log(path)
    return Experiment(
        name=name,
        validation=role == "validation",
        payload=bool(entry.get("payload", False)),
        run_order=int(entry.get("run_order", index)),
        time_s=columns["time_s"],
        position_rad=columns["position_rad"],
        velocity_rad_s=columns.get("velocity_rad_s"),
        torque_nm=columns.get("torque_nm"),
        position_command_rad=columns.get("position_command_rad"),
        rigid_body_torque_nm=columns.get("rigid_body_torque_nm"),
        temperature_c=columns.get("temperature_c"),
    )


def read_log(path: Path) -> dict[str, Array]:
    """The known columns of one CSV log, checked.

    Raises:
        InputFileError: see ``ExperimentSet.load``.
    """
    where = str(path)
    opener = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rb") as binary:
            rows = sum(block.count(b"\n") for block in iter(lambda: binary.read(1 << 20), b""))
        if rows > MAX_ROWS + 1:
            raise InputFileError(
                f"{rows - 1} rows; at most {MAX_ROWS} are read",
                where=where,
                next_step="cut the recording or thin it to 500 Hz",
            )
        with opener(path, "rt", encoding="utf-8", newline="") as file:
            header = [name.strip() for name in file.readline().lstrip("\ufeff").split(",")]
            with warnings.catch_warnings():
                # An empty table is reported below, in our own words.
                warnings.simplefilter("ignore", UserWarning)
                table = np.loadtxt(file, delimiter=",", ndmin=2)
    except FileNotFoundError as error:
        raise InputFileError("no such log", where=where, next_step="correct `file` in nominal.yaml") from error
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as error:
        raise InputFileError(f"cannot be read: {error}", where=where) from error
    except ValueError as error:
        raise (_first_bad_cell(path) or InputFileError(f"cannot be read: {error}", where=where)) from error
    columns = {name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(header[: table.shape[1]])}
    _check_columns(columns, header, table.shape, where)
    return {name: column for name, column in columns.items() if name in COLUMNS}


def _first_bad_cell(path: Path) -> InputFileError | None:
    """What is wrong with the first cell that is no number, or the first row of another length."""
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt", encoding="utf-8", newline="") as file:
        header = file.readline().split(",")
        for line, text in enumerate(file, 2):
            cells = text.split("#")[0].strip().split(",")
            if cells == [""]:
                continue
            if len(cells) != len(header):
                return InputFileError(
                    f"{len(cells)} cells; {len(header)} are expected, as in the header", where=f"{path}:{line}"
                )
            for column, (name, cell) in enumerate(zip(header, cells, strict=True), 1):
                try:
                    float(cell)
                except ValueError:
                    return InputFileError(
                        f"{cell.strip()!r} in column {name.strip()}; a number is expected",
                        where=f"{path}:{line}:{column}",
                    )
    return None


def _check_columns(columns: Mapping[str, Array], header: list[str], shape: tuple[int, ...], where: str) -> None:
    if shape[0] < 2:
        raise InputFileError(f"{shape[0]} rows of samples; at least 2 are needed", where=where)
    if shape[1] != len(header):
        raise InputFileError(f"{len(header)} names in the header, {shape[1]} columns", where=f"{where}:1")
    for name in ("time_s", "position_rad"):
        if name not in columns:
            raise InputFileError(f"no column {name}", where=f"{where}:1", cause=f"found {', '.join(header)}")
    if "torque_nm" not in columns and "position_command_rad" not in columns:
        raise InputFileError(
            "neither torque_nm nor position_command_rad", where=f"{where}:1", cause=f"found {', '.join(header)}"
        )
    for place, name in enumerate(header, 1):
        bad = np.flatnonzero(~np.isfinite(columns[name]))
        if bad.size and name in COLUMNS and name not in ("external_torque_nm", "temperature_c"):
            raise InputFileError(
                f"column {name} has {bad.size} values that are not finite; a number is expected in every row",
                where=f"{where}:{int(bad[0]) + 2}:{place}",
                next_step="cut the recording there, or fill the gap from its neighbours",
            )
    backwards = np.flatnonzero(np.diff(columns["time_s"]) <= 0)
    if backwards.size:
        raise InputFileError(
            f"time does not increase ({backwards.size} such rows)",
            where=f"{where}:{int(backwards[0]) + 3}:{header.index('time_s') + 1}",
            cause="rows reordered, or two recordings joined",
        )
