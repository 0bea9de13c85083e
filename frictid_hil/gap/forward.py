"""The joint simulated again along the recorded commands, with and without effects: the product's own simulator.

Closed loop only: the controller pulls a simulated joint back to its command as it does the real one, so a small error
of the model stays a small difference of torque and does not grow into another motion.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.gap.residuals import LowPass, between, first_slide, friction_scales, reported, rms, uniform
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import Drive, Encoder, JointModel, ServoGains
from frictid_hil.simulation.replay import SUBSTEP_S, CarryOver, Controller, Simulated, closed_loop

Effects = Mapping[str, Mapping[str, float]]

SAME_RATE = 0.05  # a row holds a whole number of control ticks where the two clocks differ by no more than this share
RIGID_SUBSTEP_S = 5e-4
"""Sub-step of a joint whose link does not swing and whose friction is no bristle. A fifth of it changes the torque of
drawn joints by a few hundredths of the noise; by a quarter of it where an encoder's steps decide when a joint lets go,
or where a gear loses much of the torque."""
BRISTLE = "presliding_hysteresis"  # is integrated step by step: a light joint on a stiff one needs the short sub-step
SETTLING_S = 0.3  # time the controller takes after the first slide to forget the start


@dataclass(frozen=True, slots=True)
class Replayed:
    """Recorded minus simulated, low-passed once; arrays of shape (n,)."""

    torque_nm: Array  # difference of torque
    position_rad: Array  # difference of position
    settled: int = 0  # first row that what friction held before the recording no longer touches


def why_not(experiments: ExperimentSet) -> str | None:
    """Why nothing can be simulated again, or None where it can."""
    nominal = experiments.nominal
    if nominal.controller is None:
        return "the nominal joint names no controller, so its closed loop cannot be simulated again"
    if nominal.inertia_kg_m2 is None or nominal.inertia_kg_m2 <= 0.0:
        return "the nominal joint has no inertia"
    if nominal.curve is None:
        return "the nominal joint has no friction curve"
    if any(e.rigid_body_torque_nm is not None for e in experiments.experiments):
        return "the rigid-body torque comes from elsewhere, so the joint alone cannot be simulated"
    if any(e.position_command_rad is None for e in experiments.experiments):
        return "a log has no position command"
    return None


def nominal_model(nominal: Nominal) -> JointModel:
    """The nominal joint as the simulator's own value; call only where ``why_not`` is None."""
    assert nominal.inertia_kg_m2 is not None and nominal.curve is not None and nominal.controller is not None
    gear_ratio = nominal.gear_ratio or 1.0
    step = nominal.encoder_resolution_rad or 0.0
    _, stiffness = friction_scales(nominal)
    rated = nominal.rated_torque_nm or 1.0
    quantum = nominal.torque_quantum_nm or 0.0
    return JointModel(
        inertia_kg_m2=nominal.inertia_kg_m2,
        motor_inertia_share=nominal.motor_inertia_share or 0.3,
        gravity_cos_nm=nominal.gravity_cos_nm,
        gravity_sin_nm=nominal.gravity_sin_nm,
        gear_ratio=gear_ratio,
        friction=nominal.curve,
        presliding_stiffness_nm_per_rad=stiffness,
        encoder=Encoder("motor", 2.0 * math.pi / (step * gear_ratio) if step > 0.0 else 0.0),
        drive=Drive(
            rated, nominal.controller.torque_limit_nm, 1000.0 * quantum / rated, 0.0, nominal.velocity_filter_s
        ),
        servo=ServoGains(
            nominal.controller.kp_nm_per_rad, nominal.controller.ki_nm_per_rad_s, nominal.controller.kd_nm_s_per_rad
        ),
        payload=nominal.payload,
    ).with_effects({**nominal.believed_effects, **_gradual(nominal)})


def _gradual(nominal: Nominal) -> dict[str, dict[str, float]]:
    """The effect by which friction builds up gradually; none where it builds up as a spring."""
    if not nominal.yields_gradually:
        return {}
    coulomb, stiffness = friction_scales(nominal)
    values = {"share": 1.0, "distance_rad": coulomb / stiffness, "loop_exponent": 1.0, "loop_beta": 1.0}
    return {"presliding_hysteresis": bounded("presliding_hysteresis", values)}


def bounded(name: str, values: Mapping[str, float]) -> dict[str, float]:
    """The effect's own parameters among ``values``, within its bounds."""
    limits = {p.name: p for p in all_effects()[name].parameters}
    return {k: float(np.clip(v, limits[k].lower, limits[k].upper)) for k, v in values.items() if k in limits}


_Key = tuple[tuple[str, tuple[tuple[str, float], ...]], ...]


def _key(effects: Effects) -> _Key:
    return tuple((name, tuple(sorted(values.items()))) for name, values in sorted(effects.items()))


class Replay:
    """Replays of one experiment set; the nominal model may carry any effects."""

    def __init__(self, experiments: ExperimentSet) -> None:
        self._experiments = tuple(uniform(e)[0] for e in experiments.experiments)
        self._report = experiments.nominal.torque_report_filter
        self._nominal = nominal_model(experiments.nominal)
        coulomb, stiffness = friction_scales(experiments.nominal)
        self._slide_rad = 3.0 * coulomb / stiffness
        controller = experiments.nominal.controller
        assert controller is not None
        told = {field.name: getattr(controller, field.name) for field in fields(Controller)}
        self._controller = Controller(**told)
        self._held: dict[_Key, dict[str, Replayed]] = {}

    def recorded(self, *, steps: bool = False) -> tuple[Experiment, ...]:
        """The believed joint itself, recorded as the set was; its drive rounds nothing, nor does its encoder.

        With ``steps`` the encoder rounds as it does.
        """
        model, state = self._nominal, None
        if not steps:
            model = replace(model, encoder=replace(model.encoder, counts_per_revolution=0.0))
        model = replace(model, drive=replace(model.drive, torque_quantum_per_mille=0.0))
        made = []
        for e in self._experiments:
            rows = self._rows(model, e, state)
            state = rows.state
            told = replace(e, position_rad=rows.position_rad, torque_nm=rows.torque_nm)
            made.append(replace(told, velocity_rad_s=None, torque_demand_nm=None))
        return tuple(made)

    def model(self, effects: Effects) -> JointModel:
        """The nominal joint with effects added (to those it already has); a drive is later by their times."""
        merged = {name: dict(values) for name, values in self._nominal.effects.items()}
        for name, values in effects.items():
            form, there = all_effects()[name].actuation, merged.get(name, {})
            if form is not None and form.late and form.parameter in values:
                values = {**values, form.parameter: values[form.parameter] + there.get(form.parameter, 0.0)}
            merged[name] = {**there, **bounded(name, values)}
        return self._nominal.with_effects(merged)

    def __call__(
        self, effects: Effects, *, validation: bool | None = None, only: Collection[str] | None = None
    ) -> dict[str, Replayed]:
        """Differences by experiment name, of validation logs only, of the others only, or of all (None).

        Of those ``only`` the named ones, where names are given. Warmth carries over in run order, so earlier logs are
        simulated too where an effect remembers. What was replayed once is held.
        """
        wanted = [e.name for e in self._experiments if validation is None or e.validation == validation]
        wanted = [name for name in wanted if only is None or name in only]
        held = self._held.setdefault(_key(effects), {})
        if missing := [name for name in wanted if name not in held]:
            carried = any(all_effects()[name].carried for name in effects)
            held |= self._replayed(self.model(effects), carried, missing)
        return {name: held[name] for name in wanted}

    @property
    def identifies(self) -> bool:
        """Whether a log is there for identification."""
        return any(not e.validation for e in self._experiments)

    def without_steps(self) -> Replay:
        """The same replays with an encoder that rounds nothing."""
        other = copy.copy(self)
        other._nominal = replace(self._nominal, encoder=replace(self._nominal.encoder, counts_per_revolution=0.0))
        other._held = {}
        return other

    def steps_nm(self, bare: Mapping[str, Replayed], validation: bool | None) -> float:
        """RMS of what the encoder's steps make of the believed joint's torque, N m; ``bare`` is its replay with them.

        In a closed loop they decide when a joint lets go: the recording and its simulation are two draws of it.
        """
        if self._nominal.encoder.counts_per_revolution == 0.0:
            return 0.0
        smooth = self.without_steps()({}, validation=validation)
        apart = [(bare[n].torque_nm - run.torque_nm)[run.settled :] for n, run in smooth.items()]
        return rms(np.concatenate(apart))

    def _replayed(self, model: JointModel, carried: bool, wanted: Collection[str]) -> dict[str, Replayed]:
        state: CarryOver | None = None
        result: dict[str, Replayed] = {}
        for experiment in self._experiments:
            if carried or experiment.name in wanted:
                result[experiment.name], state = self._one(model, experiment, state)
            if result.keys() >= set(wanted):
                break
        return result

    def _rows(self, model: JointModel, e: Experiment, state: CarryOver | None) -> Simulated:
        """One recording simulated, its torque reported as the drive does: the controller's last tick, filtered."""
        assert e.position_command_rad is not None
        step_s = e.step_s
        ticks = max(1, round(self._controller.rate_hz * step_s))
        last = (e.time_s.size - 1) * ticks + 1
        time, command = between(e.time_s, ticks)[:last], between(e.position_command_rad, ticks)[:last]
        # A log's clock and its controller's differ a little; a row is a whole number of ticks all the same.
        exact = abs(self._controller.rate_hz * step_s / ticks - 1.0) < SAME_RATE
        controller = replace(self._controller, rate_hz=ticks / step_s) if exact else self._controller
        stiff = BRISTLE in model.effects or any(all_effects()[name].swings for name in model.effects)
        substep_s = SUBSTEP_S if stiff else RIGID_SUBSTEP_S
        rows = closed_loop(model, controller, time, command, payload=e.payload, state=state, substep_s=substep_s)
        torque = reported(rows.torque_nm, self._report, float(np.median(np.diff(time))))
        return replace(
            rows,
            position_rad=rows.position_rad[::ticks],
            velocity_rad_s=rows.velocity_rad_s[::ticks],
            torque_nm=torque[::ticks],
        )

    def _one(self, model: JointModel, experiment: Experiment, state: CarryOver | None) -> tuple[Replayed, CarryOver]:
        rows = self._rows(model, experiment, state)
        low_pass = LowPass.at(1.0 / experiment.step_s, experiment.band_hz)
        measured = experiment.torque_nm
        torque = np.zeros_like(rows.torque_nm) if measured is None else measured - rows.torque_nm
        held = first_slide(experiment.position_rad, self._slide_rad) + round(SETTLING_S * low_pass.rate_hz)
        return Replayed(
            low_pass(torque),
            LowPass.at(low_pass.rate_hz)(experiment.position_rad - rows.position_rad),
            min(held, experiment.time_s.size // 3),
        ), rows.state


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """The believed joint of one set under its controller."""

    replay: Replay
    validation: bool | None  # role of the logs that a gap is told of, as for ``Replay``
    bare: Mapping[str, Replayed]  # these logs less the believed joint's
    white_nm: float  # RMS that white noise makes of that torque
    steps_nm: float  # RMS that the encoder's steps make of it

    @property
    def noise_nm(self) -> float:
        """RMS that both make of it."""
        return math.hypot(self.white_nm, self.steps_nm)

    def made_nm(self, each: Sequence[Effects]) -> list[float]:
        """RMS of what each of these effects changes of the torque of all logs, N m; infinite where a loop runs away."""
        bare = self.replay({})
        made = []
        with np.errstate(over="ignore", invalid="ignore"):
            for effects in each:
                run = self.replay(effects) if effects else bare
                apart = [(g.torque_nm - run[name].torque_nm)[g.settled :] for name, g in bare.items()]
                made.append(rms(np.concatenate(apart)))
        return [one if math.isfinite(one) else math.inf for one in made]

    def gap_nm(self, effects: Effects) -> float:
        """RMS of the torque gap with effects added, N m; infinite where no controller holds the joint."""
        return self._gap_nm(effects, self.validation)

    def fitted_gap_nm(self, effects: Effects) -> float:
        """The same of the logs that numbers are read from."""
        return self._gap_nm(effects, self._fitted)

    def loudest_gap_nm(self, count: int, beside: Effects) -> Callable[[Effects], float]:
        """The same of as many of those logs as ``count``, the ones in which most is left ``beside`` some effects."""
        runs = self.replay(beside, validation=self._fitted)
        squares = {name: float(np.sum(run.torque_nm[run.settled :] ** 2)) for name, run in runs.items()}
        names = sorted(squares, key=lambda name: -squares[name])[:count]
        return lambda effects: self._gap_nm(effects, self._fitted, names)

    @property
    def _fitted(self) -> bool | None:
        return False if self.replay.identifies else None

    def _gap_nm(self, effects: Effects, validation: bool | None, only: Collection[str] | None = None) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            gap = pooled(self.replay(effects, validation=validation, only=only), "torque_nm")
        return gap if math.isfinite(gap) else math.inf


def pooled(differences: Mapping[str, Replayed], part: str) -> float:
    """RMS of ``torque_nm`` or ``position_rad`` from where each of the given logs has settled: what is compared.

    A log that was cut out of a motion starts with a spring and an integral that nobody knows.
    """
    return rms(np.concatenate([getattr(d, part)[d.settled :] for d in differences.values()]))
