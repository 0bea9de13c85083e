"""Joints that others wrote: MuJoCo's DC motor with its LuGre friction and cogging, driven by a digital controller.

The real joint and the believed one are two MJCF models that differ in what is withheld; nothing is computed here.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from frictid_hil.blind.figures import low_pass, rms
from frictid_hil.blind.joints import either_sign, log_uniform, told_body, told_experiments
from frictid_hil.blind.plant import Controller
from frictid_hil.blind.wide import Drawn, Row, asked, multisine, pick_place
from frictid_hil.errors import UsageError
from frictid_hil.friction.trajectory import Array

STEP_S = 2e-4
TICK_S = 0.002
KINDS = ("none",) * 3 + ("single",) * 13 + ("outside",) * 4  # out of 20 cases
VISIBLE = 2.0


@dataclass(frozen=True, slots=True)
class Model:
    """A joint in MuJoCo's words; SI units, joint side."""

    inertia: float  # of the link about the axis
    armature: float  # rotor's part
    gravity: float  # torque of the horizontal link
    # The LuGre friction, its bristle by stiffness; the viscous part is the actuator's damping.
    level: float
    static: float
    stribeck: float
    bristle: float
    viscous: float
    gain: float = 1.0  # torque that comes out over torque that is asked for
    cogging: float = 0.0  # of the motor, joint side
    poles: int = 2
    lag: float = 0.0  # of the current
    delay: float = 0.0  # of the command, s
    bias: float = 0.0  # constant torque that pushes the joint
    twist: float = 0.0  # stiffness of the gear; 0 for a stiff one
    # Nobody's library: a cable about angle 0, a machine nearby.
    spring: float = 0.0
    shake: float = 0.0
    shake_hz: float = 5.0


def draw_zoo(index: int, seed: int, kind: str) -> Drawn:
    """One case; an effect that cannot be seen is drawn anew."""
    for attempt in range(60):
        rng = np.random.default_rng([seed, 505, index, attempt])
        belief = _belief(rng)
        name, real = _withheld(rng, belief, kind)
        rated = float(f"{1.4 * (belief.gravity + belief.level + belief.viscous * 2.0):.2g}")
        noise = rated * log_uniform(rng, 1e-3, 8e-3)
        gains = _gains(rng, belief)
        speed = rng.uniform(1.0, 2.2)
        centre = rng.uniform(-1.0, 1.0)
        motions = {
            "mixed": centre + multisine(rng, speed, 30.0, TICK_S),
            "places": centre + pick_place(rng, speed, 20.0, TICK_S),
            "judged": centre + multisine(rng, speed, 18.0, TICK_S),
        }
        pairs = {n: (run(belief, gains, c), run(real, gains, c)) for n, c in motions.items()}
        if not all(np.all(np.isfinite(r[0])) and np.abs(r[0] - motions[n]).max() < 0.5 for n, (_, r) in pairs.items()):
            continue
        floor = rms(low_pass(noise * rng.standard_normal(20_000), 1.0 / TICK_S))
        # What the controller asked for a tick before is not what was given.
        late = [t[1:] - asked(gains, motions[n], q, float(t[0]))[:-1] for n, (_, (q, t)) in pairs.items()]
        changed = rms(np.concatenate([low_pass(r[1] - b[1], 1.0 / TICK_S) for b, r in pairs.values()]))
        apart = rms(np.concatenate([low_pass(part, 1.0 / TICK_S) for part in late]))
        size = max(changed, apart if kind != "none" else 0.0) / floor
        if kind != "none" and not VISIBLE <= size < 80.0:
            continue
        case = f"case_{index:03d}"
        logs = tuple(_log(rng, n, motions[n], pairs[n][1], noise, rated) for n in motions)
        return _nominal(case, belief, gains, rated, motions), logs, _truth(case, kind, name, size, belief, real)
    raise RuntimeError(f"no joint came up for case {index} of kind {kind}")


def _belief(rng: np.random.Generator) -> Model:
    inertia = log_uniform(rng, 0.02, 2.0)
    scale = 8.0 * inertia**0.75
    share = rng.uniform(0.2, 0.5)
    level = scale * rng.uniform(0.3, 1.0)
    return Model(
        inertia=(1.0 - share) * inertia,
        armature=share * inertia,
        gravity=scale * rng.uniform(0.4, 1.4),
        level=level,
        static=level * 1.0001,
        stribeck=0.05,
        bristle=level / log_uniform(rng, 3e-4, 1e-3),
        viscous=level * rng.uniform(0.2, 0.8) / 2.0,
    )


SINGLES = (
    "stribeck", "friction_level_error", "viscous_error", "inertia_error", "gravity_error", "torque_constant_error",
    "torque_ripple", "electrical_lag", "torque_delay", "torque_bias", "joint_elasticity",
)  # fmt: skip


def _withheld(rng: np.random.Generator, b: Model, kind: str) -> tuple[str, Model]:
    """(name of the effect or outsider, the real joint); "" and the belief itself for none."""
    if kind == "none":
        return "", b
    if kind == "outside":
        if rng.random() < 0.5:
            return "cable", replace(b, spring=b.level * rng.uniform(0.2, 0.8))
        return "vibration", replace(b, shake=b.level * rng.uniform(0.05, 0.3), shake_hz=rng.uniform(2.5, 9.0))
    name = str(rng.choice(SINGLES))
    e = either_sign(rng, 0.06, 0.3)
    changed: dict[str, dict[str, Any]] = {
        "stribeck": {"static": b.level * (1 + log_uniform(rng, 0.08, 0.5)), "stribeck": log_uniform(rng, 0.03, 0.12)},
        "friction_level_error": {n: getattr(b, n) * (1 + e) for n in ("level", "static", "bristle", "viscous")},
        "viscous_error": {"viscous": b.viscous * (1 + 3 * e)},
        "inertia_error": {"inertia": b.inertia * (1 + e)},
        "gravity_error": {"gravity": b.gravity * (1 + e)},
        "torque_constant_error": {"gain": 1 + e},
        "torque_ripple": {"cogging": b.level * log_uniform(rng, 0.03, 0.2), "poles": int(rng.choice([1, 2, 4]))},
        "electrical_lag": {"lag": log_uniform(rng, 2e-3, 1e-2)},
        "torque_delay": {"delay": TICK_S * rng.integers(1, 5)},
        "torque_bias": {"bias": b.level * either_sign(rng, 0.05, 0.3)},
        "joint_elasticity": {"twist": b.inertia * (2 * math.pi * rng.uniform(6.0, 15.0)) ** 2},
    }
    return name, replace(b, **changed[name])


GEAR_RATIO = 100


def _xml(m: Model) -> str:
    """The joint as MJCF. The angle of "joint" is the motor's, on the joint side."""
    mass, radius = 1.0, m.gravity / 9.81
    own = max(m.inertia - mass * radius**2, 1e-9)
    while own <= 1e-9 and mass < 1e6:
        mass, radius = 4.0 * mass, radius / 4.0
        own = max(m.inertia - mass * radius**2, 1e-9)
    body = f'<inertial pos="{radius:.12g} 0 0" mass="{mass:.12g}" diaginertia="{own:.12g} {own:.12g} {own:.12g}"/>'
    if m.twist:
        damping = 0.04 * math.sqrt(m.twist * m.inertia)
        body = (
            '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/><body>'
            f'<joint type="hinge" axis="0 -1 0" stiffness="{m.twist:.12g}" damping="{damping:.12g}"/>{body}</body>'
        )
    micro = 0.1 * math.sqrt(m.bristle * (m.inertia + m.armature))
    lugre = " ".join(f"{value:.12g}" for value in (m.bristle, micro, m.level, m.static, m.stribeck))
    dynamics = f'dyntype="filterexact" dynprm="{m.lag:.12g}"' if m.lag else ""
    return f"""<mujoco><compiler angle="radian"/><option timestep="{STEP_S}" integrator="implicitfast"/>
<worldbody><body><joint name="joint" type="hinge" axis="0 -1 0" armature="{m.armature:.12g}"
 stiffness="{m.spring:.12g}" springref="0"/>{body}</body></worldbody><actuator>
<general name="drive" joint="joint" gainprm="{m.gain:.12g}" {dynamics}/>
<dcmotor joint="joint" input="none" resistance="1" motorconst="0 0" damping="{m.viscous:.12g}"
 lugre="{lugre}"
 cogging="{m.cogging:.12g} {m.poles * GEAR_RATIO} 0.4"/></actuator></mujoco>"""


Gains = partial(Controller, velocity_filter=0.004, torque_limit=math.inf, tick=TICK_S, backward=True)


def _gains(rng: np.random.Generator, m: Model) -> Controller:
    inertia, natural, damping = m.inertia + m.armature, rng.uniform(20.0, 28.0), rng.uniform(0.75, 0.95)
    kp = inertia * natural**2
    return Gains(kp, kp * rng.uniform(2.0, 4.0), 2.0 * damping * natural * inertia)


def run(m: Model, gains: Controller, command: Array) -> tuple[Array, Array]:
    """(position, mean torque since the last tick) at the ticks, from rest, (n,) each; ``UsageError`` without MuJoCo."""
    try:
        library = importlib.import_module("mujoco")
        model = library.MjModel.from_xml_string(_xml(m))
    except (ImportError, ValueError) as error:
        raise UsageError(f"the zoo needs MuJoCo 4: {error}", next_step="pip install 'mujoco>=4'") from error
    data = library.MjData(model)
    data.qpos[0] = command[0]
    holding = (m.gravity * math.cos(command[0]) + m.spring * command[0] - m.bias) / m.gain
    if m.twist:
        data.qpos[1] = -m.gravity * math.cos(command[0]) / m.twist
    if m.lag:
        data.act[0] = holding
    late = round(m.delay / TICK_S)
    sent = [holding] * late
    integral, filtered, last = holding, 0.0, float(command[0])
    keep = math.exp(-TICK_S / gains.velocity_filter)
    position, torque = np.empty(command.size), np.empty(command.size)
    given, steps = holding, round(TICK_S / STEP_S)
    for k in range(command.size):
        q = float(data.qpos[0])
        position[k], torque[k] = q, given
        filtered = keep * filtered + (1.0 - keep) * (q - last) / TICK_S
        last = q
        rate = (command[k] - command[max(k - 1, 0)]) / TICK_S
        behind = command[k] - q
        sent.append(gains.kp * behind + integral + gains.kd * (rate - filtered))
        integral += gains.ki * behind * TICK_S
        data.ctrl[0] = sent.pop(0)
        given = 0.0
        for _ in range(steps):
            data.qfrc_applied[0] = m.bias + m.shake * math.sin(2 * math.pi * m.shake_hz * data.time)
            library.mj_step(model, data)
            given += float(data.actuator_force[0]) / m.gain / steps
    return position, torque


def _log(
    rng: np.random.Generator, name: str, command: Array, made: tuple[Array, Array], noise_nm: float, rated_nm: float
) -> Row:
    position, torque = made
    step, quantum = 2.0 * math.pi / (2**17 * GEAR_RATIO), 1e-3 * rated_nm
    reported = np.round((torque + noise_nm * rng.standard_normal(torque.size)) / quantum) * quantum
    columns = {
        "time_s": TICK_S * np.arange(command.size),
        "position_rad": np.round(position / step) * step,
        "torque_nm": reported,
        "position_command_rad": command,
    }
    return Row(name, columns)


def _nominal(case: str, b: Model, g: Controller, rated: float, motions: Mapping[str, Array]) -> dict[str, Any]:
    speeds = [0.25 * k for k in range(1, 9)]
    return {
        "case": case,
        "joint": {
            **told_body(b.armature, b.inertia, b.gravity, GEAR_RATIO),
            "friction": {
                "velocity_rad_s": speeds,
                "torque_nm": [b.level + b.viscous * v for v in speeds],
                "presliding_stiffness_nm_per_rad": b.bristle,
            },
        },
        "controller": {
            "type": "pid", "rate_hz": round(1.0 / TICK_S), "kp": g.kp, "ki": g.ki, "kd": g.kd,
            "velocity_filter_s": g.velocity_filter, "command_rate": "backward",
        },
        "drive": {"rated_torque_nm": rated, "torque_quantum_nm": 1e-3 * rated},
        "encoder": {"resolution_rad": 2.0 * math.pi / (2**17 * GEAR_RATIO)},
        "tolerance": {"inertia_kg_m2": 0.01, "gravity_torque_nm": 0.01, "friction_torque": 0.01, "viscous": 0.02,
                      "torque_constant": 0.005, "controller_gains": 0.0},
        "experiments": told_experiments(
            ".csv.gz", ((n, n == "judged", False, c.size * TICK_S) for n, c in motions.items())
        ),
    }  # fmt: skip


def _truth(case: str, kind: str, name: str, size: float, b: Model, real: Model) -> dict[str, Any]:
    known = {
        "inertia_error": ("error_share", real.inertia / b.inertia - 1.0),
        "gravity_error": ("error_share", real.gravity / b.gravity - 1.0),
        "friction_level_error": ("error_share", real.level / b.level - 1.0),
        "viscous_error": ("error_share", real.viscous / b.viscous - 1.0),
        "torque_constant_error": ("error_share", real.gain - 1.0),
        "torque_bias": ("bias_nm", -real.bias),
        "torque_delay": ("delay_s", real.delay),
    }
    parameters = [{"effect": name, "parameter": known[name][0], "value": known[name][1]}] if name in known else []
    return truth_of(case, "zoo", kind, name, size, parameters)


def truth_of(
    case: str, world: str, kind: str, name: str, size: float, parameters: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """The truth of a case with one thing withheld, or nothing."""
    tied = [other for pair in TIED if name in pair for other in pair if other != name]
    one = {"name": name, "role": "withheld", "size_alone": size, "indistinguishable": tied}
    return {
        "case": case,
        "world": world,
        "kind": kind,
        "main": [] if kind == "none" else ["unknown"] if kind == "outside" else [name],
        "effects": [{"name": name, "in_library": kind != "outside"}] if name else [],
        "present": [name] if kind == "single" else [],
        "neutral": [],
        "controller": "known",
        "size_ratio": size if kind != "none" else 0.0,
        "contributors": [one] if kind == "single" else [],
        "true_parameters": list(parameters),
        "facts": {},
    }


TIED = (("torque_delay", "electrical_lag"),)  # pairs that these recordings can hardly tell apart
