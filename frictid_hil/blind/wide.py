"""Joints as they come in practice: beliefs with tolerances, any controller or none, other frictions, single recordings.

The belief is drawn first; the real joint is the belief with every deviation on. A deviation inside its stated
tolerance, an effect of the library, one from outside: each is a *contributor*, and its size is what it alone changes
in torque (or between demand and torque), over what noise alone leaves, both behind a low-pass at 25 Hz. Formulas and
integrator are those of ``plant``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import signal

from frictid_hil.blind import plant
from frictid_hil.blind.effects import LIBRARY, OUTSIDERS, changed
from frictid_hil.blind.figures import lagging, low_pass, rms, slip_of_spring
from frictid_hil.blind.joints import Joint, Payload, either_sign, log_uniform, told_body, told_experiments
from frictid_hil.blind.plant import Controller, Physics
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.experiments import FULL, SHORT, Envelope, chosen

KINDS = ("none",) * 4 + ("tolerance",) * 4 + ("single",) * 7 + ("double",) * 2 + ("outside",) * 3  # out of 20 cases
NOTHING, PRESENT, WITHHELD = 0.2, 0.5, 1.5
"""Sizes, in floors: below the first a contributor is nothing, from the second on it is there; what is withheld has at
least the third."""
SHARED = 0.7  # a contributor of this share of the largest is as good a first answer
FORM = {"none": 0.45, "tolerance": 0.7, "single": 1.0, "double": 1.0, "outside": 0.7}
"""Largest size, in floors, of what no number of the belief can say: another form of presliding, bends between pairs."""
FORMS = ("presliding_hysteresis", "viscous_nonlinearity", "stribeck", "stiction_breakaway")
"""What that may rightly be called."""
PAIRS = 14
FINE = 1e-3  # encoder step that sizes are measured with, over the joint's own: what steps make belongs to the floor
BEGUN_S = 0.3  # from then on a motion is compared: what a low-pass makes of its start is over
TIE = 0.35  # a single cause that leaves less of another one than this, in floors, can't be told from it
DRIVE = ("torque_delay", "electrical_lag", "torque_saturation")  # nobody sees them without the controller
_LEFT_OUT = ("velocity_lag", "encoder_quantisation", "temperature_drift", "backlash", "joint_elasticity")
"""Effects of the narrow world that these sizes do not measure, or that a pick-and-place log hardly shows."""

Changed = tuple[Physics, Controller]


@dataclass(frozen=True, slots=True)
class Contributor:
    """One reason why the joint is not as believed."""

    name: str  # of the effect that it is called
    role: str  # ``tolerance``, ``withheld`` or ``outside``
    parameters: dict[str, float]  # as the diagnosis would state them, by name; empty where it has other ones
    apply: Callable[[Physics, Controller], Changed]  # from a joint to the same joint with this reason
    sizes: dict[str, float] = field(default_factory=dict)  # what it alone changes by channel, in floors

    @property
    def alone(self) -> float:
        """Its size."""
        return max(self.sizes.values())


@dataclass(frozen=True, slots=True)
class Motion:
    """One recording to be: name, command at the control ticks (n,), payload mounted, judged on."""

    name: str
    command: Array
    payload: bool
    validation: bool


@dataclass(frozen=True, slots=True)
class Setting:
    """All of a case that is no contributor."""

    size: str  # class of joint
    physics: Physics  # as believed, traces on it
    payload: Payload  # known exactly
    control: Controller  # as believed
    law: str  # ``pid``, ``cascade`` or ``pid_feedforward``
    controller: str  # ``known``, ``rough`` or ``unknown``
    rated_nm: float  # of the drive
    noise_nm: float  # of the reported torque, white part
    corner_hz: float  # of a slow part of the noise; 0 for none
    filter_order: int  # of the torque's report filter; 0 for none
    filter_s: float  # its time constant
    thin: int  # control ticks per row of a log
    jitter: float  # of sampling, share of a step
    gaps: bool  # rows are missing here and there
    velocity: bool  # it is reported
    motions: tuple[Motion, ...]  # what is recorded
    kind: str  # of the motions
    tolerance: dict[str, float]  # stated one-sigma, relative
    absolute: dict[str, float]  # stated one-sigma in the number's unit
    believed: dict[str, float] = field(default_factory=dict)  # (cascade) kp, kv, ki as stated

    @property
    def step_s(self) -> float:
        """Of the logs."""
        return self.control.tick * self.thin


@dataclass(frozen=True, slots=True)
class Row:
    """One recording as written; columns (n,)."""

    name: str
    columns: dict[str, Array]


Drawn = tuple[dict[str, Any], tuple[Row, ...], dict[str, Any]]  # nominal.yaml, logs, truth

_SIZES: dict[str, tuple[tuple[float, float], tuple[int, ...], tuple[float, float]]] = {
    "hobby": ((3e-4, 6e-3), (200, 254, 288, 345), (1.5, 4.0)),
    "direct": ((2e-4, 2e-2), (1,), (4.0, 12.0)),
    "quasi_direct": ((5e-3, 0.2), (6, 8, 10), (2.0, 6.0)),
    "wrist": ((0.02, 0.3), (50, 80, 81, 101), (1.2, 2.5)),
    "elbow": ((0.2, 2.0), (81, 100, 120, 121), (1.0, 2.1)),
    "base": ((2.0, 15.0), (100, 141, 161, 300), (0.8, 1.6)),
}
"""Inertia, gear ratios and peak speed by class."""


@dataclass(frozen=True, slots=True)
class Deal:
    """A joint that is held, and why it is not as believed."""

    rng: np.random.Generator  # of its recordings
    setting: Setting
    base: Sequence[Run]  # of the joint as believed
    reasons: Sequence[Contributor]
    total: dict[str, float]  # what they change together by channel, in floors
    floors: Mapping[str, float]  # what noise alone leaves by channel, N m
    form: float  # what no number of the belief can say, in floors


def draw_wide(index: int, seed: int, kind: str) -> Drawn:
    """One case, the same from the same arguments."""
    deal = _dealt(index, seed, kind)
    logs = _recorded(deal.rng, deal.setting, *_applied(deal.setting, deal.reasons))
    name = f"case_{index:03d}"
    return _nominal(name, deal.setting), logs, _truth(name, kind, deal)


def recorded_again(index: int, seed: int, kind: str, *without: Collection[str]) -> list[tuple[Row, ...]]:
    """The motions of a case recorded once more with other noise, once for each set of contributors its joint lacks."""
    deal = _dealt(index, seed, kind)
    result = []
    for left_out in without:
        kept = [one for one in deal.reasons if one.name not in left_out]
        result.append(_recorded(np.random.default_rng([seed, 405, index]), deal.setting, *_applied(deal.setting, kept)))
    return result


def _dealt(index: int, seed: int, kind: str) -> Deal:
    """Drawn anew where the joint is not held, or what is withheld not seen."""
    for attempt in range(200):
        rng = np.random.default_rng([seed, 404, index, attempt])
        setting = _setting(rng)
        base = _runs(setting, setting.physics, setting.control)
        if base is None:
            continue
        floors = _floors(setting, base)
        if floors is None:
            continue
        form = rms(np.concatenate(_along(setting, base))) / floors["inverse"]  # left though every number is right
        if form > FORM[kind]:
            continue
        drawn = _contributors(rng, setting, kind, max(float(np.abs(t).max()) for _, t, _ in base))
        sizes = [_size(setting, base, [one], floors) for one in drawn]
        reasons = [replace(one, sizes=size) for one, size in zip(drawn, sizes, strict=True) if size is not None]
        if len(reasons) < len(drawn):
            continue
        if kind == "none":
            reasons = _shrunk(setting, base, reasons, floors)
        total = _size(setting, base, reasons, floors)
        if total is not None and _as_wanted(kind, reasons, max(total.values())):
            return Deal(rng, setting, base, reasons, total, floors, form)
    raise RuntimeError(f"no joint came up for case {index} of kind {kind}")


def _sized(rng: np.random.Generator, size: str) -> tuple[float, Physics, Payload, float, float]:
    """A joint of some size: inertia, physics, what it may carry, rated torque, highest speed."""
    (lightest, heaviest), gears, (slow, fast) = _SIZES[size]
    inertia, gear, speed = log_uniform(rng, lightest, heaviest), float(rng.choice(gears)), rng.uniform(slow, fast)
    scale = 8.0 * inertia**0.75 * (0.15 if gear == 1 else 0.5 if gear <= 10 else 1.0)
    continuous = size == "base" or (gear == 1 and rng.random() < 0.5)
    gravity = 0.0 if continuous else scale * rng.uniform(0.4, 1.8)
    coulomb = scale * rng.uniform(0.35, 1.2)
    viscous = coulomb * rng.uniform(0.2, 1.2)
    payload = Payload(inertia * rng.uniform(0.15, 0.5), gravity * rng.uniform(0.4, 1.1))
    acceleration_nm = inertia * speed * 8.0
    rated = float(
        f"{(gravity + payload.gravity_nm + coulomb + viscous + acceleration_nm) * rng.uniform(1.05, 1.5):.2g}"
    )
    family = int(rng.integers(4))
    share = rng.uniform(0.2, 0.55)
    output_side = size == "hobby"
    counts = 2.0 ** float(rng.integers(12, 15) if output_side else rng.integers(13, 20))
    physics = Physics(
        motor_inertia=share * inertia,
        link_inertia=(1.0 - share) * inertia,
        gravity=gravity,
        coulomb=coulomb,
        viscous_low=viscous / speed,
        viscous_high=viscous / speed * (rng.uniform(0.5, 1.0) if family == plant.RATE_BEND else 1.0),
        bend_velocity=speed if family != plant.RATE_BEND else speed * rng.uniform(0.25, 0.6),
        slip_length=log_uniform(rng, 1e-4, 4e-4) * (4.0 if gear <= 10 else 1.0),
        gear_ratio=gear,
        encoder_step=2.0 * math.pi / (counts * (1.0 if output_side else gear)),
        torque_limit=3.0 * rated,
        rate_family=family,
        slip_family=int(rng.choice(4, p=[0.4, 0.2, 0.2, 0.2])),
    )
    return inertia, physics, payload, rated, speed


def _setting(rng: np.random.Generator) -> Setting:
    size = str(rng.choice(list(_SIZES)))
    inertia, physics, payload, rated, speed = _sized(rng, size)
    gear, gravity = physics.gear_ratio, physics.gravity
    tick = float(rng.choice([0.001, 0.002, 0.004]))
    law = str(rng.choice(["pid", "cascade", "pid_feedforward"], p=[0.5, 0.35, 0.15]))
    control, believed = _control(rng, law, inertia, physics, tick, 3.0 * rated, fast=size in ("hobby", "direct"))
    knowledge, tolerance, absolute = _beliefs(rng, gravity > 0.0)
    noise = rated * log_uniform(rng, 1e-3, 0.012)
    physics = _with_traces(rng, physics, 0.4 * noise)
    kind = str(rng.choice(["full", "short", "multisine", "pick_place"], p=[0.2, 0.2, 0.35, 0.25]))
    if gear == 1 and kind in ("full", "short"):
        kind = "multisine"
    thin = int(rng.choice([1, 1, 2, 5])) if tick <= 0.002 else int(rng.choice([1, 2]))
    filtered = rng.random() < 0.5
    return Setting(
        size=size,
        physics=physics,
        payload=payload,
        control=control,
        law=law,
        controller=knowledge,
        rated_nm=rated,
        noise_nm=noise,
        corner_hz=0.0 if rng.random() < 0.3 else log_uniform(rng, 0.2, 8.0),
        filter_order=int(rng.integers(1, 3)) if filtered else 0,
        filter_s=log_uniform(rng, 1e-3, 6e-3),
        thin=thin,
        jitter=0.0 if rng.random() < 0.6 else rng.uniform(0.03, 0.15),
        gaps=bool(rng.random() < 0.2),
        velocity=bool(rng.random() < 0.8),
        motions=_motions(rng, kind, speed, tick, gravity > 0.0),
        kind=kind,
        tolerance=tolerance,
        absolute=absolute,
        believed=believed,
    )


def _beliefs(rng: np.random.Generator, heavy: bool) -> tuple[str, dict[str, float], dict[str, float]]:
    """(what is known of the controller, relative one-sigma of the believed numbers, absolute ones)."""
    quality = log_uniform(rng, 0.005, 0.1)
    tolerance = {
        name: float(np.clip(quality * log_uniform(rng, 0.4, 1.6), 0.005, 0.1))
        for name in ("inertia_kg_m2", "gravity_torque_nm", "friction_torque", "viscous", "presliding_stiffness")
    }
    tolerance["torque_constant"] = float(np.clip(0.35 * quality * log_uniform(rng, 0.5, 1.5), 0.005, 0.05))
    knowledge = str(rng.choice(["known", "rough", "unknown"], p=[0.3, 0.35, 0.35]))
    if knowledge == "known":
        tolerance["controller_gains"] = 0.0
    elif knowledge == "rough":
        tolerance["controller_gains"] = log_uniform(rng, 0.02, 0.1)
    if not heavy:
        del tolerance["gravity_torque_nm"]
    absolute = {} if not heavy else {"zero_offset_rad": log_uniform(rng, 2e-4, 4e-3)}
    return knowledge, tolerance, absolute


def _control(
    rng: np.random.Generator, law: str, inertia: float, physics: Physics, tick: float, limit: float, *, fast: bool
) -> tuple[Controller, dict[str, float]]:
    natural = rng.uniform(30.0, 50.0) if fast else rng.uniform(18.0, 30.0)
    natural = min(natural, 0.12 / tick)
    damping = rng.uniform(0.7, 0.95)
    # A coarse encoder must not shake the joint through the differentiator.
    step_nm = 2.0 * damping * natural * inertia * physics.encoder_step / tick
    smoothing = max(1.5 * tick, tick * 4.0 * step_nm / max(physics.coulomb, 1e-12))
    smoothing = min(smoothing, 0.2 / natural)
    kd, kp = 2.0 * damping * natural * inertia, inertia * natural**2
    plain = Controller(kp, kp * rng.uniform(1.5, 4.0), kd, smoothing, limit, tick=tick, substeps=round(tick / 5e-5))
    plain = plain._replace(backward=bool(rng.random() < 0.5))
    if law == "cascade":
        outer, pull = kp / kd, kd * rng.uniform(1.5, 4.0)
        control = plain._replace(kp=kd * outer, ki=pull * outer, inner=pull, rate_weight=0.0)
        return control, {"kp": outer, "kv": kd, "ki": pull}
    if law == "pid_feedforward":
        return plain._replace(inertia_ahead=inertia * rng.uniform(0.6, 1.0)), {}
    return plain, {}


def _with_traces(rng: np.random.Generator, physics: Physics, floor_nm: float) -> Physics:
    """Two effects at a fraction of the floor; they are on the belief as well, and count for nothing."""
    size = floor_nm * rng.uniform(0.05, 0.2, size=4)
    traces: list[dict[str, Any]] = [
        {"ripple": size[0], "ripple_phase": rng.uniform(0.0, 6.28)},
        {"asymmetry_coulomb": size[1] / physics.coulomb},
        {"bias": size[2]},
        {"cable": size[3]},
    ]
    for k in rng.choice(len(traces), size=2, replace=False):
        physics = physics._replace(**traces[int(k)])
    return physics


def _motions(rng: np.random.Generator, kind: str, speed: float, tick: float, posed: bool) -> tuple[Motion, ...]:
    centre = rng.uniform(-1.6, 1.6) if posed else 0.0
    if kind in ("full", "short"):
        envelope = Envelope(centre, rng.uniform(0.45, 0.6), speed, triangle_velocity_rad_s=rng.uniform(0.09, 0.115))
        made = []
        for one in chosen(FULL if kind == "full" else SHORT, envelope, seed=int(rng.integers(2**31))):
            times = np.arange(math.ceil(one.duration_s / tick)) * tick
            made.append(Motion(one.name, one.position_rad(times), one.payload, one.role == "validation"))
        return tuple(made)
    walk = multisine if kind == "multisine" else pick_place
    lengths = ((rng.uniform(25.0, 45.0), "excitation", False), (rng.uniform(15.0, 25.0), "excitation_2", True))
    return tuple(Motion(name, centre + walk(rng, speed, length, tick), False, last) for length, name, last in lengths)


def multisine(rng: np.random.Generator, speed: float, seconds: float, tick: float) -> Array:
    """Five sines of random phase, faded in; peak speed ``speed``."""
    times = np.arange(round(seconds / tick)) * tick
    hertz = np.sort(np.exp(rng.uniform(math.log(0.08), math.log(1.6), 5)))
    total = sum(np.sin(2 * math.pi * f * times + rng.uniform(0, 6.28)) / f for f in hertz)
    path: Array = np.asarray(total) * np.clip(times / 2.0, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(times / 2.0, 0.0, 1.0))
    path = path - path[0]
    return path * speed / float(np.abs(np.gradient(path, tick)).max())


def pick_place(rng: np.random.Generator, speed: float, seconds: float, tick: float) -> Array:
    """Quintic moves between a few places, with rests."""
    pieces, at = [np.zeros(round(0.6 / tick))], 0.0
    while sum(piece.size for piece in pieces) * tick < seconds:
        to = rng.uniform(-0.8, 0.8)
        rows = max(2, round(1.9 * abs(to - at) / (speed * rng.uniform(0.3, 1.0)) / tick))
        u = np.arange(1, rows + 1) / rows
        pieces.append(at + (to - at) * u**3 * (10.0 - 15.0 * u + 6.0 * u * u))
        pieces.append(np.full(round(rng.uniform(0.1, 0.8) / tick), to))
        at = to
    return np.concatenate(pieces)


def _tolerances(rng: np.random.Generator, setting: Setting) -> list[Contributor]:
    def drawn(sigma: float) -> float:
        return float(np.clip(rng.normal(0.0, sigma), -2.5 * sigma, 2.5 * sigma))

    t = setting.tolerance
    whole = setting.physics.motor_inertia + setting.physics.link_inertia
    made = [_share("inertia_error", drawn(t["inertia_kg_m2"]) * whole / setting.physics.link_inertia)]
    if "gravity_torque_nm" in t:
        made.append(_share("gravity_error", drawn(t["gravity_torque_nm"])))
    made += [_share("friction_level_error", drawn(t["friction_torque"])), _share("viscous_error", drawn(t["viscous"]))]
    softer = _scaling({"slip_length": 1 / (1 + drawn(t["presliding_stiffness"]))})
    made.append(Contributor("presliding_hysteresis", "tolerance", {}, softer))
    made.append(_share("torque_constant_error", drawn(t["torque_constant"])))
    if "zero_offset_rad" in setting.absolute:
        e = drawn(setting.absolute["zero_offset_rad"])
        made.append(Contributor("encoder_offset", "tolerance", {"offset_rad": -e}, _replacing({"gravity_angle": e})))
    if t.get("controller_gains"):
        made.append(_gains(setting, [1 + drawn(t["controller_gains"]) for _ in range(3)]))
    return made


_FRICTION = ("coulomb", "viscous_low", "viscous_high")
_SHARES = {
    "inertia_error": ("link_inertia",),
    "gravity_error": ("gravity",),
    "friction_level_error": _FRICTION,
    "viscous_error": _FRICTION[1:],
    "torque_constant_error": ("gain",),
}


def _share(name: str, e: float, role: str = "tolerance") -> Contributor:
    """Numbers of the plant that are (1 + e) times what is believed."""
    return Contributor(name, role, {"error_share": e}, _scaling(dict.fromkeys(_SHARES[name], 1 + e)))


def _gains(setting: Setting, gains: Sequence[float], role: str = "tolerance") -> Contributor:
    """The law's own numbers are so many times what is stated: kp, ki, kd; of a cascade kp, ki, kv."""
    first, second, third = gains
    kp, ki = (first * third, first * second) if setting.law == "cascade" else (first, second)
    shares = {"kp_error_share": kp - 1, "ki_error_share": ki - 1, "kd_error_share": third - 1}

    def true(p: Physics, c: Controller) -> Changed:
        return p, c._replace(kp=c.kp * kp, ki=c.ki * ki, kd=c.kd * third, inner=c.inner * second)

    return Contributor("controller_gain_error", role, shares, true)


def _scaling(factors: dict[str, float]) -> Callable[[Physics, Controller], Changed]:
    return lambda p, c: (p._replace(**{name: getattr(p, name) * factor for name, factor in factors.items()}), c)


def _replacing(values: dict[str, Any]) -> Callable[[Physics, Controller], Changed]:
    return lambda p, c: (p._replace(**values), c)


def _contributors(rng: np.random.Generator, setting: Setting, kind: str, peak_nm: float) -> list[Contributor]:
    found = _tolerances(rng, setting)
    if kind in ("none", "tolerance"):
        return found
    if kind == "outside":
        names = [n for n in OUTSIDERS if n != "missed_commands" or setting.controller != "unknown"]
        return [*found, _drawn(rng, setting, str(rng.choice(names)), peak_nm, "outside")]
    seen = [n for n in LIBRARY if n not in _LEFT_OUT and (setting.controller != "unknown" or n not in DRIVE)]
    if setting.physics.gravity == 0.0:
        seen = [n for n in seen if n not in ("gravity_error", "encoder_offset", "load_dependent_friction")]
    seen += ["friction_level_error", "viscous_error", "transmission_error"]
    seen += ["directional_efficiency"] if setting.physics.gravity else []
    seen += ["controller_gain_error"] if setting.controller != "unknown" else []
    names = [str(n) for n in rng.choice(seen, size=2 if kind == "double" else 1, replace=False)]
    kept = [one for one in found if one.name not in names]
    return [*kept, *(_drawn(rng, setting, name, peak_nm, "withheld") for name in names)]


def _drawn(rng: np.random.Generator, setting: Setting, name: str, peak_nm: float, role: str) -> Contributor:
    p = setting.physics
    if name in ("friction_level_error", "viscous_error"):
        least, most = (0.08, 0.4) if name == "friction_level_error" else (0.15, 0.7)
        return _share(name, either_sign(rng, least, most), role)
    if name == "controller_gain_error":
        return _gains(setting, [1 + either_sign(rng, 0.1, 0.4) for _ in range(3)], role)
    if name == "transmission_error":
        size = log_uniform(rng, 0.1, 0.6) * 2e-2 / p.gear_ratio
        phase = rng.uniform(0.0, 6.28)
        change: dict[str, Any] = {"kinematic": size, "kinematic_phase": phase}
        return Contributor(name, role, {"cycles_per_motor_revolution": 2.0}, _replacing(change))
    if name == "directional_efficiency":
        ahead = log_uniform(rng, 0.02, 0.25)
        change = {"driving_loss": ahead, "backdriving_loss": ahead * rng.uniform(0.1, 0.6)}
        return Contributor(name, role, {}, _replacing(change))
    differing = changed(name, rng, _as_narrow(setting), peak_nm)
    return Contributor(name, role, _parameters(name, p, p._replace(**differing)), _replacing(differing))


def _parameters(name: str, before: Physics, after: Physics) -> dict[str, float]:
    """In the diagnosis' own words, where it has the very same number."""
    return {
        "torque_bias": {"bias_nm": before.bias - after.bias},
        "gravity_error": {"error_share": after.gravity / before.gravity - 1.0 if before.gravity else 0.0},
        "inertia_error": {"error_share": after.link_inertia / before.link_inertia - 1.0},
        "torque_constant_error": {"error_share": after.gain - 1.0},
        "encoder_offset": {"offset_rad": -after.gravity_angle},
        "torque_delay": {"delay_s": after.delay},
    }.get(name, {})


def _as_narrow(setting: Setting) -> Joint:
    """The joint in the form that the draws of effects and outsiders read."""
    every = np.concatenate([m.command for m in setting.motions])
    tick = setting.control.tick
    speed = max(float(np.abs(np.gradient(m.command, tick)).max()) for m in setting.motions)
    envelope = Envelope(float(np.median(every)), 0.5 * float(np.ptp(every)), speed)
    return Joint(
        setting.physics, setting.payload, setting.physics, setting.payload, setting.control, envelope,
        setting.rated_nm, setting.noise_nm, 0.0, (),
    )  # fmt: skip


Run = tuple[Array, Array, Array]
"""Position, torque and what the believed controller would have asked for along it; at the control ticks."""


def _runs(setting: Setting, physics: Physics, control: Controller, steps: float = FINE) -> list[Run] | None:
    """Every motion without noise, an encoder's steps so much finer; None where the controller cannot hold the joint."""
    runs, heat, clock = [], 0.0, 0.0
    physics = physics._replace(encoder_step=steps * physics.encoder_step)
    for motion in setting.motions:
        mounted = setting.payload.on(physics, motion.payload)
        never = np.ones(motion.command.size)
        chance = np.random.default_rng(motion.command.size).random(motion.command.size) if physics.missed else never
        position, _, torque, heat = plant.run(motion.command, control, mounted, heat, clock, chance)
        clock += motion.command.size * control.tick
        error = motion.command - position
        reach = 0.12 * max(float(np.ptp(motion.command)), 0.3) + 0.05
        if not np.all(np.isfinite(error)) or np.abs(error).max() > 2.0 * reach or np.ptp(error[-100:]) > reach:
            return None
        runs.append((position, torque, asked(setting.control, motion.command, position, float(torque[0]))))
    return runs


def asked(c: Controller, command: Array, position: Array, start_nm: float) -> Array:
    """The believed law along a motion, without its limit; row k acts from tick k on."""
    velocity = np.diff(position, prepend=position[0]) / c.tick
    filtered = lagging(velocity, c.tick, c.velocity_filter)
    rate = np.diff(command, prepend=command[0]) / c.tick if c.backward else np.gradient(command, c.tick)
    bend = np.gradient(np.gradient(command, c.tick), c.tick)
    error = command - position
    slow = c.rate_weight * rate - filtered
    total = np.concatenate([[0.0], np.cumsum((c.ki * error + c.inner * slow) * c.tick)[:-1]])
    demand: Array = c.kp * error + c.kd * slow + total + c.inertia_ahead * bend
    demand += start_nm - demand[0]
    return demand


def _floors(setting: Setting, base: Sequence[Run]) -> dict[str, float] | None:
    """What noise and the encoder's steps leave of each channel in the rows of the logs, N m; None as above.

    Rows that are fewer than control ticks fold the jumps of a torque, which every step makes, into what the low-pass
    lets through; the best answer leaves them there. A closed loop that nobody can simulate is no channel.
    """
    noise = rms(low_pass(_noise(np.random.default_rng(1), setting, 20_000), 1.0 / setting.step_s))
    stepped = _runs(setting, setting.physics, setting.control, steps=1.0)
    if stepped is None:
        return None
    coarse, fine = _in_rows(setting, stepped), _in_rows(setting, base)
    return {
        channel: math.hypot(
            noise, rms(np.concatenate([c - f for c, f in zip(coarse[channel], fine[channel], strict=True)]))
        )
        for channel in coarse
    }


def _in_rows(setting: Setting, runs: Sequence[Run]) -> dict[str, list[Array]]:
    """What each channel shows of the rows that a log keeps, by motion, low-passed."""
    tick, thin, step_s = setting.control.tick, setting.thin, setting.step_s
    shown: dict[str, list[Array]] = {"inverse": []}
    if setting.controller != "unknown":
        shown["torque"] = []
        if thin == 1:  # what a controller asked for between the rows of its log nobody knows
            shown["actuation"] = []
    for (q, torque, _), motion in zip(runs, setting.motions, strict=True):
        kept, read = q[::thin], _reported(setting, torque, tick)[::thin]
        centred = read + 0.5 / thin * np.diff(read, append=read[-1])
        along = _reported(setting, _asked_nm(setting, kept, motion, step_s), step_s)
        shown["inverse"].append(low_pass(centred - along, 1.0 / step_s)[round(BEGUN_S / step_s) :])
        if setting.controller == "unknown":
            continue
        shown["torque"].append(low_pass(read, 1.0 / step_s))
        if thin > 1:
            continue
        demand = _reported(setting, asked(setting.control, motion.command, q, float(torque[0])), tick)
        late = read - np.concatenate([demand[:1], demand[:-1]])
        shown["actuation"].append(low_pass(late - np.median(late[: round(0.5 / step_s)]), 1.0 / step_s))
    return shown


def _reported(setting: Setting, torque: Array, step_s: float) -> Array:
    """As the drive's own filter lets it through."""
    for _ in range(setting.filter_order):
        torque = torque[0] + lagging(torque - torque[0], step_s, setting.filter_s)
    return torque


def _pairs(setting: Setting) -> tuple[list[float], list[float]]:
    """Speeds and friction of the believed curve."""
    p, fastest = setting.physics, _as_narrow(setting).envelope.velocity_rad_s
    # Down to creep, as a calibration measures: a root or an inverse sine bends there.
    speeds = [float(speed) for speed in fastest * np.geomspace(0.01, 1.0, PAIRS)]
    return speeds, [p.coulomb + float(plant.rate_part(_bare(p), speed)) for speed in speeds]


def _along(setting: Setting, runs: Sequence[Run]) -> list[Array]:
    """Torque less what the joint's file asks for along each motion, low-passed: what its own equation leaves."""
    tick, left = setting.control.tick, []
    for (q, torque, _), motion in zip(runs, setting.motions, strict=True):
        centred = 0.5 * (torque + np.concatenate([torque[1:], torque[-1:]]))
        left.append(low_pass(centred - _asked_nm(setting, q, motion, tick), 1.0 / tick)[round(BEGUN_S / tick) :])
    return left


def _asked_nm(setting: Setting, q: Array, motion: Motion, step_s: float) -> Array:
    """Torque that the joint's file asks for along a motion, N m, shape (n,)."""
    p = setting.physics
    speeds, torques = _pairs(setting)
    # The curve goes on below its first pair along its first line.
    level = max(1e-12, torques[0] - (torques[1] - torques[0]) / (speeds[1] - speeds[0]) * speeds[0])
    mounted = setting.payload.on(p, motion.payload)
    v = np.gradient(q, step_s)
    bend = np.zeros_like(q)
    bend[1:-1] = np.diff(q, 2) / step_s**2
    sliding = np.interp(np.abs(v), [0.0, *speeds], [level, *torques]) - level
    friction = level * slip_of_spring(q, p.slip_length * level / p.coulomb) + np.sign(v) * sliding
    asked: Array = (mounted.motor_inertia + mounted.link_inertia) * bend + mounted.gravity * np.cos(q) + friction
    return asked


def _noise(rng: np.random.Generator, setting: Setting, rows: int) -> Array:
    """White noise, and a slow part of half its size below the corner."""
    white: Array = setting.noise_nm * rng.standard_normal(rows)
    if setting.corner_hz <= 0.0:
        return white
    keep = math.exp(-2.0 * math.pi * setting.corner_hz * setting.step_s)
    slow: Array = signal.lfilter([math.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(rows))
    return white + 0.5 * setting.noise_nm * slow


def _applied(setting: Setting, reasons: Sequence[Contributor]) -> Changed:
    physics, control = setting.physics, setting.control
    for one in reasons:
        physics, control = one.apply(physics, control)
    return physics, control


def _response(setting: Setting, base: Sequence[Run], reasons: Sequence[Contributor]) -> dict[str, list[Array]] | None:
    """What reasons change, by channel and motion, low-passed.

    Channels are the torque of the closed loop, torque less what the file asks for along the motion (``inverse``), and
    torque less demand (``actuation``).
    """
    runs = _runs(setting, *_applied(setting, reasons))
    if runs is None:
        return None
    rate = 1.0 / setting.control.tick
    changed = {"torque": [low_pass(t - t0, rate) for (_, t, _), (_, t0, _) in zip(runs, base, strict=True)]}
    changed["inverse"] = [left - own for left, own in zip(_along(setting, runs), _along(setting, base), strict=True)]
    if setting.controller != "unknown":
        late = [(t[1:] - a[:-1]) - (t0[1:] - a0[:-1]) for (_, t, a), (_, t0, a0) in zip(runs, base, strict=True)]
        changed["actuation"] = [low_pass(part - np.median(part[: round(0.5 * rate)]), rate) for part in late]
    return changed


def _size(
    setting: Setting, base: Sequence[Run], reasons: Sequence[Contributor], floors: Mapping[str, float]
) -> dict[str, float] | None:
    changed = _response(setting, base, reasons)
    if changed is None:
        return None
    return {channel: rms(np.concatenate(changed[channel])) / floor_nm for channel, floor_nm in floors.items()}


def _shrunk(
    setting: Setting, base: Sequence[Run], reasons: Sequence[Contributor], floors: Mapping[str, float]
) -> list[Contributor]:
    """Deviations taken away, the largest first, until what is left together is no gap."""
    kept = sorted(reasons, key=lambda one: one.alone)
    while kept:
        together = _size(setting, base, kept, floors)
        if together is not None and max(together.values()) < PRESENT:
            break
        kept.pop()
    return kept


def _as_wanted(kind: str, reasons: Sequence[Contributor], total: float) -> bool:
    if kind == "none":
        return True
    within = max((r.alone for r in reasons if r.role == "tolerance"), default=0.0)
    if kind == "tolerance":
        return 80.0 > total >= 1.0 and within >= 2.0 * PRESENT
    own = [r.alone for r in reasons if r.role == ("outside" if kind == "outside" else "withheld")]
    return min(own) >= WITHHELD and max(own) < 80.0 and min(own) >= within


def _recorded(rng: np.random.Generator, setting: Setting, physics: Physics, control: Controller) -> tuple[Row, ...]:
    rows, heat, clock = [], 0.0, 0.0
    for motion in setting.motions:
        mounted = setting.payload.on(physics, motion.payload)
        n = motion.command.size
        position, velocity, torque, heat = plant.run(motion.command, control, mounted, heat, clock, rng.random(n))
        clock += n * control.tick
        torque = _reported(setting, torque, control.tick)
        ticks = control.tick * np.arange(n)
        times = ticks[:: setting.thin]
        if setting.jitter > 0.0:
            times = np.sort(times + setting.jitter * setting.step_s * rng.uniform(-1.0, 1.0, times.size))
            times = times[(times >= 0.0) & (times <= ticks[-1])]
        if setting.gaps:
            times = times[rng.random(times.size) > 0.002]
        quantum = 1e-3 * setting.rated_nm
        noise = np.interp(times, ticks[:: setting.thin], _noise(rng, setting, ticks[:: setting.thin].size))
        columns = {"time_s": times, "position_rad": np.interp(times, ticks, position)}
        if setting.velocity:
            columns["velocity_rad_s"] = np.interp(times, ticks, velocity)
        columns["torque_nm"] = quantum * np.round((np.interp(times, ticks, torque) + noise) / quantum)
        if setting.controller != "unknown" or setting.velocity:
            columns["position_command_rad"] = np.interp(times, ticks, motion.command)
        rows.append(Row(motion.name, columns))
    return tuple(rows)


def _nominal(name: str, setting: Setting) -> dict[str, Any]:
    p, c = setting.physics, setting.control
    speeds, torques = _pairs(setting)
    document: dict[str, Any] = {
        "case": name,
        "joint": {
            **told_body(p.motor_inertia, p.link_inertia, p.gravity, p.gear_ratio),
            "continuous": p.gravity == 0.0,
            "friction": {
                "velocity_rad_s": speeds,
                "torque_nm": torques,
                "presliding_stiffness_nm_per_rad": p.coulomb / p.slip_length,
            },
        },
        "drive": {"rated_torque_nm": setting.rated_nm, "torque_quantum_nm": 1e-3 * setting.rated_nm},
        "encoder": {"resolution_rad": p.encoder_step},
        "tolerance": {**setting.tolerance, "absolute": setting.absolute},
        "experiments": told_experiments(
            ".csv.gz", ((m.name, m.validation, m.payload, m.command.size * c.tick) for m in setting.motions)
        ),
    }
    if setting.filter_order:
        told = {"order": setting.filter_order, "time_constant_s": setting.filter_s}
        document["drive"]["torque_report_filter"] = told
    if any(m.payload for m in setting.motions):
        document["payload"] = {
            "inertia_kg_m2": setting.payload.inertia_kg_m2,
            "gravity_torque_nm": setting.payload.gravity_nm,
        }
    if setting.controller != "unknown":
        law: dict[str, Any] = {"type": "pid", "kp": c.kp, "ki": c.ki, "kd": c.kd}
        if setting.law == "cascade":
            law = {"type": "cascade", **setting.believed}
        if c.inertia_ahead:
            law["feedforward"] = {"inertia_kg_m2": c.inertia_ahead}
        document["controller"] = {
            **law,
            "rate_hz": 1.0 / c.tick,
            "velocity_filter_s": c.velocity_filter,
            "torque_limit_nm": c.torque_limit,
            "command_rate": "backward" if c.backward else "central",
        }
    return document


def _bare(p: Physics) -> Physics:
    """The sliding curve's own plant: two straight lines where it bends, as pairs can tell."""
    return p._replace(rounding=0.0, rate_extra=0.0)


def _truth(name: str, kind: str, deal: Deal) -> dict[str, Any]:
    setting, reasons, form = deal.setting, deal.reasons, deal.form
    withheld = [r for r in reasons if r.role != "tolerance"]
    largest = max((r.alone for r in reasons), default=0.0)
    first = [r.name for r in reasons if r.alone >= SHARED * largest and r.alone >= PRESENT]
    if kind == "single" or kind == "double":
        first = list(dict.fromkeys([*(r.name for r in withheld), *first]))
    there = [r.name for r in reasons if r.alone >= PRESENT or r in withheld]
    return {
        "case": name,
        "world": "wide",
        "kind": kind,
        "main": [] if kind == "none" else ["unknown"] if kind == "outside" else first,
        "effects": [{"name": r.name, "in_library": r.role != "outside"} for r in withheld],
        "present": [*there, *(FORMS if form >= PRESENT else ())],
        "neutral": [
            *(r.name for r in reasons if NOTHING <= r.alone < PRESENT),
            *(FORMS if NOTHING <= form < PRESENT else ()),
        ],
        "form": form,
        "controller": setting.controller,
        "size_ratio": max(deal.total.values()),
        "floors_nm": dict(deal.floors),
        "contributors": [
            {
                "name": r.name,
                "role": r.role,
                "size_alone": r.alone,
                "by_channel": r.sizes,
                "indistinguishable": _tied(setting, deal.base, r, deal.floors["inverse"]) if r.alone >= PRESENT else [],
            }
            for r in reasons
        ],
        "true_parameters": [
            {"effect": r.name, "parameter": parameter, "value": value}
            for r in reasons
            if r.alone >= 1.0 and r.role != "outside"
            for parameter, value in r.parameters.items()
        ],
        # Of the joint, for who looks at a miss.
        "facts": {
            "size": setting.size,
            "law": setting.law,
            "motions": setting.kind,
            "gear_ratio": setting.physics.gear_ratio,
            "rate_family": setting.physics.rate_family,
            "slip_family": setting.physics.slip_family,
            "rate_hz": 1.0 / setting.step_s,
        },
    }


def _tied(setting: Setting, base: Sequence[Run], reason: Contributor, floor_nm: float) -> list[str]:
    """Single causes that leave next to nothing of what a reason changes along these motions."""
    changed = _response(setting, base, [reason])
    if changed is None or rms(np.concatenate(changed["inverse"])) < PRESENT * floor_nm:
        return []
    target = np.concatenate(changed["inverse"])
    p, tick = setting.physics, setting.control.tick
    columns: dict[str, list[Array]] = {}
    bare = _bare(p)
    for (q, torque, _), motion in zip(base, setting.motions, strict=True):
        smooth = low_pass(q, 1.0 / tick)
        v = np.gradient(smooth, tick)
        grid = np.linspace(0.0, float(np.abs(v).max()), 60)
        rate = np.sign(v) * np.interp(np.abs(v), grid, [float(plant.rate_part(bare, speed)) for speed in grid])
        s = np.tanh(v / (0.01 * np.abs(v).max()))
        gravity = p.gravity + (setting.payload.gravity_nm if motion.payload else 0.0)
        for name, column in {
            "torque_bias": np.ones_like(q), "gravity_error": np.cos(q), "encoder_offset": gravity * np.sin(q),
            "inertia_error": np.gradient(v, tick), "friction_level_error": p.coulomb * s + rate,
            "viscous_error": rate, "torque_constant_error": torque, "direction_asymmetry": np.abs(s),
            "torque_delay": np.gradient(torque, tick),
        }.items():  # fmt: skip
            columns.setdefault(name, []).append(low_pass(column, 1.0 / tick)[round(BEGUN_S / tick) :])
    tied = []
    for name, parts in columns.items():
        column = np.concatenate(parts)
        power = float(column @ column)
        left = target - column * float(column @ target) / power if power > 0.0 else target
        if name != reason.name and rms(left) < TIE * floor_nm:
            tied.append(name)
    return tied
