"""The improved model in the user's own file: what to change for each joint so that it comes nearer, and writing it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.write import dump
from frictid_hil.errors import FrictidError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Cause, Diagnosis
from frictid_hil.gap.findings import EVEN
from frictid_hil.jobs.gap.closed_loop import closed_loop_gap, fitted, gap_of, why_no_closed_loop
from frictid_hil.jobs.gap.draft import SLIP_RAD
from frictid_hil.jobs.gap.from_model import ArmSet, JointSet, postures
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import Drive, Encoder, JointModel, ServoGains
from frictid_hil.simulation.model_edit import changed_elsewhere, compiled_with, edited_files
from frictid_hil.simulation.native import FORMS, FRICTION, Native, Use, native_elements
from frictid_hil.simulation.native_check import in_posture, torque_difference

CHECKED_S = 10.0  # length of the withheld motion along which an export is compared with our own simulation
_FRICTIONLESS = FrictionCurve.through(np.array([1.0, 2.0]), np.array([1e-9, 1e-9]))


@dataclass(frozen=True, slots=True)
class Export:
    """One joint's part of an improved model."""

    model: JointModel
    native: Native
    form: str
    # By form that was tried: torque on withheld motion against our own simulation, over its RMS.
    off: Mapping[str, float]


def natives(made: Mapping[str, Export]) -> dict[str, Native]:
    """What is changed, by joint."""
    return {name: export.native for name, export in made.items()}


def exports(arm: ArmSet, found: Mapping[str, Diagnosis], *, apply: bool = False) -> dict[str, Export]:
    """What to change, of joints with named causes (``apply``: or the likeliest, if open) or drafted friction."""
    wanted = {name: applied(found[name], apply=apply) for name in arm.joints}
    if not any(s.torque_nm is not None for motion in arm.motions for s in motion.samples.values()):
        return _exports_by_position(arm, {name: effects for name, effects in wanted.items() if effects})
    made = {}
    for name, effects in wanted.items():
        joint = arm.joints[name]
        if (effects or joint.drafted) and joint.experiments.nominal.curve is not None:
            made[name] = export_of(arm, joint, effects, found[name].presliding_nm_per_rad)
    return made


def _exports_by_position(arm: ArmSet, wanted: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, Export]:
    """Without torques: what is late beyond the model's own loop, where that comes nearer to fitted positions."""
    motions, names = fitted(arm), arm.recorded
    if not wanted or why_no_closed_loop(arm, motions) is not None:
        return {}
    made = {}
    for name, effects in wanted.items():
        joint = arm.joints[name]
        late = {e: v for e, v in _beyond_own_lag(joint, effects).items() if e in _TIMING}
        model = joint_model(joint, late)
        native = native_elements(joint.believed, model, use_of(arm, name), "", friction=False)
        native.lost |= {e: _NEEDS_TORQUE for e in effects if e not in _TIMING}
        made[name] = Export(model, native, "", {})
    before = gap_of(arm, {}, motions)[1]
    after = gap_of(arm, natives(made), motions)[1]
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
    for cause in likely(found):
        told = {name: value.value for name, value in cause.parameters.items()}
        if "lag_s" in told:
            # A chain from command to position: what lags is an effect of its own, and what no delay holds lags too.
            late = told["delay_s"] - within("torque_delay", told)["delay_s"]
            effects["electrical_lag"] = within("electrical_lag", {"time_constant_s": told["lag_s"] + late})
        if values := within(cause.effect, told):
            effects[cause.effect] = all_effects()[cause.effect].complete(values)
    return effects


def beside(found: Diagnosis) -> dict[str, dict[str, float]]:
    """Errors of the belief that were fitted beside the causes, within their effects' bounds."""
    told = found.fitted_along.items()
    return {effect: within(effect, {n: v.value for n, v in values.items()}) for effect, values in told}


def likely(found: Diagnosis) -> Sequence[Cause]:
    """The causes at an even chance or better, or the first: the size of the others is hardly more than a guess."""
    return [cause for cause in found.causes if cause.confidence >= EVEN] or found.causes[:1]


def within(effect: str, told: Mapping[str, float]) -> dict[str, float]:
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
        or curve.coulomb_nm / SLIP_RAD,
        encoder=Encoder("motor", 0.0),
        drive=Drive(rated, limit, 0.0, 0.0, 0.0),
        servo=ServoGains(0.0, 0.0, 0.0),
    ).with_effects(effects)


def export_of(
    arm: ArmSet, joint: JointSet, effects: Mapping[str, Mapping[str, float]], presliding_nm_per_rad: float | None
) -> Export:
    """A joint with these effects, in the form of friction nearest to our simulation; stiffness as believed if None."""
    robot, name = arm.robot, joint.believed.name
    model = joint_model(joint, effects, presliding_nm_per_rad)
    use = use_of(arm, name)
    rewritten = bool(joint.drafted or FRICTION & set(effects))
    forms = FORMS if rewritten and not robot.urdf else ("loss",)
    time, command, posture = _withheld(arm, name)
    ours = in_posture(robot, name, model, posture)
    tried: dict[str, float] = {}
    forms_of: dict[str, Native] = {}
    for form in forms:
        native = native_elements(joint.believed, model, use, form, friction=rewritten)
        if native in forms_of.values():
            continue
        try:
            exported = compiled_with(robot, {name: native})
            tried[form] = torque_difference(robot, exported, name, ours, posture, time, command)
        except FrictidError:
            # An older MuJoCo has not every element.
            continue
        forms_of[form] = native
    if not tried:
        compiled_with(robot, {name: native})  # raises, and says why
    best = min(tried, key=lambda form: tried[form] if np.isfinite(tried[form]) else np.inf)
    return Export(model, forms_of[best], best, tried)


def use_of(arm: ArmSet, name: str) -> Use:
    """Speeds and loads of a joint in the recordings."""
    samples = [motion.samples[name] for motion in arm.motions]
    speed = np.concatenate([np.abs(np.gradient(s.position_rad, s.time_s)) for s in samples])
    moving = speed[speed > 0.02 * float(np.quantile(speed, 0.99))]
    top = float(np.quantile(moving, 0.999))
    step_s = float(arm.robot.compiled.opt.timestep)
    gravity_nm, own_share = _gravity(arm, name)
    return Use(moving[moving <= top], gravity_nm, step_s, own_share)


def _gravity(arm: ArmSet, name: str) -> tuple[Array, float]:
    """Gravity torque that a joint carries along the recordings, (n,), and its own body's share of it."""
    robot = arm.robot
    names = arm.recorded
    some = postures(arm.motions, 200)
    still, column = np.zeros_like(some), names.index(name)
    whole = robot.rigid_body_torque(names, some, still, still, arm.held)[:, column]
    body = int(robot.compiled.jnt_bodyid[robot.number(name)])
    masses = robot.compiled.body_mass.copy()
    try:
        robot.compiled.body_mass[[k for k in range(masses.size) if k != body]] = 0.0
        own = robot.rigid_body_torque(names, some, still, still, arm.held)[:, column]
    finally:
        robot.compiled.body_mass[:] = masses
    return whole, float(own @ whole) / max(float(whole @ whole), 1e-12) or 1e-9


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

    ``UsageError``: a file is there. ``FrictidError``: the edited model is not the old one in all else; nothing is
    written.
    """
    changes = natives(made)
    after = compiled_with(arm.robot, changes)
    if changed := changed_elsewhere(arm.robot.compiled, after, changes):
        raise FrictidError(
            f"the edit would change more than was meant: {', '.join(changed[:5])}; nothing is written",
            where=str(arm.robot.path),
        )
    files = edited_files(arm.robot, changes, out)
    if arm.robot.urdf:
        # A URDF cannot hold most effects: they stand beside it, as a robot file has them under `simulated`.
        effects = dump({name: {"effects": export.model.effects} for name, export in made.items()})
        files[out.with_suffix(".effects.yaml")] = effects.encode()
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


Effects = Mapping[str, Mapping[str, float]]


def nearer_only(arm: ArmSet, made: Mapping[str, Export]) -> tuple[dict[str, Export], dict[str, Any]]:
    """The changes after which each joint is nearer to the machine in closed loop, and ``closed_loop_gap`` with them.

    A joint whose interval reaches the gap that it had gets a part of its causes instead, the one that comes nearest
    along the fitted motions, if any does. ``left_out`` says by joint which ``effects`` were not written,
    ``left_percent`` of the gap with them, and what was written ``instead``.
    """
    kept = dict(made)
    left_out: dict[str, Any] = {}
    while True:
        told = closed_loop_gap(arm, natives(kept))
        left = told.get("left_percent", {})
        farther = {n: one for n, one in left.items() if not one["interval_95"] or one["interval_95"][1] >= 100.0}
        if not farther:
            return kept, {**told, "left_out": left_out}
        # One by one: a joint that is far off pulls at its neighbours.
        name = max(farther, key=lambda joint: float(farther[joint]["value"]))
        other = None if name in left_out else _another(arm, kept, name)
        written = set(other.model.effects) if other is not None else set()
        first = left_out.get(name, {"left_percent": farther[name]})
        left_out[name] = {
            "effects": [e for e in made[name].model.effects if e not in written] or ["friction"],
            "left_percent": first["left_percent"],
            "instead": sorted(written),
        }
        if other is None:
            del kept[name]
        else:
            kept[name] = other


def left_out_words(told: Mapping[str, Any]) -> list[str]:
    """A sentence for each joint of which something was not written; ``told`` is what ``nearer_only`` told."""
    words = []
    for name, one in told.get("left_out", {}).items():
        left, ends = one["left_percent"]["value"], one["left_percent"]["interval_95"]
        reach = f" ({ends[0]:.0f} to {ends[1]:.0f} %)" if ends else ""
        instead = f"{' and '.join(one['instead'])} alone" if one["instead"] else "nothing"
        words.append(
            f"{name}: {' and '.join(one['effects'])} would leave {left:.0f} %{reach} of its gap on recordings that "
            f"were not fitted, so {instead} is written"
        )
    return words


def _another(arm: ArmSet, made: Mapping[str, Export], name: str) -> Export | None:
    """A part of a joint's causes that comes nearest along the fitted motions; None where the joint as it was does."""
    if not made[name].form:
        return None  # chosen by the fitted positions already
    joint, others = arm.joints[name], {n: native for n, native in natives(made).items() if n != name}
    column = arm.recorded.index(name)

    def off(export: Export | None) -> float:
        changes = others if export is None else {**others, name: export.native}
        torque, position = gap_of(arm, changes, fitted(arm))
        return float(torque[column] if torque[column] >= 0.0 else position[column])

    tried = [
        export_of(arm, joint, effects, made[name].model.presliding_stiffness_nm_per_rad)
        for effects in _parts(made[name].model.effects)
    ]
    return min([None, *tried], key=off)


def _parts(effects: Effects) -> Iterator[Effects]:
    """Each effect alone, and all but each."""
    if len(effects) < 2:
        return
    for name, values in effects.items():
        yield {name: values}
    if len(effects) > 2:
        for name in effects:
            yield {other: values for other, values in effects.items() if other != name}
