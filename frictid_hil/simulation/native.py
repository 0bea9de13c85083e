"""Physical effects as MuJoCo's own elements: which effect goes where in an MJCF, and what is lost.

``native_elements`` says what to change on a joint so that a model without any code beside it moves like the simulated
joint. Sliding friction has four forms, and whoever writes the file measures which one is nearest:

- ``spring``: a spring that yields (MuJoCo 4) carries the level, ``damping`` of three numbers the rest. No creep.
- ``lugre``: the same, and a passive ``dcmotor`` with LuGre friction for what rises above the level near standstill.
- ``ramps``: the spring carries the level at standstill, and dampers that push, each up to a limit, what motion takes.
- ``loss``: ``frictionloss`` with the solver settings that creep least.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import lsq_linear

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation import packing, plant
from frictid_hil.simulation.compose import kernel
from frictid_hil.simulation.inverse_loops import soft_spring
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.robot_model import ModelJoint
from frictid_hil.simulation.steady import steady_friction_nm

FORMS = ("spring", "lugre", "ramps", "loss")

FRICTION = {  # effects that are a part of sliding friction
    "stribeck", "viscous_nonlinearity", "direction_asymmetry", "load_dependent_friction", "directional_efficiency",
    "presliding_hysteresis", "stiction_breakaway", "friction_level_error", "viscous_error", "temperature_drift",
}  # fmt: skip
_STEEP = 1.2  # the damping polynomial may not fall up to this multiple of the fastest speed
_STIFFEST = 0.4  # stiffness times squared step over inertia, at most: what an explicit spring bears without ringing
_STEP_RULE = 1.3  # sigma1 over the least that LuGre needs at the model's step
_SMALLEST_RISE = 1e-3  # rise at standstill over the level, below which it is rounding
_RISE_BASE = 0.05  # level that LuGre needs at speed, over its rise; taken off the spring
_KNEES = (0.12, 0.4, 0.9, 1.8, 3.4)  # ends of the ramps over the curve's speed: an exponential's fall to 1 %
_HOLDS = 1.2  # damping of what holds the ramps at rest over theirs
_HOLDS_NM = 2e-3  # its level over that of the joint
_LOOP_ENDS = 20.0  # travel over that of a presliding loop, after which it is turned over
_LOOP_KNOTS = (0.3, 0.6, 0.85, 0.97)  # parts of its turn-over at which one of the springs that stand for it yields
_LOADS = (np.arange(12) + 0.5) / 12  # quantiles of the load at which friction that depends on it is read
_LEAST_SHARE = 0.03  # share of a loop below which a spring is not worth its line
_POWERS = ((1, 2, 3), (1, 2), (1,))  # of damping's polynomial, to be tried in turn
_Damping = tuple[float, float, float]
FAR_RAD = 3e5  # where a spring is anchored whose torque shall not depend on the joint


@dataclass(frozen=True, slots=True)
class Use:
    """How and where the joint is used."""

    speed_rad_s: Array  # speeds of the recordings, shape (n,), positive
    load_nm: Array  # torque passed on to the link along the recordings, shape (n,)
    timestep_s: float  # of the user's model
    own_gravity_share: float = 1.0  # gravity torque of the joint's own body over that of all that it carries


@dataclass(slots=True)
class Native:
    """What to change."""

    joint: dict[str, str] = field(default_factory=dict)  # attributes of the joint
    # Attributes of its actuators, by name in MuJoCo's tables (of those that drive it).
    actuators: dict[str, str] = field(default_factory=dict)
    gravity_share: float | None = None  # error of the gravity of its own body; None leaves the body as it is
    more_joints: list[str] = field(default_factory=list)  # joints to stand after it in its body
    more_actuators: list[str] = field(default_factory=list)  # passive actuators
    more_tendons: list[str] = field(default_factory=list)  # fixed tendons
    placed: dict[str, str] = field(default_factory=dict)  # where each effect went, by name
    lost: dict[str, str] = field(default_factory=dict)  # what is lost, by effect
    remarks: list[str] = field(default_factory=list)  # what its user has to do
    reported: float = 1.0  # torque that the drive reports over the torque that it gives, which is what MuJoCo tells


def native_elements(believed: ModelJoint, model: JointModel, use: Use, form: str, *, friction: bool) -> Native:
    """What makes the user's joint move like ``model``, in a form of friction out of ``FORMS``.

    Friction is written anew only where asked for; else it stays as the file has it, as no cause concerns it.
    """
    native = Native()
    if friction:
        _write_friction(native, believed, model, use, form)
    _write_plant(native, believed, model, use)
    _write_drive(native, believed, model, use)
    _write_transmission(native, believed, model, use)
    for name, why in _NOWHERE.items():
        if name in model.effects:
            native.lost[name] = why
    return native


_NOWHERE = {
    "velocity_lag": "MuJoCo's loop acts on the true velocity: filter it in your own controller",
    "encoder_quantisation": "MuJoCo's sensors have no steps: round the position in your own code",
    "transmission_error": "MuJoCo has no element for it: add it to the position in your own code",
}


def curve_numbers(model: JointModel, use: Use) -> tuple[float, float, float, _Damping]:
    """(level, rise at standstill, Stribeck speed, damping polynomial) that stand nearest to the joint's sliding."""
    fastest = float(np.max(use.speed_rad_s))
    speed = _speeds(use, falling="stribeck" in model.effects)
    odd, _ = _sliding(model, speed, use)
    if "stribeck" in model.effects:
        return _with_stribeck(speed, odd, fastest)
    level, poly = _level_and_damping(speed, odd, fastest)
    return level, 0.0, 0.0, poly


def _speeds(use: Use, *, falling: bool = False) -> Array:
    """Speeds as often as they were driven, and one near standstill; many of those where friction is ``falling``."""
    driven, fastest = np.quantile(use.speed_rad_s, np.linspace(0.02, 1.0, 150)), float(np.max(use.speed_rad_s))
    slow = np.geomspace(1e-3, 0.3, 100) if falling else np.array([1e-3])
    speeds: Array = np.unique(np.concatenate([driven, slow * fastest]))
    return speeds


def _write_friction(native: Native, believed: ModelJoint, model: JointModel, use: Use, form: str) -> None:
    fastest = float(np.max(use.speed_rad_s))
    speed = _speeds(use, falling=form == "lugre")
    odd, even = _sliding(model, speed, use)
    soft = model.effects.get("presliding_hysteresis")
    ramps: list[tuple[float, float]] = []
    dry, rise, at, poly = _with_stribeck(speed, odd, fastest) if form == "lugre" else (0.0, 0.0, 0.0, (0.0, 0.0, 0.0))
    if form == "ramps":
        dry, ramps, poly = _with_ramps(speed, odd, fastest)
    elif rise <= _SMALLEST_RISE * dry:
        dry, poly = _level_and_damping(speed, odd, fastest)
        rise = at = 0.0
    # Friction builds up over a travel that does not depend on the level.
    stiffness = model.presliding_stiffness_nm_per_rad * dry / model.friction.coulomb_nm
    soft_nm = soft["share"] * dry if soft else 0.0
    dry = max(1e-9, dry - soft_nm)
    inertia, step = model.inertia_kg_m2, use.timestep_s
    stiffness = min(stiffness * dry / (dry + soft_nm), _STIFFEST * inertia / step**2)
    name = believed.name
    native.joint |= {"damping": words(poly), "frictionloss": "0"}
    if rise > 0.0:
        base = _RISE_BASE * rise
        sigma = min(stiffness * rise / dry, inertia / (_STEP_RULE * step**2))
        lugre = (sigma, _STEP_RULE * step * sigma, base, base + rise, at)
        native.more_actuators.append(_passive(name, "stribeck", f'lugre="{words(lugre)}"'))
        dry -= base
    if ramps:
        _write_ramps(native, name, ramps, dry, dry / stiffness)
    if form == "loss":
        native.joint |= {"frictionloss": _word(dry), "solimpfriction": "0.9999 0.9999", "solreffriction": "0.004 1"}
        where = "joint: frictionloss (stiff solver settings) and damping of three numbers"
        if believed.presliding_nm_per_rad is not None and believed.spring_nm_per_rad == 0.0:
            native.joint["stiffness"] = "0"
    else:
        native.remarks.append(_PLASTIC)
        where = "joint: springyield and damping of three numbers"
        if believed.spring_nm_per_rad == 0.0:
            native.joint |= {"stiffness": _word(stiffness), "springyield": _word(dry / stiffness), "springref": "0"}
        else:
            native.more_tendons.append(_slipping(f"{name}_friction", name, stiffness, dry / stiffness))
            where = "tendon with springyield, and damping of three numbers"
    if soft and soft_nm > 0.0:
        for number, (share, yields_rad) in enumerate(_slip_elements(soft), 1):
            stiffness = share * soft_nm / yields_rad
            native.more_tendons.append(_slipping(f"{name}_presliding_{number}", name, stiffness, yields_rad))
        where += "; presliding: more springs that yield, one after the other"
    if abs(even) > 1e-3 * max(dry, 1e-9):
        native.more_tendons.append(_constant(f"{name}_asymmetry", name, even))
        where += "; asymmetry: a far spring (constant torque)"
    if rise > 0.0:
        where += "; the rise near standstill: passive dcmotor (LuGre)"
    if ramps:
        where += "; the fall above standstill: passive dampers the other way, each up to a limit"
    present = sorted(FRICTION & set(model.effects))
    native.placed |= dict.fromkeys(present or ["friction"], where)
    native.lost |= {effect: why for effect, why in _FRICTION_LOSES.items() if effect in model.effects}
    if form in ("spring", "loss") and "stribeck" in model.effects:
        native.lost["stribeck"] = "the fall of friction above standstill: level and damping are its best fit"


_PLASTIC = "a spring that yields: where you set qpos by hand or by a keyframe, set data.plastic to the same"
_FRICTION_LOSES = {
    "direction_asymmetry": "asymmetry that changes with speed or ends at rest: only its mean is written",
    "load_dependent_friction": "the load: friction of the recordings' mean load is written",
    "directional_efficiency": "the load: friction of the recordings' mean load is written",
    "presliding_hysteresis": "the rounded loop: an elasto-plastic element of the same travel is written",
    "stiction_breakaway": "the growth with rest",
    "temperature_drift": "the temperature: friction of a cold joint is written",
}


def _slip_elements(hysteresis: Mapping[str, float]) -> list[tuple[float, float]]:
    """(share, yield in rad) of springs that yield one after the other along the rounded loop of an effect."""
    distance = hysteresis["distance_rad"]
    travel = np.linspace(0.0, _LOOP_ENDS * distance, 2000)
    position = np.concatenate([[0.0, -_LOOP_ENDS * distance], travel - _LOOP_ENDS * distance])
    loop = soft_spring(position, distance, hysteresis["loop_exponent"], hysteresis["loop_beta"])[2:]
    turned = 0.5 * (loop + 1.0)
    knots = np.interp(_LOOP_KNOTS, turned, travel)
    slopes = np.diff([0.0, *_LOOP_KNOTS[:-1], 1.0]) / np.diff([0.0, *knots])
    shares = -np.diff([*slopes, 0.0]) * knots
    shares = np.where(shares > _LEAST_SHARE, shares, 0.0) / np.sum(shares[shares > _LEAST_SHARE])
    # A spring that yields by so much turns over within twice that.
    return [(float(share), 0.5 * float(knot)) for share, knot in zip(shares, knots, strict=True) if share > 0.0]


def _sliding(model: JointModel, speed: Array, use: Use) -> tuple[Array, float]:
    """(odd part over speed, mean even part) of steady sliding, under the loads of the recordings."""
    loaded = {"load_dependent_friction", "directional_efficiency"} & set(model.effects)
    loads = np.quantile(use.load_nm, _LOADS) if loaded else [0.0]
    under = [replace(model, gravity_cos_nm=float(load), gravity_sin_nm=0.0) for load in loads]
    forward = np.mean([steady_friction_nm(one, speed) for one in under], axis=0)
    backward = np.mean([steady_friction_nm(one, -speed) for one in under], axis=0)
    return 0.5 * (forward - backward), float(np.mean(0.5 * (forward + backward)))


def _polynomial(weights: Sequence[float] | Array, fastest: float) -> _Damping | None:
    """(a, b, c) of a v + b v**2 + c v**3, zero where left out; None where it falls before or beyond the fastest."""
    a, b, c = (*map(float, weights), 0.0, 0.0)[:3]
    beyond = np.linspace(0.0, _STEEP * fastest, 50)
    return None if np.any(a + 2.0 * b * beyond + 3.0 * c * beyond**2 < -1e-12) else (a, b, c)


def _level_and_damping(speed: Array, torque: Array, fastest: float) -> tuple[float, _Damping]:
    """Level and damping polynomial that fit best without falling, all the way beyond the fastest speed."""
    for count in (4, 3, 2, 1):
        weights = np.zeros(4)
        weights[:count] = np.linalg.lstsq(np.stack([speed**p for p in range(count)], axis=1), torque, rcond=None)[0]
        if weights[0] >= 0.0 and _polynomial(weights[1:], fastest) is not None:
            break
    # What makes a billionth of the torque is rounding.
    weights[np.abs(weights) * fastest ** np.arange(4) < 1e-9 * np.max(np.abs(torque))] = 0.0
    level, a, b, c = map(float, weights)
    return level, (a, b, c)


def _with_stribeck(speed: Array, torque: Array, fastest: float) -> tuple[float, float, float, _Damping]:
    """(Coulomb, rise, Stribeck speed, damping) of the nearest curve of LuGre's form."""
    found: list[tuple[float, float, float, float, _Damping]] = []
    for at in np.geomspace(max(5e-3, 0.01 * fastest), 0.6 * fastest, 60):
        bump = np.exp(-((speed / at) ** 2))
        for powers in _POWERS:
            table = np.column_stack([np.ones_like(speed), bump, *(speed**p for p in powers)])
            weights = np.linalg.lstsq(table, torque, rcond=None)[0]
            poly = _polynomial(weights[2:], fastest)
            if weights[0] < 0.0 or weights[1] < 0.0 or poly is None:
                continue
            rest = float(np.mean((torque - table @ weights) ** 2))
            found.append((rest, float(weights[0]), float(weights[1]), float(at), poly))
            break
    if not found:
        level, poly = _level_and_damping(speed, torque, fastest)
        return level, 0.0, 0.1, poly
    return min(found, key=lambda one: one[0])[1:]


def _with_ramps(speed: Array, torque: Array, fastest: float) -> tuple[float, list[tuple[float, float]], _Damping]:
    """(level at standstill, (knee in rad/s, fall in N m) of each ramp, damping) of the nearest falling curve."""
    found: list[tuple[float, float, list[tuple[float, float]], _Damping]] = []
    for at in np.geomspace(max(5e-3, 0.01 * fastest), 0.3 * fastest, 40):
        knees = at * np.array(_KNEES)
        ramps = -np.minimum(speed[:, None] / knees, 1.0)
        for powers in _POWERS:
            table = np.column_stack([np.ones_like(speed), ramps, *(speed**p for p in powers)])
            bounds = ([0.0] * (1 + knees.size) + [-np.inf] * len(powers), np.inf)
            fit = lsq_linear(table, torque, bounds, method="bvls")
            poly = _polynomial(fit.x[1 + knees.size :], fastest)
            if poly is not None:
                falls = [(float(v), float(f)) for v, f in zip(knees, fit.x[1 : 1 + knees.size], strict=True)]
                found.append((fit.cost, float(fit.x[0]), falls, poly))
                break
    if not found:
        level, poly = _level_and_damping(speed, torque, fastest)
        return level, [], poly
    _, level, falls, poly = min(found, key=lambda one: one[0])
    return level, [(v, f) for v, f in falls if f > _SMALLEST_RISE * level], poly


def _write_ramps(
    native: Native, joint: str, ramps: Sequence[tuple[float, float]], dry: float, yields_rad: float
) -> None:
    """Dampers that push, each up to its limit, and one that holds them while the spring bends, lest the joint hum.

    LuGre's element of next to no level damps along its own travel alone: nothing of it is left in sliding.
    """
    for number, (knee, fall) in enumerate(ramps, 1):
        native.more_actuators.append(
            f'<general name="{joint}_fall_{number}" joint="{joint}" dyntype="dcmotor" dynprm="0" actearly="true" '
            f'gaintype="dcmotor" gainprm="1 0" input="none" biastype="affine" biasprm="0 0 {_word(fall / knee)}" '
            f'forcelimited="true" forcerange="{words((-fall, fall))}"/>  <!-- passive: no control -->'
        )
    level, held = _HOLDS_NM * dry, _HOLDS * sum(fall / knee for knee, fall in ramps)
    lugre = (level / yields_rad, held, level, level, 1.0)
    native.more_actuators.append(_passive(joint, "rest", f'lugre="{words(lugre)}"'))


def _write_plant(native: Native, believed: ModelJoint, model: JointModel, use: Use) -> None:
    effects, name = model.effects, believed.name
    if "inertia_error" in effects:
        link = model.inertia_kg_m2 * (1.0 - model.motor_inertia_share)
        armature = believed.armature_kg_m2 + effects["inertia_error"]["error_share"] * link
        native.joint["armature"] = _word(max(0.0, armature))
        native.placed["inertia_error"] = "joint: armature"
        if armature < 0.0:
            native.lost["inertia_error"] = "the link is lighter than armature can make it: change its mass"
    if "gravity_error" in effects:
        share = effects["gravity_error"]["error_share"] / use.own_gravity_share
        if share <= -1.0:
            native.lost["gravity_error"] = "its own body is too light to carry the error: change the masses behind it"
        else:
            native.gravity_share = share
            native.placed["gravity_error"] = "inertial of its own body: mass and centre; inertia about the joint kept"
            native.lost["gravity_error"] = "which body is wrong: joints towards the base feel the change too"
    if "torque_bias" in effects:
        native.more_tendons.append(_constant(f"{name}_bias", name, effects["torque_bias"]["bias_nm"]))
        native.placed["torque_bias"] = "a far spring on a tendon (constant torque)"
    if "torque_ripple" in effects:
        values = effects["torque_ripple"]
        for prefix in ("", "second_", "third_", "fourth_"):
            if amplitude := values.get(f"{prefix}amplitude_nm", 0.0):
                poles = values[f"{prefix}cycles_per_motor_revolution"] * model.gear_ratio
                phase = values[f"{prefix}phase_rad"] - 0.5 * math.pi
                native.more_actuators.append(
                    _passive(name, f"{prefix}ripple", f'cogging="{words((amplitude, poles, phase))}"')
                )
        native.placed["torque_ripple"] = "passive dcmotor: cogging, one for each line"
    if "encoder_offset" in effects:
        native.joint["ref"] = _word(effects["encoder_offset"]["offset_rad"])
        native.placed["encoder_offset"] = "joint: ref"
        native.lost["encoder_offset"] = "keyframes keep their numbers, which now mean what the encoder reads"


_FRESH = "only the command is late: MuJoCo's own loop sees position and velocity at once"


def _write_drive(native: Native, believed: ModelJoint, model: JointModel, use: Use) -> None:
    effects, motor = model.effects, believed.motor
    asked = {"torque_constant_error", "torque_saturation", "torque_delay", "electrical_lag", "controller_gain_error"}
    if motor is None or motor.law == "other":
        for name in sorted(asked & set(effects)):
            native.lost[name] = "the file has no actuator of a plain law on this joint"
        return
    gain = 1.0 + effects.get("torque_constant_error", {}).get("error_share", 0.0)
    kp, kv = motor.kp_nm_per_rad / motor.gear**2, motor.kv_nm_s_per_rad / motor.gear**2
    errors = effects.get("controller_gain_error", {})
    kp *= gain * (1.0 + errors.get("kp_error_share", 0.0))
    kv *= gain * (1.0 + errors.get("kd_error_share", 0.0))
    limit = largest_torque(model)
    if "torque_constant_error" in effects or "controller_gain_error" in effects:
        if motor.law == "position":
            native.actuators |= {"kp": _word(kp), "kv": _word(kv)}
        else:
            native.actuators["gear"] = _word(motor.gear * gain)
        where = "actuator: kp and kv" if motor.law == "position" else "actuator: gear"
        native.placed |= dict.fromkeys(sorted({"torque_constant_error", "controller_gain_error"} & set(effects)), where)
        if "torque_constant_error" in effects:
            native.reported = 1.0 / gain
            native.lost["torque_constant_error"] = "the drive's report: MuJoCo tells the true torque"
    if math.isfinite(limit) and ("torque_saturation" in effects or (gain != 1.0 and motor.law == "position")):
        force = limit * gain / abs(motor.gear)
        native.actuators["forcerange"] = words((-force, force))
        if "torque_saturation" in effects:
            native.placed["torque_saturation"] = "actuator: forcerange"
    if "torque_delay" in effects:
        delay = motor.delay_s + effects["torque_delay"]["delay_s"]
        native.actuators |= {
            "delay": _word(delay),
            "nsample": str(math.ceil(delay / use.timestep_s) + 1),
            "interp": "linear",
        }
        native.placed["torque_delay"] = "actuator: delay, nsample, interp (call mj_initCtrlHistory at the start)"
        if motor.law == "position":
            native.lost["torque_delay"] = _FRESH
    if "electrical_lag" in effects:
        if motor.law == "position":
            native.actuators["timeconst"] = _word(effects["electrical_lag"]["time_constant_s"])
            native.placed["electrical_lag"] = "actuator: timeconst"
            native.lost["electrical_lag"] = _FRESH
        else:
            # Taken early, the filter acts half a step sooner than the drive does on average.
            lag = _word(effects["electrical_lag"]["time_constant_s"] + 0.5 * use.timestep_s)
            native.actuators |= {"dyntype": "filterexact", "dynprm": lag, "actearly": "true"}
            native.placed["electrical_lag"] = "actuator: dyntype filterexact"
            native.lost["electrical_lag"] = "one more activation: keyframes get a zero for it"


def largest_torque(model: JointModel) -> float:
    """What the drive gives in the end when everything is asked of it, whatever effect clips it; infinite if without."""
    if math.isinf(model.drive.torque_limit_nm):
        return math.inf
    parameters, state = packing.parameters(model), packing.state()
    state[plant.DEMAND] = model.drive.torque_limit_nm
    current = [kernel().motor_torque(parameters, state, 1e-3) for _ in range(2000)]
    return float(current[-1])


def _write_transmission(native: Native, believed: ModelJoint, model: JointModel, use: Use) -> None:
    effects, name = model.effects, believed.name
    motor = model.motor_inertia_share * model.inertia_kg_m2
    link = model.inertia_kg_m2 - motor
    if "backlash" in effects:
        values = effects["backlash"]
        stiffness = values["contact_stiffness_nm_per_rad"]
        damping = values["contact_relaxation_s"] * stiffness
        native.more_joints.append(limits_of_gap(values["gap_rad"], stiffness, damping, motor, link, use.timestep_s))
        native.placed["backlash"] = f"a joint {name}_play behind it, with limits"
    elif "joint_elasticity" in effects:
        values = effects["joint_elasticity"]
        stiffness = 1.0 / values["compliance_rad_per_nm"]
        native.more_joints.append(
            f'stiffness="{_word(stiffness)}" damping="{_word(values["relaxation_s"] * stiffness)}"'
        )
        native.placed["joint_elasticity"] = f"a joint {name}_play behind it, with stiffness and damping"
    else:
        return
    effect = "backlash" if "backlash" in effects else "joint_elasticity"
    native.lost[effect] = "one more coordinate: indices of qpos and keyframes move"
    if believed.armature_kg_m2 <= 0.0:
        native.joint.setdefault("armature", _word(motor))
        native.lost[effect] += f"; armature {_word(motor)} kg m2 was assumed for the motor's side"


def limits_of_gap(
    gap_rad: float, stiffness: float, damping: float, motor_kg_m2: float, link_kg_m2: float, step_s: float | None = None
) -> str:
    """Limits on either side of a gap that yield like spring and damper, corrected for a step where one is given.

    At an impedance near 0 their force depends on depth and speed alone, per inertia that they see.
    """
    reduced = 1.0 / (1.0 / max(motor_kg_m2, 1e-9) + 1.0 / max(link_kg_m2, 1e-9))
    stiff, damped = stiffness / reduced, max(damping, 1e-9) / reduced
    stiff = stiff if step_s is None else _at_step(stiff, damped, step_s)
    return (
        f'limited="true" range="{words((-0.5 * gap_rad, 0.5 * gap_rad))}" solimplimit="0.001 0.001 0.001" '
        f'solreflimit="{words((-stiff, -damped))}"'
    )


def _at_step(stiffness: float, damping: float, step_s: float) -> float:
    """Stiffness with which a limit, whose force MuJoCo takes from the start of each step, swings as the contact does.

    Per inertia, as the damping: the poles of the discrete x'' = -k x - d x' are those of the contact, exp(s h).
    """
    decay = math.exp(-damping * step_s)
    turn = cmath.cos(cmath.sqrt(stiffness - 0.25 * damping**2) * step_s).real
    return (1.0 + decay - 2.0 * math.sqrt(decay) * turn) / step_s**2


def _passive(joint: str, what: str, law: str) -> str:
    return (
        f'<dcmotor name="{joint}_{what}" joint="{joint}" input="none" motorconst="0" resistance="1" {law}/>'
        "  <!-- passive: no control -->"
    )


def _slipping(name: str, joint: str, stiffness: float, yields_rad: float) -> str:
    return (
        f'<fixed name="{name}" stiffness="{_word(stiffness)}" springyield="{_word(yields_rad)}" springlength="0">'
        f'<joint joint="{joint}" coef="1"/></fixed>'
    )


def _constant(name: str, joint: str, torque_nm: float) -> str:
    """A constant torque of the machine against which the drive must hold: the spring pulls the other way."""
    side = "-1" if torque_nm > 0.0 else "1"
    return (
        f'<fixed name="{name}" stiffness="{_word(abs(torque_nm) / FAR_RAD)}" springlength="{_word(FAR_RAD)}">'
        f'<joint joint="{joint}" coef="{side}"/></fixed>'
    )


def _word(value: float) -> str:
    return f"{value:.9g}"


def words(values: Iterable[float]) -> str:
    """Numbers as MuJoCo reads them."""
    return " ".join(_word(value) for value in values)
