"""Improved joints for other simulators: Isaac Lab, mjlab, BAM, ros2_control, a C header. What is lost is told."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import yaml
from scipy.optimize import nnls

from frictid_hil.errors import UsageError
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.native import Use, curve_numbers, largest_torque
from frictid_hil.simulation.robot_model import ModelJoint


@dataclass(frozen=True, slots=True)
class Numbers:
    """What other simulators can hold of a joint; joint side of the gear."""

    dry_nm: float  # level of sliding friction
    rise_nm: float  # what friction is higher at standstill
    stribeck_rad_s: float  # speed of the fall, exp(-(v/vs)**2)
    damping: tuple[float, float, float]  # (a, b, c) of a v + b v abs(v) + c v**3
    viscous_nm_s_per_rad: float  # the one slope that stands nearest to it
    # (level in N m, slope in N m s/rad) of the straight line nearest to all of sliding friction.
    straight: tuple[float, float]
    presliding_nm_per_rad: float  # stiffness before friction slips
    armature_kg_m2: float  # of the rotor
    kp_nm_per_rad: float  # of a position law; 0 where there is none
    kv_nm_s_per_rad: float  # of it
    torque_limit_nm: float  # infinite where the file has none
    delay_s: float  # from command to torque


def numbers_of(believed: ModelJoint, model: JointModel, use: Use) -> Numbers:
    """The numbers of a joint with its causes: ``believed`` as the user's file has it, ``model`` ours with effects."""
    dry, rise, at, damping = curve_numbers(model, use)
    speed = np.quantile(use.speed_rad_s, np.linspace(0.1, 1.0, 40))
    bump = rise * np.exp(-((speed / at) ** 2)) if at > 0.0 else 0.0
    rest = (damping[0] + (damping[1] + damping[2] * speed) * speed) * speed
    straight = nnls(np.stack([np.ones_like(speed), speed], axis=1), dry + bump + rest)[0]
    effects, motor = model.effects, believed.motor
    gains = effects.get("controller_gain_error", {})
    constant = 1.0 + effects.get("torque_constant_error", {}).get("error_share", 0.0)
    link = model.inertia_kg_m2 * (1.0 - model.motor_inertia_share)
    return Numbers(
        dry_nm=dry,
        rise_nm=rise,
        stribeck_rad_s=at,
        damping=damping,
        viscous_nm_s_per_rad=float(speed @ rest / (speed @ speed)),
        straight=(float(straight[0]), float(straight[1])),
        presliding_nm_per_rad=model.presliding_stiffness_nm_per_rad,
        armature_kg_m2=max(
            0.0, believed.armature_kg_m2 + effects.get("inertia_error", {}).get("error_share", 0.0) * link
        ),
        kp_nm_per_rad=(motor.kp_nm_per_rad if motor else 0.0) * constant * (1.0 + gains.get("kp_error_share", 0.0)),
        kv_nm_s_per_rad=(motor.kv_nm_s_per_rad if motor else 0.0) * constant * (1.0 + gains.get("kd_error_share", 0.0)),
        torque_limit_nm=largest_torque(model) * constant,
        delay_s=(motor.delay_s if motor else 0.0) + effects.get("torque_delay", {}).get("delay_s", 0.0),
    )


def isaac_lab(joints: Mapping[str, Numbers], samples: Mapping[str, Sequence[Numbers]], step_s: float) -> str:
    """Actuator configurations of Isaac Lab, and ranges for domain randomisation where there are samples."""
    lines = [
        '"""Joints identified by frictid-hil, as actuators of Isaac Lab.',
        "",
        "Friction is in N m and N m s/rad. Read the numbers back after import: importers have dropped some.",
        f"Delays are physics steps of {step_s:g} s. Stribeck is a static and a dynamic level; Newton has only one.",
        '"""',
        "",
        "from isaaclab.actuators import DelayedPDActuatorCfg, IdealPDActuatorCfg",
        "",
        "ACTUATORS = {",
    ]
    for name, n in joints.items():
        steps = round(n.delay_s / step_s)
        kind = "DelayedPDActuatorCfg" if steps else "IdealPDActuatorCfg"
        values = {
            "stiffness": n.kp_nm_per_rad,
            "damping": n.kv_nm_s_per_rad,
            "armature": n.armature_kg_m2,
            "friction": max(n.dry_nm + n.rise_nm, n.straight[0]),
            "dynamic_friction": n.straight[0],
            "viscous_friction": n.straight[1],
            "actuator_effort_limit": n.torque_limit_nm,
        }
        told = [f"joint_names_expr=[{json.dumps(name)}]", *_keywords(values)]
        if steps:
            told += [f"min_delay={steps}", f"max_delay={steps}"]
        lines.append(f"    {json.dumps(name)}: {kind}({', '.join(told)}),")
    lines += ["}", ""]
    if samples:
        lines += [
            "# 2.5 and 97.5 % of the posterior; draw whole samples instead where you can: numbers hang together.",
            "RANGES = {",
        ]
        for name, drawn in samples.items():
            ranges = {
                key: tuple(float(f"{v:.6g}") for v in np.quantile([getattr(n, key) for n in drawn], (0.025, 0.975)))
                for key in ("dry_nm", "viscous_nm_s_per_rad", "armature_kg_m2", "delay_s")
            }
            lines.append(f"    {json.dumps(name)}: {ranges!r},")
        lines += ["}", ""]
    return "\n".join(lines)


def _keywords(values: Mapping[str, float]) -> list[str]:
    """Arguments of a configuration; none for a limit that is infinite."""
    return [f"{key}={value:.6g}" for key, value in values.items() if value < math.inf]


def mjlab(joints: Mapping[str, Numbers], step_s: float) -> str:
    """Position actuators of mjlab, with what its configuration has no place for beside them."""
    lines = [
        '"""Joints identified by frictid-hil, as actuators of mjlab.',
        "",
        "For your own MJCF as it was, less its actuators: the improved one holds its friction already. frictionloss is",
        "a soft constraint that creeps below its level.",
        '"""',
        "",
        "from mjlab.actuator import BuiltinPositionActuatorCfg",
        "",
        "ACTUATORS = (",
    ]
    for name, n in joints.items():
        values = {
            "stiffness": n.kp_nm_per_rad,
            "damping": n.kv_nm_s_per_rad,
            "armature": n.armature_kg_m2,
            "frictionloss": n.straight[0],
            "effort_limit": n.torque_limit_nm,
        }
        told = ", ".join(_keywords(values))
        lines.append(f"    BuiltinPositionActuatorCfg(target_names_expr=({json.dumps(name)},), {told}),")
    damping = {name: float(f"{n.straight[1]:.6g}") for name, n in joints.items()}
    steps = {name: round(n.delay_s / step_s) for name, n in joints.items()}
    lines += [
        ")",
        "",
        "# N m s/rad: `damping` of the joints in your MJCF; the configuration above has no place for it.",
        f"JOINT_DAMPING = {damping!r}",
        f"# Steps of {step_s:g} s for delay_min_lag and delay_max_lag; which class has them depends on the version.",
        f"DELAY_STEPS = {steps!r}",
        "",
    ]
    return "\n".join(lines)


def bam(n: Numbers) -> str:
    """Parameters of one actuator for BAM, its model m2 (Coulomb, viscous, Stribeck); torque is in N m, not volts."""
    return json.dumps(
        {
            "model": "m2",
            "armature": n.armature_kg_m2,
            "friction_base": n.dry_nm,
            "friction_viscous": n.viscous_nm_s_per_rad,
            "friction_stribeck": n.rise_nm,
            "dtheta_stribeck": n.stribeck_rad_s or 0.1,
            "alpha": 2.0,
            "q_offset": 0.0,
        },
        indent=2,
    )


_HEADER = """/* Friction of identified joints, written by frictid-hil. No state but the slip; no allocation; C99.
 *
 *   struct frictid_state state = {{0.0}};
 *   double torque_nm = frictid_step(&FRICTID_JOINTS[0], &state, velocity_rad_s, step_s);
 *
 * The torque is what the motor must give against friction. FRICTID_VECTORS are for your own check, see frictid_check.
 */
#ifndef FRICTID_FRICTION_H
#define FRICTID_FRICTION_H
#include <math.h>

struct frictid_joint {{
    const char *name;
    double dry_nm, rise_nm, stribeck_rad_s, a, b, c, presliding_nm_per_rad;
}};
struct frictid_state {{
    double slip;
}};
struct frictid_vector {{
    int joint;
    double velocity_rad_s, torque_nm;
}};

static double frictid_step(const struct frictid_joint *j, struct frictid_state *s, double v, double step_s) {{
    double u = j->stribeck_rad_s > 0.0 ? v / j->stribeck_rad_s : 0.0;
    double level = j->dry_nm + (j->stribeck_rad_s > 0.0 ? j->rise_nm * exp(-u * u) : 0.0);
    double slip = s->slip + j->presliding_nm_per_rad / (j->dry_nm > 1e-9 ? j->dry_nm : 1e-9) * v * step_s;
    s->slip = slip > 1.0 ? 1.0 : slip < -1.0 ? -1.0 : slip;
    return level * s->slip + (j->a + (j->b * fabs(v) + j->c * v * v)) * v;
}}

static const struct frictid_joint FRICTID_JOINTS[] = {{
{joints}
}};
#define FRICTID_STEP_S {step_s!r}
static const struct frictid_vector FRICTID_VECTORS[] = {{
{vectors}
}};
#define FRICTID_COUNT(table) ((int)(sizeof(table) / sizeof((table)[0])))

/* Largest difference to the vectors, N m; each joint begins relaxed. */
static double frictid_check(void) {{
    struct frictid_state state = {{0.0}};
    double worst = 0.0;
    for (int k = 0, last = -1; k < FRICTID_COUNT(FRICTID_VECTORS); k++) {{
        const struct frictid_vector *v = &FRICTID_VECTORS[k];
        if (v->joint != last) {{
            state.slip = 0.0;
            last = v->joint;
        }}
        double torque_nm = frictid_step(&FRICTID_JOINTS[v->joint], &state, v->velocity_rad_s, FRICTID_STEP_S);
        double off = fabs(torque_nm - v->torque_nm);
        worst = off > worst ? off : worst;
    }}
    return worst;
}}
#endif
"""
VECTORS = 60
VECTOR_STEP_S = 1e-3


def c_header(joints: Mapping[str, Numbers]) -> str:
    """A C header: one step function, the joints' numbers, and test vectors computed here."""
    rows, vectors = [], []
    for index, (name, n) in enumerate(joints.items()):
        numbers = (n.dry_nm, n.rise_nm, n.stribeck_rad_s, *n.damping, n.presliding_nm_per_rad)
        rows.append(f"    {{{json.dumps(name)}, {', '.join(repr(float(v)) for v in numbers)}}},")
        slip = 0.0
        for k in range(VECTORS):
            speed = float(f"{1.5 * math.sin(0.25 * k) * math.exp(-0.02 * k):.6g}")
            slip = float(
                np.clip(slip + n.presliding_nm_per_rad / max(n.dry_nm, 1e-9) * speed * VECTOR_STEP_S, -1.0, 1.0)
            )
            vectors.append(f"    {{{index}, {speed!r}, {friction_nm(n, speed, slip)!r}}},")
    return _HEADER.format(joints="\n".join(rows), vectors="\n".join(vectors), step_s=VECTOR_STEP_S)


def friction_nm(n: Numbers, speed_rad_s: float, slip: float) -> float:
    """Friction at a speed and a state of the slip spring (-1..1)."""
    bump = math.exp(-((speed_rad_s / n.stribeck_rad_s) ** 2)) if n.stribeck_rad_s > 0.0 else 0.0
    a, b, c = n.damping
    return (n.dry_nm + n.rise_nm * bump) * slip + (a + b * abs(speed_rad_s) + c * speed_rad_s**2) * speed_rad_s


def ros2(joints: Mapping[str, Numbers]) -> str:
    """Parameters of a ros2_control node: a level and a slope by joint."""
    friction = {
        name: {"coulomb_nm": round(n.straight[0], 6), "viscous_nm_s_per_rad": round(n.straight[1], 6)}
        for name, n in joints.items()
    }
    return yaml.safe_dump({"/**": {"ros__parameters": {"joints": list(joints), "friction": friction}}}, sort_keys=False)


def samples_json(samples: Mapping[str, Sequence[Numbers]]) -> str:
    """Whole samples: the k-th of every joint belong together."""
    count = min((len(drawn) for drawn in samples.values()), default=0)
    rows = [{name: asdict(drawn[k]) for name, drawn in samples.items()} for k in range(count)]
    return json.dumps({"schema": "frictid.samples/1", "samples": rows}, indent=1)


LOST = {
    "isaaclab": "presliding, the curve beyond one slope, asymmetry, ripple and play have no place in its joints",
    "bam": "presliding, the curve beyond one slope, asymmetry, ripple, play and delay have no place in its model m2",
    "mjlab": "presliding, Stribeck, a curve beyond one slope, asymmetry, ripple and play; the improved MJCF keeps them",
    "newton": "presliding, Stribeck, a curve beyond one slope, asymmetry, ripple, play and delay; a stage of our own "
    "has no shapes",
    "ros2": "all but a level and a slope",
    "c": "asymmetry, ripple, play, delay, load: the step function is friction over speed and presliding",
    "samples": "nothing of the numbers; effects without a number of their own are not in them",
}
TARGETS = tuple(LOST)

_SLIDING = dict.fromkeys(("friction_level_error", "viscous_error", "viscous_nonlinearity"), "friction")
_MEAN = dict.fromkeys(("load_dependent_friction", "directional_efficiency"), "friction")
_GAINS = dict.fromkeys(("torque_constant_error", "controller_gain_error"), "gains")
_KINDS = _SLIDING | _MEAN | _GAINS | {"temperature_drift": "friction"}
_PLACES: dict[str, dict[str, str]] = {
    "isaaclab": {
        "friction": "dynamic_friction and viscous_friction",
        "stribeck": "friction, the static level",
        "inertia_error": "armature",
        "gains": "stiffness and damping",
        "torque_saturation": "actuator_effort_limit",
        "torque_delay": "min_delay and max_delay",
    },
    "mjlab": {
        "friction": "frictionloss and JOINT_DAMPING",
        "inertia_error": "armature",
        "gains": "stiffness and damping",
        "torque_saturation": "effort_limit",
        "torque_delay": "DELAY_STEPS",
    },
    "newton": {
        "friction": "newton:friction and newton:damping",
        "inertia_error": "newton:armature",
        "gains": "drive: stiffness and damping",
        "torque_saturation": "drive: maxForce",
    },
    "ros2": {"friction": "coulomb_nm and viscous_nm_s_per_rad"},
    "bam": {
        "friction": "friction_base and friction_viscous",
        "stribeck": "friction_stribeck and dtheta_stribeck",
        "inertia_error": "armature",
    },
    "c": {"friction": "dry_nm, a, b and c", "stribeck": "rise_nm and stribeck_rad_s"},
    "samples": {
        "friction": "dry_nm and damping",
        "stribeck": "rise_nm and stribeck_rad_s",
        "inertia_error": "armature_kg_m2",
        "gains": "kp_nm_per_rad and kv_nm_s_per_rad",
        "torque_saturation": "torque_limit_nm",
        "torque_delay": "delay_s",
    },
}


def place_of(target: str, effect: str) -> str | None:
    """Where a target holds an effect; None where it cannot."""
    place = _PLACES[target].get(_KINDS.get(effect, effect))
    if place is None:
        return None
    return place + ("; at the mean load" if effect in _MEAN else "; cold" if effect == "temperature_drift" else "")


def written_as(
    target: str, file: str, joints: Mapping[str, Numbers], samples: Mapping[str, Sequence[Numbers]], step_s: float
) -> dict[str, str]:
    """Text by file name, for the physics step of the user's model; samples of the posterior may be empty.

    BAM has a file for each joint, ``NAME_JOINT.json``; the text for ``newton`` is made by ``usd``. ``UsageError`` for a
    target that is none.
    """
    stem, dot, ending = file.rpartition(".")
    makers: dict[str, Callable[[], dict[str, str]]] = {
        "isaaclab": lambda: {file: isaac_lab(joints, samples, step_s)},
        "bam": lambda: {f"{stem or ending}_{name}{dot}{ending if stem else ''}": bam(n) for name, n in joints.items()},
        "mjlab": lambda: {file: mjlab(joints, step_s)},
        "ros2": lambda: {file: ros2(joints)},
        "c": lambda: {file: c_header(joints)},
        "samples": lambda: {file: samples_json(samples)},
    }
    if target not in makers:
        raise UsageError(f"no target {target!r}", where="--export", next_step=f"one of {', '.join(makers)}")
    return makers[target]()
