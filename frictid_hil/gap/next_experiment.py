"""What to record next: the experiment that is expected to tell most between two causes that a set cannot part.

Each of the two stands for a model that holds it and not the other. Along every experiment of the catalogue that fits
into the travel and the speed of the recordings, both models predict the torque, and how uncertain it is. How many nats
of evidence the experiment is expected to bring for the right one is then a closed form, since all is Gaussian. Two
causes that do not show in the torque along a motion are parted by what their effects name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import STIFFNESS
from frictid_hil.gap.diagnosis import NextExperiment
from frictid_hil.gap.experiment_set import Experiment, Nominal
from frictid_hil.gap.findings import Sampled
from frictid_hil.gap.posterior import Known
from frictid_hil.gap.residuals import LowPass, Recording, nominal_torque, view_of
from frictid_hil.gap.rigid_column import IN_COLUMN
from frictid_hil.plan.experiments import Envelope, catalogue, plan_document
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.inverse import View

DECIDES_NATS = math.log(20.0)  # evidence that decides: odds of 20 to 1
TELLS_NATS = 0.1  # evidence below which an experiment tells nothing: odds of 1.1 to 1
SET_UP_S = 20.0  # time that an experiment costs besides its motion: the question, the way there and back
SECOND_POSTURE_RAD = 1.2  # distance of the second posture from the first
_DEFAULT = (
    "chirp",
    "the full set with varied motion: two travels, a slow triangle, a chirp, break-away, and payload on and off",
    150.0,
)
_STANDARD = ("sines_small", "sines_large", "triangle_slow", "sines_payload", "chirp", "breakaway")


@dataclass(frozen=True, slots=True)
class Expected:
    """What an experiment is expected to bring."""

    name: str  # of the experiment
    evidence_nats: float  # for the right one of two causes
    duration_s: float  # of its motion


def next_experiment(
    first: str, second: str, nominal: Nominal, logs: Sequence[Recording], plant: Sampled | None
) -> NextExperiment:
    """The experiment that parts two effects, as text and as a plan for ``gap record --plan``.

    ``plant`` holds draws of the plant channel; None where no log has a torque.
    """
    recorded = {log.experiment.name for log in logs}
    # A planned motion has no rigid-body column yet, so that it tells nothing of what the column holds.
    in_column = nominal.inertia_kg_m2 is None and {first, second} & set(IN_COLUMN)
    found = [] if plant is None or in_column else expected(first, second, nominal, logs, plant)
    fresh = [one for one in found if one.name not in recorded and one.evidence_nats > TELLS_NATS]
    if not fresh:
        return _named_by_effects(first, second, recorded)
    deciding = [one for one in fresh if one.evidence_nats >= DECIDES_NATS]
    if deciding:
        best = min(deciding, key=lambda one: one.duration_s)
        worth = "odds of 20 to 1 or more"
    else:
        best = max(fresh, key=lambda one: one.evidence_nats / (one.duration_s + SET_UP_S))
        worth = f"odds of {math.exp(best.evidence_nats):.2g} to 1; repeat it, or use more travel or speed"
    why = f"{best.name} is expected to part {first} from {second} with {worth}"
    return NextExperiment(why, best.duration_s, (first, second), plan_document([best.name], why))


def expected(
    first: str, second: str, nominal: Nominal, logs: Sequence[Recording], plant: Sampled
) -> tuple[Expected, ...]:
    """What every experiment within the recorded travel and speed is expected to bring; none where no model tells."""
    posterior = plant.posterior
    with_first, with_second = (posterior.rival(one, other) for one, other in ((first, second), (second, first)))
    if with_first is None or with_second is None:
        return ()
    low_pass = LowPass(1.0 / logs[0].step_s, posterior.channel.cutoff_hz)
    told = []
    for one in catalogue(_envelope(nominal, logs)).values():
        if one.role != "identification" or (one.payload and nominal.payload is None):
            continue
        view = _along(nominal, one.position_rad(np.arange(0.0, one.duration_s, logs[0].step_s)), one.payload, logs[0])
        models = [_columns(known, view, low_pass) for known in (with_first, with_second)]
        nats = _evidence(models[0], with_first, models[1], with_second, posterior.floor)
        told.append(Expected(one.name, nats / posterior.doubt, one.duration_s))
    return tuple(told)


def _envelope(nominal: Nominal, logs: Sequence[Recording]) -> Envelope:
    """The travel and the speed of the recordings themselves; a second posture beside them, where gravity acts."""
    lowest = min(float(np.min(log.experiment.position_rad)) for log in logs)
    highest = max(float(np.max(log.experiment.position_rad)) for log in logs)
    rate = LowPass.at(1.0 / logs[0].step_s)
    speeds = [np.abs(rate(np.gradient(log.experiment.position_rad, log.step_s))) for log in logs]
    centre, travel = 0.5 * (lowest + highest), 0.5 * min(highest - lowest, 2.0 * math.pi)
    speed = float(np.quantile(np.concatenate(speeds), 0.99))
    posture = centre + SECOND_POSTURE_RAD if nominal.gravity_cos_nm or nominal.gravity_sin_nm else None
    return Envelope(
        centre,
        travel,
        speed,
        triangle_rad=min(0.5, 0.9 * travel),
        triangle_velocity_rad_s=min(0.1, 0.5 * speed),
        chirp_velocity_rad_s=min(0.35, 0.25 * speed + 0.1),
        second_centre_rad=posture,
    )


def _along(nominal: Nominal, position_rad: Array, payload: bool, log: Recording) -> View:
    """What inverse forms see of the believed joint along a motion that it follows exactly."""
    time_s = log.step_s * np.arange(position_rad.size)
    bare = Experiment("next", False, payload, 0, time_s, position_rad, torque_nm=np.zeros(position_rad.size))
    view = view_of(nominal, bare, log.step_s, 0.0)
    return replace(view, torque_nm=nominal_torque(nominal, bare, view))


def _columns(known: Known, view: View, low_pass: LowPass) -> Array:
    """What a model's coefficients multiply along a motion, shape (rows, coefficients); 0 for what has no name."""
    columns: list[Array] = []
    for term in known.terms:
        form = all_effects()[term.effect].inverse if term.effect in all_effects() else None
        own = None if form is None or STIFFNESS in term.shape else form.regressors([view], term.shape)[0]
        columns.append(own if own is not None else np.zeros((view.position_rad.size, len(term.columns))))
    return low_pass.thinned_blocks(columns)


def _evidence(x_first: Array, first: Known, x_second: Array, second: Known, floor: float) -> float:
    """Mean log-odds that rows bring for the right one of two Gaussian models, nats; x (rows, coefficients) each."""
    # Where neither model's columns reach, both say the same.
    basis, sizes, _ = np.linalg.svd(np.concatenate([x_first, x_second], axis=1), full_matrices=False)
    basis = basis[:, sizes > 1e-9 * max(float(sizes[0]), 1e-300)]
    means, covariances = [], []
    for x, known in ((x_first, first), (x_second, second)):
        reached = basis.T @ x
        root = reached @ known.root
        means.append(reached @ known.mean / floor)
        covariances.append(root @ root.T / floor**2 + np.eye(basis.shape[1]))
    apart = means[0] - means[1]
    total = 0.0
    for one, other in ((0, 1), (1, 0)):
        inverse = np.linalg.inv(covariances[other])
        total += 0.5 * (float(np.trace(inverse @ covariances[one])) - basis.shape[1] + float(apart @ inverse @ apart))
    # The logarithms of the determinants cancel between the two directions.
    return 0.5 * total


def _named_by_effects(first: str, second: str, recorded: set[str]) -> NextExperiment:
    """What the effects themselves say parts them; the standard experiments that are missing otherwise."""
    for one, other in ((first, second), (second, first)):
        effect = all_effects().get(one)
        for parting in effect.parted if effect is not None else ():
            if parting.rival == other:
                return _planned([parting.experiment], parting.why, parting.duration_s, (first, second))
    missing = [name for name in _STANDARD if name not in recorded]
    if len(missing) >= 4:
        return _planned(list(_STANDARD), _DEFAULT[1], _DEFAULT[2], (first, second))
    name = missing[0] if missing else _DEFAULT[0]
    why = f"{name} once more with twice the travel, to part them by varied motion"
    return _planned([name], why, 30.0, (first, second))


def _planned(names: Sequence[str], why: str, duration_s: float, separates: tuple[str, str]) -> NextExperiment:
    return NextExperiment(why, duration_s, separates, plan_document(names, why))
