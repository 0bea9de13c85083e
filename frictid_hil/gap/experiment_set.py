"""An experiment set: what a simulator believes of one joint, and recordings of the real one.

A folder holds ``nominal.yaml`` and one CSV per experiment (gzip too). Only ``joint`` and ``experiments`` are required
there, only ``time_s``, ``position_rad`` and one of torque and command in a log; what is absent is None here, and the
diagnosis says what it cannot conclude without it.
"""

from __future__ import annotations

import gzip
import itertools
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config import nominal as config
from frictid_hil.config.nominal import NominalFile, ReportFilter, load_nominal
from frictid_hil.errors import ConfigError, InputFileError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.tolerances import Tolerances
from frictid_hil.recording.csv import read_csv
from frictid_hil.recording.samples import Samples
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import Payload

MAX_ROWS = 2_000_000  # rows of one log that are read; a longer one is refused with advice, not quietly cut
REST_SHARE = 1e-4  # a log whose travel is below this share of the longest one shows a joint at rest
LONG_GAP_S = 0.25  # a gap from which a recording goes on as another log: nobody knows what the joint did meanwhile
LEAST_PIECE_ROWS = 200  # shorter pieces between gaps are left out
LOG_COLUMNS = ("time_s", *Samples.COLUMNS[:4], "rigid_body_torque_nm", "temperature_c", "torque_demand_nm")


GAINS = ("kp_nm_per_rad", "ki_nm_per_rad_s", "kd_nm_s_per_rad")


@dataclass(frozen=True, slots=True)
class Controller:
    """The digital position loop, joint side.

    ``kp*e + integral(ki*e) + kd*(c*dcommand/dt - filtered velocity) + feedforward`` with ``e = command - q``, c = 1 in
    a PID. A cascade ``kv*w + integral(ki*w)`` with ``w = kp*e + c*dcommand/dt - filtered velocity`` is the same law
    with gains kv*kp, ki*kp and kv, but that its integral takes ``inner_nm_per_rad`` times the velocity error as well.
    """

    rate_hz: float  # control rate
    kp_nm_per_rad: float  # proportional gain
    ki_nm_per_rad_s: float  # integral gain; the integral freezes while the limit is active
    kd_nm_s_per_rad: float  # gain on the velocity error
    velocity_filter_s: float = 0.0  # time constant of the velocity's first-order filter
    torque_limit_nm: float = float("inf")  # limit of the demand
    # How dcommand/dt is formed, ``central`` or ``backward`` (a drive that follows set-points as they come).
    command_rate: str = "central"
    command_rate_weight: float = 1.0  # c
    cascade: bool = False  # an inner loop has an integral
    # The velocity that it uses: ``now``, or the ``difference`` of its last two positions. None: its recordings tell.
    velocity: str | None = None
    feedforward: config.FeedForward | None = None  # None where there is none

    @property
    def inner_nm_per_rad(self) -> float:
        """Integral gain of the inner loop's error; 0 where there is no such loop."""
        return self.ki_nm_per_rad_s * self.kd_nm_s_per_rad / self.kp_nm_per_rad if self.cascade else 0.0

    def added_nm(self, command_rad: Array, step_s: float) -> Array:
        """What the law adds to the torque by feed-forward, shape (n,)."""
        added: Array = np.zeros_like(command_rad)
        if (feed := self.feedforward) is not None:
            velocity = np.gradient(command_rad, step_s)
            added = added + feed.inertia_kg_m2 * np.gradient(velocity, step_s)
            added = added + feed.gravity_cos_nm * np.cos(command_rad) + feed.gravity_sin_nm * np.sin(command_rad)
            added = added + feed.coulomb_nm * np.sign(velocity) + feed.viscous_nm_s_per_rad * velocity
        return added


def with_gains(controller: Controller, shares: Sequence[float]) -> Controller:
    """The controller with kp, ki and kd larger by these shares."""
    changed = zip(GAINS, shares, strict=True)
    return replace(controller, **{name: getattr(controller, name) * (1.0 + share) for name, share in changed})


@dataclass(frozen=True, slots=True)
class Nominal:
    """What the simulator believes. None: it does not say."""

    inertia_kg_m2: float | None = None  # of the whole joint, motor included
    motor_inertia_share: float | None = None  # motor's part of it, 0..1
    gravity_cos_nm: float = 0.0  # gravity torque is ``gravity_cos*cos(q) + gravity_sin*sin(q)``
    gravity_sin_nm: float = 0.0
    gear_ratio: float | None = None  # motor turns per joint turn
    curve: FrictionCurve | None = None  # friction over speed
    presliding_stiffness_nm_per_rad: float | None = None  # of the friction's spring before it slips
    presliding_travel_rad: float = 2e-4  # over which that spring bends until it slips, where no stiffness is stated
    # Friction builds up as Dahl's and the LuGre model, and not as a spring that slips.
    yields_gradually: bool | None = None
    payload: Payload | None = None  # what is mounted where an experiment says so
    controller: Controller | None = None  # of the position loop
    rated_torque_nm: float | None = None  # of the drive, joint side
    torque_quantum_nm: float | None = None  # step of the reported torque
    # Declared low-pass of the reported torque; None where none is declared.
    torque_report_filter: ReportFilter | None = None
    torque_smoothed_hz: float | None = None  # of the low-pass without lag that its logs passed; None: they tell
    # What the file already says of the drive (its delay, its current loop), as effects by name.
    believed_effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    encoder_resolution_rad: float | None = None  # step of the reported position, joint side
    velocity_filter_s: float = 0.0  # known time constant of the reported velocity
    continuous: bool = False  # the joint may turn on and on
    tolerances: Tolerances = field(default_factory=Tolerances.of)  # one-sigma of every number
    document: Mapping[str, Any] | None = None  # the whole file, for writing an improved one
    further_keys: tuple[str, ...] = ()  # of the file, that nothing reads


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """One recording with its part in the diagnosis; columns have shape (n,), absent ones are None."""

    name: str  # of the experiment
    validation: bool  # judged on, never fitted
    payload: bool  # the payload was mounted
    run_order: int  # place in time among the experiments (temperature carries over)
    time_s: Array  # strictly increasing
    position_rad: Array  # measured
    velocity_rad_s: Array | None = None  # the drive's own
    torque_nm: Array | None = None  # the drive's own
    position_command_rad: Array | None = None  # commanded
    rigid_body_torque_nm: Array | None = None  # the part that the user's own rigid-body model explains
    temperature_c: Array | None = None  # of motor or gear
    torque_demand_nm: Array | None = None  # the controller's own demand, where the log brings it
    band_hz: float = math.inf  # above which the torque holds nothing, because it was smoothed after it was recorded

    @property
    def smoothed(self) -> bool:
        """Whether the torque holds no noise any more that tells its size."""
        return math.isfinite(self.band_hz)

    @property
    def step_s(self) -> float:
        """Median sampling step."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def travel_rad(self) -> float:
        """From its lowest to its highest position."""
        return float(np.ptp(self.position_rad))


@dataclass(frozen=True, slots=True)
class ExperimentSet:
    """Nominal joint and its experiments, in run order."""

    name: str  # of the set
    nominal: Nominal  # the believed joint
    experiments: tuple[Experiment, ...]  # logs in which the joint moves
    at_rest: tuple[str, ...] = ()  # names of logs in which it does not; they say nothing of friction and are left out

    @staticmethod
    def load(folder: Path) -> ExperimentSet:
        """Read a folder.

        Raises:
            ConfigError: nominal.yaml is missing or wrong.
            InputFileError: a log is missing, unreadable or unusable; the message names file, column and row.
        """
        told = load_nominal(folder / "nominal.yaml")
        logs = [(entry, read_log(_log_of(folder, entry))) for entry in sorted_by_run(told.file.experiments)]
        data = told.document.data
        return experiment_set(told.file, data, str(told.document.path), str(data.get("case", folder.name)), logs)


def experiment_set(
    told: NominalFile,  # what the file says
    data: Mapping[str, Any],  # the same as a plain mapping, further keys included
    where: str,  # the file, for errors
    name: str,  # of the set
    logs: Sequence[tuple[config.ExperimentFile, Samples]],  # entries of the file, each with its recording
) -> ExperimentSet:
    """A set from a checked ``nominal.yaml`` and its recordings, in run order.

    Raises:
        ConfigError: a believed number makes no sense.
        InputFileError: no log shows a joint that moves.
    """
    pieces = [piece for entry, samples in logs for piece in _without_long_gaps(_experiment(entry, samples), samples)]
    longest = max((piece.travel_rad for piece in pieces), default=0.0)
    moving = tuple(piece for piece in pieces if piece.travel_rad > REST_SHARE * longest)
    if not moving:
        raise InputFileError("column position_rad never changes", where=name, cause="a sensor or a mapping is dead")
    nominal = _nominal(told, data, where)
    if nominal.inertia_kg_m2 == 0.0:
        absent = [piece.name for piece in moving if piece.rigid_body_torque_nm is None]
        if absent:
            raise ConfigError(
                f"inertia_kg_m2 is 0, and {absent[0]} has no column rigid_body_torque_nm that would bring it",
                where=where,
                next_step="give the inertia, leave it out, or add the column to every log",
            )
        nominal = replace(nominal, inertia_kg_m2=None)
    at_rest = tuple(piece.name for piece in pieces if piece.travel_rad <= REST_SHARE * longest)
    return ExperimentSet(name, nominal, moving, at_rest)


def sorted_by_run(experiments: Sequence[config.ExperimentFile]) -> list[config.ExperimentFile]:
    """In run order; those that do not say keep their place in the file."""
    placed = [(index if e.run_order is None else e.run_order, e) for index, e in enumerate(experiments)]
    return [e.model_copy(update={"run_order": place}) for place, e in sorted(placed, key=lambda pair: pair[0])]


def _log_of(folder: Path, told: config.ExperimentFile) -> Path:
    path = folder / (told.file or f"{told.name}.csv")
    if not path.exists() and path.with_name(path.name + ".gz").exists():
        path = path.with_name(path.name + ".gz")
    if not path.exists():
        raise InputFileError("no such log", where=str(path), next_step="correct `file` in nominal.yaml")
    return path


def _without_long_gaps(log: Experiment, samples: Samples) -> list[Experiment]:
    """The log, or its pieces between long gaps; pieces too short to tell anything are left out."""
    cuts = np.flatnonzero(np.diff(samples.time_s) > max(LONG_GAP_S, 20.0 * samples.step_s)) + 1
    edges = [0, *cuts.tolist(), len(samples)]
    stretches = [slice(a, b) for a, b in itertools.pairwise(edges) if b - a >= LEAST_PIECE_ROWS]
    if cuts.size == 0 or not stretches:
        return [log]
    return [
        replace(
            log,
            name=f"{log.name}, piece {k}" if len(stretches) > 1 else log.name,
            **{name: c[part] for name in LOG_COLUMNS if (c := getattr(log, name)) is not None},
        )
        for k, part in enumerate(stretches, start=1)
    ]


def _nominal(file: NominalFile, document: Mapping[str, Any], where: str) -> Nominal:
    """The belief of a checked file."""
    joint, drive, encoder = file.joint, file.drive or config.Drive(), file.encoder or config.Encoder()
    friction, report, payload = joint.friction or config.Friction(), drive.torque_report_filter, file.payload
    gravity_cos = joint.gravity_torque_nm if joint.gravity_torque_nm is not None else joint.gravity_cos_nm
    return Nominal(
        inertia_kg_m2=joint.inertia_kg_m2,
        motor_inertia_share=joint.motor_inertia_share,
        gravity_cos_nm=gravity_cos or 0.0,
        gravity_sin_nm=joint.gravity_sin_nm or 0.0,
        gear_ratio=joint.gear_ratio,
        curve=_curve(friction, where),
        presliding_stiffness_nm_per_rad=friction.presliding_stiffness_nm_per_rad,
        yields_gradually=None if friction.presliding_yields is None else friction.presliding_yields == "gradually",
        payload=None if payload is None else Payload(payload.inertia_kg_m2 or 0.0, payload.gravity_torque_nm or 0.0),
        controller=None if file.controller is None else _controller(file.controller),
        rated_torque_nm=drive.rated_torque_nm,
        torque_quantum_nm=drive.torque_quantum_nm,
        torque_smoothed_hz=drive.torque_smoothed_hz,
        torque_report_filter=report if report and report.time_constant_s > 0.0 else None,
        believed_effects=_believed_effects(document.get("drive") or {}),
        encoder_resolution_rad=encoder.resolution_rad,
        velocity_filter_s=encoder.velocity_filter_s or 0.0,
        continuous=joint.continuous or joint.gear == "none",
        tolerances=Tolerances.of(file.tolerance),
        document=document,
        further_keys=config.further_keys(file),
    )


def _controller(told: config.ControllerFile) -> Controller | None:
    """The law as one form; None where it is unknown or only its demand is recorded."""
    if told.type in ("columns", "unknown") or told.rate_hz is None or told.kp is None:
        return None
    ki = told.ki or 0.0
    plain = Controller(
        rate_hz=told.rate_hz,
        kp_nm_per_rad=told.kp,
        ki_nm_per_rad_s=ki,
        kd_nm_s_per_rad=told.kd or 0.0,
        velocity_filter_s=told.velocity_filter_s or 0.0,
        torque_limit_nm=told.torque_limit_nm or float("inf"),
        command_rate=told.command_rate or "central",
        velocity=told.velocity,
        feedforward=told.feedforward,
    )
    if told.type == "pid" or told.kv is None:
        return plain
    return replace(
        plain,
        kp_nm_per_rad=told.kv * told.kp,
        ki_nm_per_rad_s=ki * told.kp,
        kd_nm_s_per_rad=told.kv,
        command_rate_weight=told.velocity_feedforward,
        cascade=ki > 0.0,
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


def _curve(friction: config.Friction, where: str) -> FrictionCurve | None:
    if friction.velocity_rad_s is not None and friction.torque_nm is not None:
        return FrictionCurve.through(np.array(friction.velocity_rad_s), np.array(friction.torque_nm), where=where)
    if friction.coulomb_nm is None:
        return None
    speeds = np.array([1.0, 2.0])
    viscous = friction.viscous_nm_s_per_rad or 0.0
    return FrictionCurve.through(speeds, friction.coulomb_nm + viscous * speeds, where=where)


def _experiment(told: config.ExperimentFile, samples: Samples) -> Experiment:
    columns = {name: getattr(samples, name) for name in LOG_COLUMNS}
    role, order = told.role == "validation", told.run_order or 0
    return Experiment(name=told.name, validation=role, payload=told.payload, run_order=order, **columns)


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
