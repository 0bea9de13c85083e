"""The user's own model in closed loop along its recordings, as it was and changed: how far each is off the machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from scipy import signal

from frictid_hil.friction.metrics import paired_ratio_interval, rms_by_part
from frictid_hil.friction.trajectory import Array
from frictid_hil.jobs.gap.from_model import ArmSet, Motion
from frictid_hil.report.arm import PART_S, JointRun
from frictid_hil.simulation.model_edit import compiled_with
from frictid_hil.simulation.model_replay import replayed, why_not_replayed
from frictid_hil.simulation.native import Native

SHOWN_S = 20.0  # length of the withheld motion that a page shows
CUTOFF_HZ = 20.0  # low-pass of torques that are compared with measured ones
LEAST_PARTS = 4  # parts of a motion, at least, from which an interval is formed


def withheld(arm: ArmSet) -> list[Motion]:
    """The motions that are judged on; all where none is withheld."""
    return [motion for motion in arm.motions if motion.validation] or list(arm.motions)


def fitted(arm: ArmSet) -> list[Motion]:
    """The motions that were fitted; all where every one is withheld."""
    return [motion for motion in arm.motions if not motion.validation] or list(arm.motions)


def why_no_closed_loop(arm: ArmSet, motions: Sequence[Motion]) -> str | None:
    """Why the user's model cannot be run along these motions, or None where it can."""
    commanded = all(s.position_command_rad is not None for motion in motions for s in motion.samples.values())
    return why_not_replayed(arm.robot, arm.recorded, commanded)


def closed_loop_gap(arm: ArmSet, natives: Mapping[str, Native]) -> dict[str, Any]:
    """The user's own model, as it was and changed, run in MuJoCo along the logs that were not fitted.

    By joint ``before`` and ``after`` (RMS of the difference, torque behind a low-pass) and ``left_percent`` with its 95
    % interval, of the torque or else of the position; or ``reason``.
    """
    motions, names = withheld(arm), arm.recorded
    if reason := why_no_closed_loop(arm, motions):
        return {"reason": reason}
    before, after = _each(arm, {}, motions), _each(arm, natives, motions)
    left = {}
    for name in natives:
        k = names.index(name)
        part = 0 if np.all(np.isfinite(before[0][0][:, k])) else 1
        was, now = (_by_part(off[part], motions, k) for off in (before, after))
        interval = paired_ratio_interval(was, now)
        ratio = float(np.sqrt(np.mean(now**2) / np.mean(was**2)))
        ends = None if interval is None else [100.0 * end for end in interval]
        left[name] = {"value": 100.0 * ratio, "interval_95": ends}
    return {"before": _told(names, before), "after": _told(names, after), "left_percent": left}


def _told(names: Sequence[str], off: tuple[list[Array], list[Array]]) -> dict[str, Any]:
    torque, position = (_rms(motions) for motions in off)
    return {
        name: {"torque_nm": float(t) if np.isfinite(t) else None, "position_rad": float(p)}
        for name, t, p in zip(names, torque, position, strict=True)
    }


def _by_part(off: Sequence[Array], motions: Sequence[Motion], joint: int) -> Array:
    """RMS of one joint in parts of every motion."""
    parts = []
    for motion, values in zip(motions, off, strict=True):
        long_s = float(motion.time_s[-1] - motion.time_s[0])
        parts.append(rms_by_part(values[:, joint], max(LEAST_PARTS, int(long_s / PART_S))))
    return np.concatenate(parts)


def side_by_side(arm: ArmSet, natives: Mapping[str, Native]) -> tuple[JointRun, ...]:
    """Measured, the user's model and improved, by joint, along the last log not fitted; of torque, or position."""
    short = withheld(arm)[-1].beginning(SHOWN_S)
    if why_no_closed_loop(arm, [short]):
        return ()
    torque, position = _off(arm, arm.robot.compiled, short, {})
    better = _off(arm, compiled_with(arm.robot, natives), short, natives) if natives else None
    begin = len(short.time_s) - len(position)
    smooth = low_pass(short.time_s)
    runs = []
    for k, (name, samples) in enumerate(short.samples.items()):
        known = samples.torque_nm is not None
        part, measured = 1 - known, samples.position_rad[begin:]
        if samples.torque_nm is not None:
            measured = smooth(samples.torque_nm)[begin:]
        off = (torque if known else position)[:, k]
        improved = None if better is None else measured - better[part][:, k]
        quantity = "torque [N m]" if known else "position [rad]"
        if arm.robot.joint(name).prismatic:
            quantity = "force [N]" if known else "position [m]"
        runs.append(JointRun(name, short.name, quantity, short.time_s[begin:], measured, measured - off, improved))
    return tuple(runs)


def low_pass(time_s: Array) -> Callable[[Array], Array]:
    """What columns (n, ...) on these times look like below ``CUTOFF_HZ``, without any lag."""
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    b, a = signal.butter(4, min(CUTOFF_HZ, 0.2 * rate_hz) / (0.5 * rate_hz))
    return lambda columns: np.asarray(signal.filtfilt(b, a, columns, axis=0))


def gap_of(
    arm: ArmSet, natives: Mapping[str, Native], motions: Sequence[Motion], model: Any = None
) -> tuple[Array, Array]:
    """RMS of (torque, position) of recordings less the changed model's or ``model``'s, (k,) each; NaN: not known."""
    torque, position = _each(arm, natives, motions, model)
    return _rms(torque), _rms(position)


def _rms(motions: Sequence[Array]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.concatenate(motions) ** 2, axis=0)))


def _each(
    arm: ArmSet, natives: Mapping[str, Native], motions: Sequence[Motion], model: Any = None
) -> tuple[list[Array], list[Array]]:
    """(torque, position) of each recording less the model's."""
    if model is None:
        model = compiled_with(arm.robot, natives) if natives else arm.robot.compiled
    with ThreadPoolExecutor() as threads:  # MuJoCo steps without Python's lock
        every = list(threads.map(lambda motion: _off(arm, model, motion, natives), motions))
    return [torque for torque, _ in every], [position for _, position in every]


def _off(arm: ArmSet, model: Any, motion: Motion, natives: Mapping[str, Native]) -> tuple[Array, Array]:
    """(torque, position) of the recording less the model's, (n, k), from where the start is forgotten."""
    time = motion.time_s
    ran = replayed(model, *driven(arm, motion))
    begin = int(np.searchsorted(time, time[0] + 1.0))
    position = (motion.position_rad - ran.position_rad)[begin:]
    measured = [s.torque_nm for s in motion.samples.values() if s.torque_nm is not None]
    if len(measured) < len(motion.samples):
        return np.full_like(position, np.nan), position
    torque = np.stack(measured, axis=1) - reported(arm, natives) * ran.torque_nm
    return low_pass(time)(torque)[begin:], position


def driven(arm: ArmSet, motion: Motion) -> tuple[Sequence[str], Mapping[str, float], Array, Array, Array]:
    """(joints, held, time, position, command) of a motion."""
    commands = [s.position_command_rad for s in motion.samples.values() if s.position_command_rad is not None]
    return arm.recorded, arm.held, motion.time_s, motion.position_rad, np.stack(commands, axis=1)


def reported(arm: ArmSet, natives: Mapping[str, Native]) -> Array:
    """Torque that each drive reports over the torque that it gives, (k,)."""
    return np.array([natives[joint].reported if joint in natives else 1.0 for joint in arm.recorded])
