"""Experiment sets from a user's own robot model and recordings: one set a joint, with what the model believes of it.

The rigid bodies of the whole arm, moved as all joints of the log moved, are a column of every set
(``rigid_body_torque_nm``). Where that column is nothing but an inertia and a gravity of the joint alone - one joint
moved and the others stood still - the joint gets these two numbers instead, and its closed loop can be simulated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.columns import load_columns
from frictid_hil.config.nominal import ExperimentFile, NominalFile, load_nominal
from frictid_hil.config.search import find
from frictid_hil.errors import InputFileError, UsageError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.arm import ArmFindings, Recorded, find_in_arm
from frictid_hil.gap.experiment_set import ExperimentSet, experiment_set
from frictid_hil.jobs.gap.draft import drafted
from frictid_hil.jobs.gap.logs import listed_as, names_of, parted, samples_of_all
from frictid_hil.recording.samples import Samples
from frictid_hil.simulation.robot_model import ModelJoint, RobotModel

ALONE = 0.01  # rest of the rigid-body torque, over its RMS, up to which an inertia and a gravity are all there is
POSTURE_MATTERS = 0.02
"""Change of a joint's torque with the place of a joint that no log has, over its RMS, from which the place is asked."""
CURVE_POINTS = 12  # pairs by which a friction formula of a file is told
LEAST_DRY = 1e-3  # dry friction below this share of the torque is none: nothing was believed of it
INERTIA_POSTURES = 40


@dataclass(frozen=True, slots=True)
class ModelLogs:
    """What is asked: a model, recordings, and what the model does not say; see ``gap diagnose --help``."""

    model: Path
    logs: Sequence[Path]
    joints: Sequence[str] = ()  # ``NAME`` or ``NAME=NAME_IN_LOG``
    columns: str | None = None
    held: Mapping[str, float] | None = None  # place of joints that no log has, rad (m)
    tolerances: Mapping[str, float | str] | None = None  # one-sigma by ``NUMBER`` or ``JOINT:NUMBER``
    validation: Sequence[str] = ()
    split: str = ""
    nominal: Path | None = None  # its sections say more than the model does, or better, of all joints


@dataclass(frozen=True, slots=True)
class JointSet:
    """One joint, ready to be diagnosed."""

    believed: ModelJoint
    experiments: ExperimentSet
    document: Mapping[str, Any]  # the same belief as a ``nominal.yaml`` would say it
    drafted: Mapping[str, Any]  # numbers taken from the logs because the file has none, by name
    asked: tuple[str, ...]  # what nobody said, with what it costs and how to say it


@dataclass(frozen=True, slots=True)
class Motion:
    """One recording of several joints on one clock, by the model's names; ``validation`` is judged on, never fitted."""

    name: str
    validation: bool
    samples: Mapping[str, Samples]

    @property
    def time_s(self) -> Array:
        """Of all its joints, shape (n,)."""
        return next(iter(self.samples.values())).time_s

    @property
    def position_rad(self) -> Array:
        """Shape (n, k)."""
        return np.stack([s.position_rad for s in self.samples.values()], axis=1)

    @property
    def moved(self) -> tuple[Array, Array, Array]:
        """Its ``kinematics``."""
        return kinematics(self.time_s, self.position_rad)

    def beginning(self, seconds: float) -> Motion:
        """The first seconds of it."""
        keep = self.time_s - self.time_s[0] <= seconds
        return replace(self, samples={name: s.select(keep) for name, s in self.samples.items()})


def postures(motions: Sequence[Motion], most: int) -> Array:
    """Positions that the joints had along some recordings, about so many, shape (n, k)."""
    every = np.concatenate([motion.position_rad for motion in motions])
    some: Array = every[:: max(1, every.shape[0] // most)]
    return some


@dataclass(frozen=True, slots=True)
class ArmSet:
    """The whole arm: its model, its motions, one set a joint."""

    robot: RobotModel
    motions: tuple[Motion, ...]
    held: Mapping[str, float]  # where the joints stand that no recording has
    joints: Mapping[str, JointSet]  # by name; only those that move
    # Of the arm as a whole; None where no log has torques of all joints, or there is only one joint.
    found: ArmFindings | None = None
    still: tuple[str, ...] = ()  # joints of the logs that stand in all of them

    @property
    def recorded(self) -> tuple[str, ...]:
        """The joints of the recordings, in the order of their columns."""
        return tuple(self.motions[0].samples)


def sets_from_model(asked: ModelLogs) -> ArmSet:
    """Read model and recordings (``UsageError``: what is not there, or told; ``InputFileError``, ``ConfigError``)."""
    robot = RobotModel.load(find(asked.model, folder="models", what="robot model"))
    motions = _motions(asked, robot)
    names = tuple(motions[0].samples)
    held = {name: value for name, value in (asked.held or {}).items() if name not in names}
    rigid = [robot.rigid_body_torque(names, *motion.moved, held) for motion in motions]
    _ask_for_places(robot, motions, held)
    _known_tolerances(asked.tolerances or {}, names)
    inertia = robot.inertia_kg_m2(names, postures(motions, INERTIA_POSTURES), held).mean(axis=0)
    found = _of_the_arm(robot, motions, held)
    if found is not None and found.torque is not None:
        # What belongs to the arm is no cause of a joint.
        rigid = [torque + found.torque(*motion.moved) for torque, motion in zip(rigid, motions, strict=True)]
    sets = {}
    for k, name in enumerate(names):
        moved = [n for n, motion in enumerate(motions) if _moves(motion.samples[name])]
        if moved:
            columns = [rigid[n][:, k] for n in moved]
            sets[name] = _joint_set(asked, robot, [motions[n] for n in moved], name, columns, float(inertia[k]))
    if not sets:
        raise InputFileError("no joint moves in these logs", where=str(asked.logs[0]))
    still = tuple(name for name in names if name not in sets)
    reference, places = robot.compiled.qpos0, robot.compiled.jnt_qposadr
    usual = {name: float(reference[int(places[robot.number(name)])]) for name in robot.joints if name not in names}
    return ArmSet(robot, motions, {**usual, **held}, sets, found, still)


def _moves(samples: Samples) -> bool:
    """Whether a joint is moved in a log: its command changes, or without one its position does."""
    command = samples.position_command_rad
    return float(np.ptp(samples.position_rad if command is None else command)) > 0.0


def _of_the_arm(robot: RobotModel, motions: Sequence[Motion], held: Mapping[str, float]) -> ArmFindings | None:
    """Causes that belong to no single joint."""
    names = tuple(motions[0].samples)
    recorded = []
    for motion in motions:
        torques = [s.torque_nm for s in motion.samples.values() if s.torque_nm is not None]
        if len(torques) < len(names):
            return None
        recorded.append(Recorded(motion.validation, motion.time_s, motion.position_rad, np.stack(torques, axis=1)))
    if len(names) < 2:
        return None
    curves = [_curve_of(robot.joint(name), motions) for name in names]
    return find_in_arm(robot, names, held, curves, recorded)


def _curve_of(believed: ModelJoint, motions: Sequence[Motion]) -> FrictionCurve | None:
    told = _friction(believed, [motion.samples[believed.name] for motion in motions])
    if told is None:
        return None
    return FrictionCurve.through(np.array(told["velocity_rad_s"]), np.array(told["torque_nm"]))


def _motions(asked: ModelLogs, robot: RobotModel) -> tuple[Motion, ...]:
    if not asked.logs:
        raise UsageError("no log is given", next_step="name recordings of the machine with --log")
    columns = load_columns(asked.columns) if asked.columns is not None else None
    pairs = (word.partition("=") for word in asked.joints)
    wanted = {name: in_log or name for name, _, in_log in pairs}
    for name in wanted:
        robot.number(name)
    named_logs = zip(names_of(asked.logs), asked.logs, strict=True)
    read = [(name, samples_of_all(path, columns), path) for name, path in named_logs]
    first = None
    on_one_clock = []
    for log, found, path in read:
        named = _as_in_model(found, wanted, robot, path)
        first = first or tuple(named)
        missing = [name for name in first if name not in named]
        if missing:
            raise InputFileError(
                f"has no joint {missing[0]}, which {read[0][0]} has",
                where=str(path),
                next_step="give logs of the same joints together, or name the joints that all have with --joint",
            )
        on_one_clock.append((log, _one_clock({name: named[name] for name in first})))
    leads = [(log, next(iter(together.values()))) for log, together in on_one_clock]
    whole = dict(on_one_clock)
    return tuple(
        Motion(log, validation, {name: s.select(keep) for name, s in whole[source].items()})
        for log, source, keep, validation in parted(leads, asked.validation, asked.split)
    )


def _as_in_model(
    found: Sequence[Samples], wanted: Mapping[str, str], robot: RobotModel, path: Path
) -> dict[str, Samples]:
    """The log's joints by the model's names, in the model's order."""
    in_log = {samples.joint: samples for samples in found}
    pairs = wanted or {name: name for name in robot.joints if name in in_log}
    if len(in_log) == 1 and len(wanted or robot.joints) == 1:
        (name,), (only,) = wanted or robot.joints, in_log.values()
        return {name: only}
    absent = [there for there in pairs.values() if there not in in_log]
    if not pairs or absent:
        raise UsageError(
            f"no joint {absent[0]!r} in this log" if absent else "log and model have no joint name in common",
            where=str(path),
            cause=f"the log has {', '.join(in_log)}; the model has {', '.join(robot.joints)}",
            next_step="pair them with --joint NAME_IN_MODEL=NAME_IN_LOG, once for each joint",
        )
    return {name: in_log[pairs[name]] for name in robot.joints if name in pairs}


def _one_clock(named: Mapping[str, Samples]) -> dict[str, Samples]:
    """All joints on the times of the first, over the stretch that all of them have."""
    first = next(iter(named.values()))
    if all(np.array_equal(s.time_ns, first.time_ns) for s in named.values()):
        return {name: replace(s, prismatic=False) for name, s in named.items()}
    start = max(int(s.time_ns[0]) for s in named.values())
    end = min(int(s.time_ns[-1]) for s in named.values())
    time = first.time_ns[(first.time_ns >= start) & (first.time_ns <= end)]
    if time.size < 2:
        raise InputFileError("its joints were never recorded at the same time", where=first.joint)
    made = {}
    for name, s in named.items():
        columns: dict[str, Any] = {column: np.interp(time, s.time_ns, values) for column, values in s.columns().items()}
        made[name] = replace(s, time_ns=time, prismatic=False, **columns)
    return made


def kinematics(time_s: Array, position_rad: Array) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration by differences, shape (n, k) each; nothing is filtered."""
    step_s = float(np.median(np.diff(time_s)))
    velocity = np.asarray(np.gradient(position_rad, time_s, axis=0), dtype=np.float64)
    acceleration = np.zeros_like(position_rad)
    if np.max(np.abs(np.diff(time_s) - step_s)) < 0.02 * step_s:
        acceleration[1:-1] = (position_rad[2:] - 2.0 * position_rad[1:-1] + position_rad[:-2]) / step_s**2
    else:
        ahead, behind = np.diff(time_s)[1:, None], np.diff(time_s)[:-1, None]
        slope = np.diff(position_rad, axis=0) / np.diff(time_s)[:, None]
        acceleration[1:-1] = 2.0 * (slope[1:] - slope[:-1]) / (ahead + behind)
    return position_rad, velocity, acceleration


def _ask_for_places(robot: RobotModel, motions: Sequence[Motion], held: Mapping[str, float]) -> None:
    """Ask where a joint stood that no log has, if that makes a difference to those that have."""
    names = tuple(motions[0].samples)
    some = postures(motions, INERTIA_POSTURES)
    still = np.zeros_like(some)

    def gravity(places: Mapping[str, float]) -> Array:
        return robot.rigid_body_torque(names, some, still, still, {**held, **places})

    usual = gravity({})
    size = np.sqrt(np.mean(usual**2, axis=0)) + 1e-9
    for name in robot.joints:
        limits = robot.joint(name).range_rad or (-1.0, 1.0)
        if name in names or name in held:
            continue
        change = max(float(np.max(np.abs(gravity({name: end}) - usual) / size)) for end in limits)
        if change > POSTURE_MATTERS and float(np.max(size)) > 1e-6:
            raise UsageError(
                f"where did joint {name} stand? No log has it, and it changes the gravity of the others by "
                f"{100.0 * change:.0f} %",
                where=str(robot.path),
                next_step=f"say it with --hold {name}=20deg, or give a log that has it",
            )


def _joint_set(
    asked: ModelLogs,
    robot: RobotModel,
    motions: Sequence[Motion],
    name: str,
    rigid_nm: Sequence[Array],
    inertia_kg_m2: float,
) -> JointSet:
    believed = robot.joint(name)
    alone = _alone(motions, name, rigid_nm)
    joint: dict[str, Any] = {
        "inertia_kg_m2": alone[0] if alone else inertia_kg_m2,
        "motor_inertia_share": min(1.0, believed.armature_kg_m2 / inertia_kg_m2),
        "continuous": believed.range_rad is None,
    }
    cos, sin = alone[1:] if alone else _gravity(robot, motions, name)
    joint |= {"gravity_cos_nm": cos, "gravity_sin_nm": sin}
    if believed.motor is not None and abs(believed.motor.gear) > 1.0:
        joint["gear_ratio"] = abs(believed.motor.gear)
    told: dict[str, Any] = {
        "case": f"{robot.path.stem}, {name}",
        "robot_joint": name,
        "joint": joint,
        "tolerance": {**_CAD, **_of_joint(asked.tolerances or {}, name)},
    }
    told |= _drive(believed, robot)
    said = _said(asked.nominal)
    told |= {key: {**told.get(key, {}), **section} for key, section in said.items()}
    listed = []
    for order, (motion, column) in enumerate(zip(motions, rigid_nm, strict=True)):
        samples = motion.samples[name] if alone else replace(motion.samples[name], rigid_body_torque_nm=column)
        listed.append((listed_as(motion.name, motion.validation, order), samples))
    numbers: dict[str, Any] = {}
    friction = told["joint"].get("friction") or _friction(believed, [samples for _, samples in listed])
    if friction is None:
        numbers = _drafted_friction(told, listed, robot, name)
    else:
        told["joint"] = {**told["joint"], "friction": friction}
    experiments = experiment_set(NominalFile.model_validate(told), told, str(robot.path), told["case"], listed)
    return JointSet(believed, experiments, told, numbers, tuple(_open_questions(believed, numbers, said)))


_CAD = {"inertia_kg_m2": "cad", "gravity_torque_nm": "cad", "rigid_body_torque": "cad"}
"""What the numbers of a model file were taken from, unless somebody says better."""


def _alone(motions: Sequence[Motion], name: str, rigid_nm: Sequence[Array]) -> tuple[float, float, float] | None:
    """(inertia, gravity cosine, gravity sine) where nothing else moves the joint; None where the arm does."""
    columns, torque = [], np.concatenate(rigid_nm)
    for motion in motions:
        samples = motion.samples[name]
        q, _, acceleration = kinematics(samples.time_s, samples.position_rad[:, None])
        columns.append(np.column_stack([acceleration[:, 0], np.cos(q[:, 0]), np.sin(q[:, 0])]))
    table = np.concatenate(columns)
    numbers = np.linalg.lstsq(table, torque, rcond=None)[0]
    rest = float(np.sqrt(np.mean((torque - table @ numbers) ** 2)))
    if numbers[0] <= 0.0 or rest > ALONE * float(np.sqrt(np.mean(torque**2))):
        return None
    return float(numbers[0]), float(numbers[1]), float(numbers[2])


def _gravity(robot: RobotModel, motions: Sequence[Motion], name: str) -> tuple[float, float]:
    """Cosine and sine that come nearest to the joint's gravity along the recordings."""
    some = postures(motions, 10 * INERTIA_POSTURES)
    names = tuple(motions[0].samples)
    torque = robot.rigid_body_torque(names, some, np.zeros_like(some), np.zeros_like(some))
    q = some[:, names.index(name)]
    cos, sin = np.linalg.lstsq(np.column_stack([np.cos(q), np.sin(q)]), torque[:, names.index(name)], rcond=None)[0]
    return float(cos), float(sin)


def _friction(believed: ModelJoint, logs: Sequence[Samples]) -> dict[str, Any] | None:
    """The file's friction as pairs over the speeds that were driven; None where the file has no dry friction."""
    torques = [s.torque_nm for s in logs if s.torque_nm is not None]
    size = float(np.sqrt(np.mean(np.concatenate(torques) ** 2))) if torques else 0.0
    if believed.dry_nm <= LEAST_DRY * size or believed.dry_nm <= 0.0:
        return None
    fastest = max(float(np.quantile(np.abs(np.gradient(s.position_rad, s.time_s)), 0.99)) for s in logs)
    speed = 1.2 * max(fastest, 1e-3) * (np.arange(1, CURVE_POINTS + 1) / CURVE_POINTS) ** 2
    told: dict[str, Any] = {
        "velocity_rad_s": [float(v) for v in speed],
        "torque_nm": [float(f) for f in believed.friction_nm(speed)],
    }
    if believed.presliding_nm_per_rad is not None:
        told["presliding_stiffness_nm_per_rad"] = believed.presliding_nm_per_rad
        told |= {"presliding_yields": "gradually"} if believed.yields_gradually else {}
    return told


def _drafted_friction(
    told: dict[str, Any], listed: Sequence[tuple[ExperimentFile, Samples]], robot: RobotModel, name: str
) -> dict[str, Any]:
    """Friction by least squares where the file has none; written into ``told``."""
    fitted = [pair for pair in listed if pair[0].role == "identification" and pair[1].torque_nm is not None]
    if not fitted:
        return {}
    plain = {**told, "joint": {**told["joint"], "inertia_kg_m2": told["joint"]["inertia_kg_m2"]}}
    logs = experiment_set(NominalFile.model_validate(plain), plain, str(robot.path), name, fitted)
    found = drafted(logs)
    told["joint"]["friction"] = found["joint"]["friction"]
    shares = {key: found["tolerance"][key] for key in ("friction_torque", "viscous")}
    told["tolerance"] = {**shares, **told["tolerance"]}
    return {"friction": {**found["joint"]["friction"], "tolerance": shares}}


def _drive(believed: ModelJoint, robot: RobotModel) -> dict[str, Any]:
    """``controller`` and ``drive`` of what the file's actuators say."""
    motor = believed.motor
    if motor is None:
        return {}
    late = {"torque_delay_s": motor.delay_s, "current_lag_s": motor.lag_s}
    drive = {name: value for name, value in late.items() if value > 0.0}
    told: dict[str, Any] = {"drive": drive} if drive else {}
    if motor.law == "position":
        limit = {"torque_limit_nm": motor.torque_limit_nm} if np.isfinite(motor.torque_limit_nm) else {}
        rate = {"rate_hz": 1.0 / float(robot.compiled.opt.timestep)}
        if motor.kv_nm_s_per_rad > 0.0:
            # kp (command - q) - kv v: a cascade that damps the motion itself.
            gains = {"kp": motor.kp_nm_per_rad / motor.kv_nm_s_per_rad, "kv": motor.kv_nm_s_per_rad}
            told["controller"] = {"type": "cascade", **gains, **rate, **limit}
        else:
            told["controller"] = {"type": "pid", "kp": motor.kp_nm_per_rad, **rate, **limit}
    return told


def _said(nominal: Path | None) -> dict[str, Any]:
    """The sections of a file that says more than the model."""
    if nominal is None:
        return {}
    data = load_nominal(nominal, logs=False).document.data
    return {key: dict(data[key]) for key in ("joint", "controller", "drive", "encoder", "payload") if data.get(key)}


def _open_questions(believed: ModelJoint, drafted_numbers: Mapping[str, Any], said: Mapping[str, Any]) -> list[str]:
    """What the file does not say, in sentences that name what to do."""
    asked = []
    if drafted_numbers:
        asked.append("friction: the file has no dry friction, so it was drafted from the logs that are fitted")
    where = "; say it in a nominal.yaml (--nominal)"
    if "controller" in said:
        pass
    elif believed.motor is None:
        asked.append(f"controller: the file has no actuator on this joint{where}")
    elif believed.motor.law != "position":
        asked.append(
            f"controller: its actuator takes a {'torque' if believed.motor.law == 'torque' else 'control of its own'}, "
            f"so the position loop is not in the file{where}"
        )
    if believed.presliding_nm_per_rad is None and "friction" not in said.get("joint", {}):
        asked.append("presliding stiffness: the file has none (MuJoCo 4 holds it as springyield)")
    if believed.armature_kg_m2 == 0.0:
        asked.append("armature: the file has none, so the rotor counts as part of the link")
    return asked


def _of_joint(told: Mapping[str, float | str], name: str) -> dict[str, Any]:
    """The tolerances of one joint: those of all, then its own."""
    general = {key: value for key, value in told.items() if ":" not in key}
    own = {key.partition(":")[2]: value for key, value in told.items() if key.partition(":")[0] == name and ":" in key}
    return {**general, **own}


def _known_tolerances(told: Mapping[str, float | str], joints: Sequence[str]) -> None:
    for key in told:
        joint, colon, _ = key.partition(":")
        if colon and joint not in joints:
            raise UsageError(
                f"no joint {joint!r} in the logs", where=f"--tolerance {key}", next_step=f"one of {', '.join(joints)}"
            )
