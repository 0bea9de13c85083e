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
    """What a person asked for, see ``frictid-hil replay --help``."""

    source: Path
    robot: str
    joints: tuple[str, ...] = ()
    frames: Path | None = None
    eds: Path | None = None
    profile: Path | None = None
    procedure: Procedure | None = None  # of a log that carries no marks
    method: str | None = None  # estimator; None for the one of the profile compared with, else ``aligned``
    paced: bool = False  # at recorded speed
    echo: str | None = None
    simulation: bool = True
    out: Path | None = None
    force: bool = False


def replay(options: ReplayOptions, note: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Play a recording back (``UsageError``: unknown frames, contradictions, a file is there; ``InputFileError``)."""
    return _Replay(options, note).result()


_Identified = tuple[JointProfile | None, dict[str, Any]]
"""The profile of a joint, None where there is no curve, and its entry in the result."""


class _Replay:
    def __init__(self, options: ReplayOptions, note: Callable[[str], None]) -> None:
        self._options = options
        self._note = note
        self._robot = load_robot(options.robot)
        self._account = Account()
        self._late: dict[str, int] = {}

    def result(self) -> dict[str, Any]:
        """The JSON of the verb."""
        options, robot = self._options, self._robot
        robot.check_joints(options.joints)
        if out := options.out:
            refuse_overwriting([out / "profile.yaml", *out.glob("simulated-*.csv")], force=options.force)
        if is_log(options.source):
            recordings = self._decoded()
        else:
            recordings = [one for one in read(options.source) if not options.joints or one.joint in options.joints]
        unknown = [one.joint for one in recordings if one.joint not in robot.file.joints]
        if unknown or not recordings:
            raise InputFileError(
                f"joints {', '.join(unknown)} are not in {robot.path.name}" if unknown else "no joint moved",
                where=str(options.source),
            )
        reference, setup = _reference(options), robot.to_setup()
        told = {one.joint: self._identified(one, recordings, setup, reference) for one in recordings}
        result = self._told(told, reference)
        if options.simulation:
            result |= self._simulated(recordings, result["joints"])
        return result

    def _decoded(self) -> list[Samples]:
        """Samples of every joint that moved; the late cycles that the live run counted are noted."""
        options = self._options
        logs = logs_of(options.source, given_map(options.frames, options.eds, self._robot))
        told_s = -math.inf

        def at(time_s: float) -> None:
            nonlocal told_s
            if options.paced and time_s >= told_s + 1.0:
                told_s = time_s
                self._note(f"{time_s:.0f} s")

        with _echo(options.echo) as echo:
            paced: dict[str, Any] = {"paced": options.paced, "echo": echo, "at": at}
            samples = samples_in(logs, self._robot.name, self._account, joints=options.joints, **paced)
        self._late = {motion.joint: motion.late_cycles for log in logs for motion in log.motions}
        return [samples[name] for name in dict.fromkeys([*self._robot.joint_names, *samples]) if name in samples]

    def _identified(
        self, samples: Samples, recordings: list[Samples], setup: RobotSetup, reference: FrictionProfile | None
    ) -> _Identified:
        name = samples.joint
        known = reference.joints.get(name) if reference else None
        told = {"identical": None, "difference_percent": None, "lost_rows": self._account.lost_rows.get(name)}
        try:
            profile = identify_joint(
                samples,
                setup.joint(name),
                method=self._options.method or (known.method if known else "aligned"),
                procedure=None if samples.marks else self._options.procedure,
                late_cycles=self._late.get(name, 0),
                company=recordings,
            )
        except IdentificationError as error:
            return None, {**failed_result(str(error)), **told}
        gate = self._account.gate(name)
        gates = profile.gates if gate is None else (*profile.gates, gate)
        profile = profile.model_copy(update={"gates": gates, "drive": profile.drive if known is None else known.drive})
        result = {**joint_result(profile), **told}
        if known is not None:
            distance = curve_distance(profile.curve(), known.curve(), known.velocity_rad_s[-1])
            result |= {"identical": profile.values() == known.values(), "difference_percent": distance.e_percent}
        return profile, result

    def _told(self, told: Mapping[str, _Identified], reference: FrictionProfile | None) -> dict[str, Any]:
        options = self._options
        joints = {name: joint for name, (_, joint) in told.items()}
        compared = None
        if reference is not None:
            wanted = set(options.joints or reference.joints) & set(reference.joints)
            compared = all(joints.get(name, {}).get("identical") is True for name in wanted)
        bad = {name: joint["remarks"] for name, joint in joints.items() if joint["outcome"] != "ok"}
        result: dict[str, Any] = {
            "outcome": "gate_failed" if bad else "ok",
            "robot": self._robot.name,
            "source": str(options.source.resolve()),
            "identical": compared,
            "position_rms_rad": None,
            "torque_rms_nm": None,
            "log": asdict(self._account) if self._account.frames else None,
            "profile": self._write({name: one for name, (one, _) in told.items() if one is not None}),
            "joints": joints,
        }
        if bad:
            result["error"] = GateFailed(
                "; ".join(f"joint {name}: {'; '.join(remarks)}" for name, remarks in bad.items()),
                where=str(options.source),
                next_step="results of the other joints stand",
            ).to_json()
        return result

    def _write(self, profiles: dict[str, JointProfile]) -> str | None:
        out, source = self._options.out, self._options.source
        if out is None or not profiles:
            return None
        out.mkdir(parents=True, exist_ok=True)
        logs = sorted(source.glob("bus*.blf")) if source.is_dir() else [source]
        provenance = Provenance.now(
            robot_file=self._robot.path.name,
            config_sha256=self._robot.digest,
            run=str(source.resolve()),
            log_sha256={log.name: file_sha256(log) for log in logs},
            notes=["identified from a replay"],
        )
        path = out / "profile.yaml"
        FrictionProfile(robot=self._robot.name, joints=profiles, provenance=provenance).save(path)
        return str(path.resolve())

    def _simulated(self, recordings: list[Samples], joints: dict[str, dict[str, Any]]) -> dict[str, Any]:
        """Root mean squares over all joints that the robot file can simulate; per joint beside them."""
        squares: dict[str, list[tuple[float, int]]] = {"position_rms_rad": [], "torque_rms_nm": []}
        files = []
        for samples in recordings:
            if not self._robot.file.joints[samples.joint].simulated:
                joints[samples.joint]["simulation"] = "the robot file has no `simulated` for this joint"
                continue
            simulated = simulate(self._robot, samples)
            if simulated.note:
                self._note(f"joint {samples.joint}: {simulated.note}")
            for key in squares:
                value = getattr(simulated, key)
                joints[samples.joint][key] = value
                if value is not None:
                    squares[key].append((value**2, len(samples)))
            if out := self._options.out:
                out.mkdir(parents=True, exist_ok=True)
                files.append(str(simulated.write_csv(out / f"simulated-{samples.joint}.csv").resolve()))
        return {**{key: _pooled(values) for key, values in squares.items()}, "simulated": files}


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


def _reference(options: ReplayOptions) -> FrictionProfile | None:
    if options.profile is not None:
        return load_profile(profile_file(options.profile))
    folder = options.source if options.source.is_dir() else options.source.parent
    own = folder / "profile.yaml"
    return load_profile(own) if (folder / "manifest.json").exists() and own.exists() else None


def _pooled(values: list[tuple[float, int]]) -> float | None:
    rows = sum(count for _, count in values)
    return math.sqrt(float(np.sum([square * count for square, count in values])) / rows) if rows else None


_CONTROL_PERIOD_S = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedReplay:
    """One joint, measured (``samples``) and simulated without noise on the same rows, shape (n,)."""

    samples: Samples
    position_rad: Array
    velocity_rad_s: Array
    torque_nm: Array
    note: str = ""  # what a reader should know of the set-points

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


def _last_asked(time_s: Array, asked_rad: Array, cycle_s: float) -> Array:
    """The set-point that was in force last before each row but the first, rad, shape (n - 1,)."""
    between = np.interp(time_s[1:] - cycle_s, time_s, asked_rad)
    return np.where(np.diff(time_s) > 1.5 * cycle_s, between, asked_rad[:-1])


def simulate(robot: Robot, samples: Samples) -> SimulatedReplay:
    """Stream a recording's set-points to the robot file's ``simulated`` joint (``ConfigError``: a wrong mapping).

    It starts at rest, powered, where the recording does; set-point k is in force from t_k on, and rows follow the
    timing of a live run (position at t_k, mean torque of what led to it). Where rows are further apart than cycles,
    the set-points between them are interpolated: the joint had them, too.
    """
    from frictid_hil.simulation.joint import JointModel  # loads numba; a replay without simulation does not need it
    from frictid_hil.simulation.servo_loop import ServoLoop

    with robot.document.locating():
        model = JointModel.of(robot.file.joints[samples.joint], samples.joint)
    quiet = replace(model, drive=replace(model.drive, torque_noise_per_mille=0.0))
    command = samples.position_command_rad
    note = "" if command is not None else "no set-points in the recording: the measured positions are followed"
    asked = samples.position_rad if command is None else command
    targets = _last_asked(samples.time_s, asked, 1.0 / robot.file.cycle_hz).tolist()
    loop = ServoLoop(quiet, period_s=_CONTROL_PERIOD_S, position_rad=float(samples.position_rad[0]))
    loop.power(True)
    loop.brake(False)
    steps_s = (np.diff(samples.time_ns) * 1e-9).tolist()
    position, velocity, torque = [loop.measured_position_rad], [0.0], [0.0]
    for step_s, target_rad in zip(steps_s, targets, strict=True):
        loop.advance(step_s, position_rad=target_rad)
        position.append(loop.measured_position_rad)
        velocity.append(loop.velocity_rad_s)
        torque.append(loop.torque_nm)
    if len(torque) > 1:
        torque[0] = torque[1]
    return SimulatedReplay(samples, np.array(position), np.array(velocity), np.array(torque), note)
