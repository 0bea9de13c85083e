"""The improved model in the user's own file, and how near it comes: measured in the user's engine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from frictid_hil.config.write import dump
from frictid_hil.errors import FrictidError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.jobs.gap.from_model import ArmSet, JointSet, Motion
from frictid_hil.report.arm import JointRun
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import Drive, Encoder, JointModel, ServoGains
from frictid_hil.simulation.model_edit import changed_elsewhere, compiled_with, edited_files
from frictid_hil.simulation.model_replay import replayed, why_not_replayed
from frictid_hil.simulation.native import FORMS, FRICTION, Native, Use, native_elements
from frictid_hil.simulation.native_check import in_posture, torque_difference

FARTHER = 1.05
"""Gap after over that before, from which an improved joint is told to be none."""
SHOWN_S = 20.0
"""Length of the withheld motion that a page shows."""
CHECKED_S = 10.0
"""Length of the withheld motion along which an export is compared with our own simulation."""
PRESLIDING_RAD = 2e-4
"""Travel in which friction builds up, where nobody says it."""
CUTOFF_HZ = 20.0
"""Low-pass of torques that are compared with measured ones."""
_FRICTIONLESS = FrictionCurve.through(np.array([1.0, 2.0]), np.array([1e-9, 1e-9]))


@dataclass(frozen=True, slots=True)
class Export:
    """One joint's part of an improved model.

    Attributes:
        model: the joint with its causes, as we simulate it.
        native: what is changed in the file.
        form: of its friction.
        off: by form that was tried, torque on withheld motion against our own simulation, over its RMS.
    """

    model: JointModel
    native: Native
    form: str
    off: Mapping[str, float]


def exports(arm: ArmSet, found: Mapping[str, Diagnosis], *, apply: bool = False) -> dict[str, Export]:
    """What to change in the user's model, by joint; only joints with named causes, or drafted friction.

    Args:
        arm: model and recordings.
        found: diagnosis of every joint.
        apply: take the likeliest causes where the verdict is open, too.
    """
    wanted = {name: applied(found[name], apply=apply) for name in arm.joints}
    if not any(s.torque_nm is not None for motion in arm.motions for s in motion.samples.values()):
        return _exports_by_position(arm, {name: effects for name, effects in wanted.items() if effects})
    made = {}
    for name, effects in wanted.items():
        joint = arm.joints[name]
        if (effects or joint.drafted) and joint.experiments.nominal.curve is not None:
            made[name] = _export(arm, joint, effects, found[name].presliding_nm_per_rad)
    return made


def _exports_by_position(arm: ArmSet, wanted: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, Export]:
    """Where no torque is known: what is late, on joints where the user's engine comes nearer to the fitted positions.

    A chain from command to position holds the lag of the servo's loop, which the model has too: it is taken off.
    """
    fitted = [motion for motion in arm.motions if not motion.validation] or arm.motions
    names = arm.recorded
    if not wanted or why_not_replayed(arm.robot, names, _commanded(fitted, names)) is not None:
        return {}
    made = {}
    for name, effects in wanted.items():
        joint = arm.joints[name]
        late = {e: v for e, v in _beyond_own_lag(joint, effects).items() if e in _TIMING}
        model = joint_model(joint, late)
        native = native_elements(joint.believed, model, use_of(arm, name), "", friction=False)
        native.lost |= {e: _NEEDS_TORQUE for e in effects if e not in _TIMING}
        made[name] = Export(model, native, "", {})
    before = gap_of(arm, arm.robot.compiled, fitted)[1]
    after = gap_of(arm, compiled_with(arm.robot, {n: export.native for n, export in made.items()}), fitted)[1]
    nearer = {name for name, off, was in zip(names, after, before, strict=True) if off < was}
    return {name: export for name, export in made.items() if name in nearer}


_NEEDS_TORQUE = "not written: without a torque it may as well be the dead band or the gain of the servo's own loop"
_TIMING = {"torque_delay", "electrical_lag"}


def _beyond_own_lag(joint: JointSet, effects: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Effects with the lag of the model's own position loop taken off what is late."""
    left = {name: dict(values) for name, values in effects.items()}
    motor = joint.believed.motor
    own_s = (motor.kv_nm_s_per_rad + joint.believed.damping[0]) / motor.kp_nm_per_rad if motor is not None else 0.0
    for effect, number in (("electrical_lag", "time_constant_s"), ("torque_delay", "delay_s")):
        if effect in left:
            taken = min(own_s, left[effect][number])
            left[effect][number] -= taken
            own_s -= taken
            if left[effect][number] <= 0.0:
                del left[effect]
    return left


def applied(found: Diagnosis, *, apply: bool) -> dict[str, dict[str, float]]:
    """The effects that the verdict allows to be written, with parameters within their bounds."""
    if found.verdict != "explained" and not (apply and found.verdict in ("ambiguous", "unknown")):
        return {}
    effects: dict[str, dict[str, float]] = {}
    for cause in found.causes:
        told = {name: value.value for name, value in cause.parameters.items()}
        if "lag_s" in told:
            # A chain from command to position: what lags is an effect of its own, and what no delay holds lags too.
            late = told["delay_s"] - _within("torque_delay", told)["delay_s"]
            effects["electrical_lag"] = _within("electrical_lag", {"time_constant_s": told["lag_s"] + late})
        if values := _within(cause.effect, told):
            effects[cause.effect] = all_effects()[cause.effect].complete(values)
    return effects


def _within(effect: str, told: Mapping[str, float]) -> dict[str, float]:
    """An effect's own parameters, within their bounds."""
    limits = {p.name: p for p in all_effects()[effect].parameters}
    return {n: float(np.clip(v, limits[n].lower, limits[n].upper)) for n, v in told.items() if n in limits}


def joint_model(
    joint: JointSet, effects: Mapping[str, Mapping[str, float]], presliding_nm_per_rad: float | None = None
) -> JointModel:
    """The believed joint with effects, as we simulate it; its presliding stiffness as believed unless given."""
    nominal = joint.experiments.nominal
    assert nominal.inertia_kg_m2 is not None
    curve = nominal.curve or _FRICTIONLESS
    motor = joint.believed.motor
    limit = motor.torque_limit_nm if motor is not None else float("inf")
    rated = nominal.rated_torque_nm or (limit if np.isfinite(limit) else 1.0)
    return JointModel(
        inertia_kg_m2=nominal.inertia_kg_m2,
        motor_inertia_share=min(0.99, max(0.01, nominal.motor_inertia_share or 0.3)),
        gravity_cos_nm=nominal.gravity_cos_nm,
        gravity_sin_nm=nominal.gravity_sin_nm,
        gear_ratio=nominal.gear_ratio or 1.0,
        friction=curve,
        presliding_stiffness_nm_per_rad=presliding_nm_per_rad
        or nominal.presliding_stiffness_nm_per_rad
        or curve.coulomb_nm / PRESLIDING_RAD,
        encoder=Encoder("motor", 0.0),
        drive=Drive(rated, limit, 0.0, 0.0, 0.0),
        servo=ServoGains(0.0, 0.0, 0.0),
    ).with_effects(effects)


def _export(
    arm: ArmSet, joint: JointSet, effects: Mapping[str, Mapping[str, float]], presliding_nm_per_rad: float | None
) -> Export:
    robot, name = arm.robot, joint.believed.name
    model = joint_model(joint, effects, presliding_nm_per_rad)
    use = use_of(arm, name)
    rewritten = bool(joint.drafted or FRICTION & set(effects))
    forms = FORMS if rewritten and not robot.urdf else ("loss",)
    time, command, posture = _withheld(arm, name)
    ours = in_posture(robot, name, model, posture)
    tried: dict[str, float] = {}
    natives = {}
    for form in forms:
        native = native_elements(joint.believed, model, use, form, friction=rewritten)
        try:
            exported = compiled_with(robot, {name: native})
            tried[form] = torque_difference(robot, exported, name, ours, posture, time, command)
        except FrictidError:
            # An older MuJoCo has not every element.
            continue
        natives[form] = native
    if not tried:
        compiled_with(robot, {name: native})  # raises, and says why
    best = min(tried, key=lambda form: tried[form] if np.isfinite(tried[form]) else np.inf)
    return Export(model, natives[best], best, tried)


def use_of(arm: ArmSet, name: str) -> Use:
    """Speeds and places of a joint in the recordings."""
    samples = [motion.samples[name] for motion in arm.motions]
    speed = np.concatenate([np.abs(np.gradient(s.position_rad, s.time_s)) for s in samples])
    position = np.concatenate([s.position_rad for s in samples])
    moving = speed[speed > 0.02 * float(np.quantile(speed, 0.99))]
    top = float(np.quantile(moving, 0.999))
    step_s = float(arm.robot.compiled.opt.timestep)
    return Use(moving[moving <= top], position, step_s, _own_gravity_share(arm, name))


def _own_gravity_share(arm: ArmSet, name: str) -> float:
    """Gravity torque of the joint's own body over that of all that it carries, along the recordings."""
    robot = arm.robot
    names = arm.recorded
    every = np.concatenate([motion.position_rad for motion in arm.motions])
    some = every[:: max(1, every.shape[0] // 200)]
    still, column = np.zeros_like(some), names.index(name)
    whole = robot.rigid_body_torque(names, some, still, still, arm.held)[:, column]
    body = int(robot.compiled.jnt_bodyid[robot.number(name)])
    masses = robot.compiled.body_mass.copy()
    try:
        robot.compiled.body_mass[[k for k in range(masses.size) if k != body]] = 0.0
        own = robot.rigid_body_torque(names, some, still, still, arm.held)[:, column]
    finally:
        robot.compiled.body_mass[:] = masses
    return float(own @ whole) / max(float(whole @ whole), 1e-12) or 1e-9


def _withheld(arm: ArmSet, name: str) -> tuple[Array, Array, Array]:
    """(time, command, posture of the whole model) of a motion that was not fitted."""
    motion = next((m for m in arm.motions if m.validation), arm.motions[-1])
    samples = motion.samples[name]
    command = samples.position_rad if samples.position_command_rad is None else samples.position_command_rad
    keep = samples.time_s - samples.time_s[0] <= CHECKED_S
    middle = {other: float(np.median(s.position_rad)) for other, s in motion.samples.items()}
    return samples.time_s[keep], command[keep], arm.robot.posture({**arm.held, **middle})


def write_model(arm: ArmSet, made: Mapping[str, Export], out: Path, *, force: bool = False) -> dict[str, Any]:
    """Write the user's model with the changes, after comparing it with the original.

    Raises:
        UsageError: a file is there already.
        FrictidError: the edited model is not the old one in all else; nothing is written.

    Returns:
        ``model`` and ``files`` (absolute paths), ``joints`` by name: where each effect went, what is lost, and the
        torque difference in percent.
    """
    natives = {name: export.native for name, export in made.items()}
    after = compiled_with(arm.robot, natives)
    if changed := changed_elsewhere(arm.robot.compiled, after, natives):
        raise FrictidError(
            f"the edit would change more than was meant: {', '.join(changed[:5])}; nothing is written",
            where=str(arm.robot.path),
        )
    files = edited_files(arm.robot, natives, out)
    if arm.robot.urdf:
        files[out.with_suffix(".effects.yaml")] = _sidecar(made).encode()
    refuse_overwriting(files, force=force)
    for path, content in files.items():
        write_whole(path, content)
    return {
        "model": str(out.resolve()),
        "files": [str(path.resolve()) for path in files],
        "joints": {name: _account(export, urdf=arm.robot.urdf) for name, export in made.items()},
    }


def _account(export: Export, *, urdf: bool) -> dict[str, Any]:
    placed = dict(export.native.placed)
    lost = dict(export.native.lost)
    if urdf:
        held = {"friction": "dynamics: damping and friction", "torque_saturation": "limit: effort"}
        lost |= {
            e: "a URDF cannot hold it: see the file of effects beside it"
            for e in placed
            if e not in FRICTION | set(held)
        }
        placed = {e: held["friction" if e in FRICTION else e] for e in placed if e in FRICTION | set(held)}
    return {
        "effects": {name: dict(values) for name, values in export.model.effects.items()},
        "placed": placed,
        "lost": lost,
        "remarks": list(export.native.remarks),
        "friction_form": export.form,
        "torque_difference_percent": 100.0 * export.off[export.form] if export.off else None,
        "tried_percent": {form: 100.0 * off for form, off in export.off.items()},
    }


def _sidecar(made: Mapping[str, Export]) -> str:
    """All effects of the joints, as a robot file has them under ``simulated``; a URDF cannot hold most."""
    return dump({name: {"effects": export.model.effects} for name, export in made.items()})


def closed_loop_gap(arm: ArmSet, made: Mapping[str, Export]) -> dict[str, Any]:
    """The user's own model, as it was and improved, run in MuJoCo along the logs that were not fitted.

    Returns:
        ``before`` and ``after`` by joint (``torque_nm``, ``position_rad``; RMS of the difference to the recording,
        torque behind a low-pass) and ``farther``, the changed joints that came no nearer; or ``reason``.
    """
    judged = [motion for motion in arm.motions if motion.validation] or list(arm.motions)
    names = arm.recorded
    if reason := why_not_replayed(arm.robot, names, _commanded(judged, names)):
        return {"reason": reason}
    natives = {name: export.native for name, export in made.items()}
    models = {"before": arm.robot.compiled, "after": compiled_with(arm.robot, natives)}
    told: dict[str, Any] = {}
    for when, model in models.items():
        torque, position = gap_of(arm, model, judged)
        told[when] = {
            name: {
                "torque_nm": float(torque[k]) if np.isfinite(torque[k]) else None,
                "position_rad": float(position[k]),
            }
            for k, name in enumerate(names)
        }
    told["farther"] = [name for name in made if _farther(told["before"][name], told["after"][name])]
    return told


def _farther(before: Mapping[str, float | None], after: Mapping[str, float | None]) -> bool:
    """Whether a change took the user's model away from the recordings: by torque, or by position without any."""
    number = "position_rad" if before["torque_nm"] is None else "torque_nm"
    was, now = before[number], after[number]
    return was is not None and now is not None and not now <= FARTHER * was


def side_by_side(arm: ArmSet, made: Mapping[str, Export]) -> tuple[JointRun, ...]:
    """Each joint along the last log that was not fitted, its beginning: measured, the user's model, and improved.

    Nothing where ``closed_loop_gap`` has a reason. Torques behind the low-pass; positions where no torque is known.
    """
    motion = next((m for m in reversed(arm.motions) if m.validation), arm.motions[-1])
    names = arm.recorded
    if why_not_replayed(arm.robot, names, _commanded([motion], names)):
        return ()
    keep = int(np.searchsorted(motion.time_s, motion.time_s[0] + SHOWN_S))
    short = replace(motion, samples={n: s.select(np.arange(len(s)) < keep) for n, s in motion.samples.items()})
    torque, position = _off(arm, arm.robot.compiled, short)
    better = _off(arm, compiled_with(arm.robot, {n: e.native for n, e in made.items()}), short) if made else None
    begin = keep - len(position)
    low_pass = _low_pass(short.time_s)
    runs = []
    for k, (name, samples) in enumerate(short.samples.items()):
        known = samples.torque_nm is not None
        part, measured = 1 - known, samples.position_rad[begin:]
        if samples.torque_nm is not None:
            measured = low_pass(samples.torque_nm)[begin:]
        off = (torque if known else position)[:, k]
        improved = None if better is None else measured - better[part][:, k]
        quantity = "torque [N m]" if known else "position [rad]"
        if arm.robot.joint(name).prismatic:
            quantity = "force [N]" if known else "position [m]"
        runs.append(JointRun(name, motion.name, quantity, short.time_s[begin:], measured, measured - off, improved))
    return tuple(runs)


def _low_pass(time_s: Array) -> Callable[[Array], Array]:
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    b, a = signal.butter(4, min(CUTOFF_HZ, 0.2 * rate_hz) / (0.5 * rate_hz))
    return lambda columns: np.asarray(signal.filtfilt(b, a, columns, axis=0))


def _commanded(motions: Sequence[Motion], names: Sequence[str]) -> bool:
    return all(motion.samples[name].position_command_rad is not None for motion in motions for name in names)


def gap_of(arm: ArmSet, model: Any, motions: Sequence[Motion]) -> tuple[Array, Array]:
    """RMS of (torque, position) of recordings less the model's, (k,) each; torque is NaN where none was recorded."""
    with ThreadPoolExecutor() as threads:  # MuJoCo steps without Python's lock
        every = list(threads.map(lambda motion: _off(arm, model, motion), motions))
    torque, position = (np.concatenate([off[part] for off in every]) for part in (0, 1))
    return np.sqrt(np.mean(torque**2, axis=0)), np.sqrt(np.mean(position**2, axis=0))


def _off(arm: ArmSet, model: Any, motion: Motion) -> tuple[Array, Array]:
    """(torque, position) of the recording less the model's, (n, k), from where the start is forgotten."""
    names = tuple(motion.samples)
    samples = list(motion.samples.values())
    time = samples[0].time_s
    command = np.stack([s.position_command_rad for s in samples if s.position_command_rad is not None], axis=1)
    ran = replayed(model, names, arm.held, time, motion.position_rad, command)
    begin = int(np.searchsorted(time, time[0] + 1.0))
    position = (motion.position_rad - ran.position_rad)[begin:]
    measured = [s.torque_nm for s in samples]
    if any(torque is None for torque in measured):
        return np.full_like(position, np.nan), position
    torque = np.stack([t for t in measured if t is not None], axis=1) - ran.torque_nm
    return _low_pass(time)(torque)[begin:], position
