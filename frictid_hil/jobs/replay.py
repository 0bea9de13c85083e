"""``frictid-hil replay``: identifies a bus log like a live run, or streams its set-points to the simulated joint.

A live run identifies from its decoded frames and their run time. The log carries both, so that it gives the same
profile to the last bit. The manifest of the run says which frame carries what. For logs of other origin a frame map or
an EDS file says it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import can
import numpy as np

from frictid_hil.config.profile import FrictionProfile, JointProfile, load_profile, profile_file
from frictid_hil.config.provenance import Provenance, file_sha256
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import GateFailed, HardwareError, IdentificationError, InputFileError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.friction.metrics import curve_distance, plain_rms
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.jobs.bus_logs import Account, given_map, is_log, logs_of, samples_in
from frictid_hil.jobs.identification.joint_profile import failed_result, identify_joint, joint_result
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What a person asked for, see ``frictid-hil replay --help``.

    Attributes:
        procedure: of a log that carries no marks.
        method: estimator; None for the one of the profile compared with, else ``aligned``.
        paced: at recorded speed.
    """

    source: Path
    robot: str
    joints: tuple[str, ...] = ()
    frames: Path | None = None
    eds: Path | None = None
    profile: Path | None = None
    procedure: Procedure | None = None
    method: str | None = None
    paced: bool = False
    echo: str | None = None
    simulation: bool = True
    out: Path | None = None
    force: bool = False


def replay(options: ReplayOptions, note: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Play a recording back.

    Raises:
        UsageError: nothing says which frame is what, options contradict each other, or a file would be overwritten.
        InputFileError: the recording is unreadable or unusable.
    """
    robot = load_robot(options.robot)
    robot.check_joints(options.joints)
    if options.out is not None:
        refuse_overwriting([options.out / "profile.yaml", *options.out.glob("simulated-*.csv")], force=options.force)
    account = Account()
    late: dict[str, int] = {}
    if is_log(options.source):
        recordings, late = _decoded(options, robot, account, note)
    else:
        recordings = [one for one in read(options.source) if not options.joints or one.joint in options.joints]
    unknown_joints = [one.joint for one in recordings if one.joint not in robot.file.joints]
    if unknown_joints or not recordings:
        raise InputFileError(
            f"joints {', '.join(unknown_joints)} are not in {robot.path.name}" if unknown_joints else "no joint moved",
            where=str(options.source),
        )
    reference = _reference(options)
    setup = robot.to_setup()
    told = {one.joint: _identified(one, recordings, setup, options, reference, account, late) for one in recordings}
    result = _result(options, robot, told, reference, account)
    if options.simulation:
        result |= _simulated(options, robot, recordings, result["joints"], note)
    return result


# -- decoding -------------------------------------------------------------------------------------------------------


def _decoded(
    options: ReplayOptions, robot: Robot, account: Account, note: Callable[[str], None]
) -> tuple[list[Samples], dict[str, int]]:
    """Samples of every joint that moved, and the late cycles that the live run counted."""
    logs = logs_of(options.source, given_map(options.frames, options.eds, robot))
    told_s = -math.inf

    def at(time_s: float) -> None:
        nonlocal told_s
        if options.paced and time_s >= told_s + 1.0:
            told_s = time_s
            note(f"{time_s:.0f} s")

    with _echo(options.echo) as echo:
        samples = samples_in(logs, robot.name, account, joints=options.joints, paced=options.paced, echo=echo, at=at)
    late = {motion.joint: motion.late_cycles for log in logs for motion in log.motions}
    return [samples[name] for name in dict.fromkeys([*robot.joint_names, *samples]) if name in samples], late


@contextlib.contextmanager
def _echo(named: str | None) -> Iterator[can.BusABC | None]:
    """The bus to send the frames to again, or None."""
    if named is None:
        yield None
        return
    interface, _, channel = named.partition(":")
    try:
        bus = can.Bus(interface=interface, channel=channel)
    except (can.CanError, OSError, ValueError) as error:
        raise HardwareError(
            f"cannot be opened: {error}", where=named, next_step="name it as interface:channel"
        ) from None
    with bus:
        yield bus


# -- identifying and comparing --------------------------------------------------------------------------------------


def _reference(options: ReplayOptions) -> FrictionProfile | None:
    if options.profile is not None:
        return load_profile(profile_file(options.profile))
    folder = options.source if options.source.is_dir() else options.source.parent
    own = folder / "profile.yaml"
    return load_profile(own) if (folder / "manifest.json").exists() and own.exists() else None


_Identified = tuple[JointProfile | None, dict[str, Any]]
"""The profile of a joint, None where there is no curve, and its entry in the result."""


def _identified(
    samples: Samples,
    recordings: list[Samples],
    setup: RobotSetup,
    options: ReplayOptions,
    reference: FrictionProfile | None,
    account: Account,
    late: Mapping[str, int],
) -> _Identified:
    name = samples.joint
    known = reference.joints.get(name) if reference else None
    told = {"identical": None, "difference_percent": None, "lost_rows": account.lost_rows.get(name)}
    try:
        profile = identify_joint(
            samples,
            setup.joint(name),
            method=options.method or (known.method if known else "aligned"),
            procedure=None if samples.marks else options.procedure,
            late_cycles=late.get(name, 0),
            company=recordings,
        )
    except IdentificationError as error:
        return None, {**failed_result(str(error)), **told}
    gate = account.gate(name)
    gates = profile.gates if gate is None else (*profile.gates, gate)
    profile = profile.model_copy(update={"gates": gates, "drive": profile.drive if known is None else known.drive})
    result = {**joint_result(profile), **told}
    if known is not None:
        result["identical"] = profile.values() == known.values()
        result["difference_percent"] = curve_distance(
            profile.curve(), known.curve(), known.velocity_rad_s[-1]
        ).e_percent
    return profile, result


def _result(
    options: ReplayOptions,
    robot: Robot,
    told: Mapping[str, _Identified],
    reference: FrictionProfile | None,
    account: Account,
) -> dict[str, Any]:
    joints = {name: joint for name, (_, joint) in told.items()}
    compared = None
    if reference is not None:
        wanted = set(options.joints or reference.joints) & set(reference.joints)
        compared = all(joints.get(name, {}).get("identical") is True for name in wanted)
    bad = {name: joint["remarks"] for name, joint in joints.items() if joint["outcome"] != "ok"}
    result: dict[str, Any] = {
        "outcome": "gate_failed" if bad else "ok",
        "robot": robot.name,
        "source": str(options.source.resolve()),
        "identical": compared,
        "position_rms_rad": None,
        "torque_rms_nm": None,
        "log": asdict(account) if account.frames else None,
        "profile": _write(options, robot, {name: one for name, (one, _) in told.items() if one is not None}),
        "joints": joints,
    }
    if bad:
        result["error"] = GateFailed(
            "; ".join(f"joint {name}: {'; '.join(remarks)}" for name, remarks in bad.items()),
            where=str(options.source),
            next_step="results of the other joints stand",
        ).to_json()
    return result


def _write(options: ReplayOptions, robot: Robot, profiles: Mapping[str, JointProfile]) -> str | None:
    if options.out is None or not profiles:
        return None
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "profile.yaml"
    logs = sorted(options.source.glob("bus*.blf")) if options.source.is_dir() else [options.source]
    FrictionProfile(
        robot=robot.name,
        joints=dict(profiles),
        provenance=Provenance.now(
            robot_file=robot.path.name,
            config_sha256=robot.digest,
            run=str(options.source.resolve()),
            log_sha256={log.name: file_sha256(log) for log in logs},
            notes=["identified from a replay"],
        ),
    ).save(path)
    return str(path.resolve())


# -- simulating -----------------------------------------------------------------------------------------------------


def _simulated(
    options: ReplayOptions,
    robot: Robot,
    recordings: list[Samples],
    joints: dict[str, dict[str, Any]],
    note: Callable[[str], None],
) -> dict[str, Any]:
    """Root mean squares over all joints that the robot file can simulate; per joint beside them."""
    squares: dict[str, list[tuple[float, int]]] = {"position_rms_rad": [], "torque_rms_nm": []}
    files = []
    for samples in recordings:
        if not robot.file.joints[samples.joint].simulated:
            joints[samples.joint]["simulation"] = "the robot file has no `simulated` for this joint"
            continue
        simulated = simulate(robot, samples)
        if simulated.note:
            note(f"joint {samples.joint}: {simulated.note}")
        for key in squares:
            value = getattr(simulated, key)
            joints[samples.joint][key] = value
            if value is not None:
                squares[key].append((value**2, len(samples)))
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            files.append(str(simulated.write_csv(options.out / f"simulated-{samples.joint}.csv").resolve()))
    together: dict[str, Any] = {key: _pooled(values) for key, values in squares.items()}
    return {**together, "simulated": files}


def _pooled(values: list[tuple[float, int]]) -> float | None:
    rows = sum(count for _, count in values)
    return math.sqrt(float(np.sum([square * count for square, count in values])) / rows) if rows else None


_CONTROL_PERIOD_S = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedReplay:
    """One joint, measured (``samples``) and simulated without noise on the same rows, shape (n,).

    ``note`` is what a reader should know of the set-points.
    """

    samples: Samples
    position_rad: Array
    velocity_rad_s: Array
    torque_nm: Array
    note: str = ""

    @property
    def position_rms_rad(self) -> float:
        """Root of the mean square of measured minus simulated."""
        return plain_rms(self.samples.position_rad - self.position_rad)

    @property
    def torque_rms_nm(self) -> float | None:
        """The same of the torque; None for a recording without."""
        measured = self.samples.torque_nm
        return None if measured is None else plain_rms(measured - self.torque_nm)

    def write_csv(self, path: Path) -> Path:
        """Measured and simulated columns, for any tool."""
        columns = {"time_s": self.samples.time_s, **self.samples.columns()}
        columns |= {
            "simulated_position_rad": self.position_rad,
            "simulated_velocity_rad_s": self.velocity_rad_s,
            "simulated_torque_nm": self.torque_nm,
        }
        rows = np.column_stack(list(columns.values())).tolist()
        lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
        write_whole(path, "\n".join(lines) + "\n")
        return path


def simulate(robot: Robot, samples: Samples) -> SimulatedReplay:
    """Stream a recording's set-points to the joint that the robot file describes under ``simulated``.

    The joint starts at rest, powered, where the recording starts; set-point k is in force from t_k on, and rows follow
    the timing of a live run (position at t_k, mean torque of what led to it).

    Raises:
        ConfigError: the ``simulated`` mapping is wrong, with its place.
    """
    from frictid_hil.simulation.joint import JointModel  # loads numba; a replay without simulation does not need it
    from frictid_hil.simulation.servo_loop import ServoLoop

    with robot.document.locating():
        model = JointModel.of(robot.file.joints[samples.joint], samples.joint)
    quiet = replace(model, drive=replace(model.drive, torque_noise_per_mille=0.0))
    command = samples.position_command_rad
    note = "" if command is not None else "no set-points in the recording: the measured positions are followed"
    targets = (samples.position_rad if command is None else command).tolist()
    loop = ServoLoop(quiet, period_s=_CONTROL_PERIOD_S, position_rad=float(samples.position_rad[0]))
    loop.power(True)
    loop.brake(False)
    steps_s = (np.diff(samples.time_ns) * 1e-9).tolist()
    position, velocity, torque = [loop.measured_position_rad], [0.0], [0.0]
    for step_s, target_rad in zip(steps_s, targets, strict=False):
        loop.advance(step_s, position_rad=target_rad)
        position.append(loop.measured_position_rad)
        velocity.append(loop.velocity_rad_s)
        torque.append(loop.torque_nm)
    if len(torque) > 1:
        torque[0] = torque[1]
    return SimulatedReplay(samples, np.array(position), np.array(velocity), np.array(torque), note)
