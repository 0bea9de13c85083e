"""What every reading of an experiment set starts from: completed beliefs, recordings, the believed joint simulated."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.gap.cautions import ONE_SINUSOID, one_sinusoid
from frictid_hil.gap.command_timing import in_force, is_guessed
from frictid_hil.gap.experiment_set import ExperimentSet, Nominal
from frictid_hil.gap.forward import Replay, Simulation, why_not
from frictid_hil.gap.kinematics import fit_kinematics
from frictid_hil.gap.position_noise import white_rms
from frictid_hil.gap.presliding import as_it_yields
from frictid_hil.gap.report_filter import as_meant
from frictid_hil.gap.residuals import Recording, recordings, rms
from frictid_hil.gap.sanity import checked, completed, one_sided
from frictid_hil.gap.smoothing import as_smoothed
from frictid_hil.gap.tick_timing import as_it_ticks


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """One experiment set, ready to be read."""

    experiments: ExperimentSet  # what nobody believes is estimated
    logs: Sequence[Recording]
    kinematic: Mapping[str, float]  # what positions and velocities themselves tell, by effect
    simulation: Simulation | None  # of the believed joint; None where there is none
    # That joint recorded as the set was, and the same with its encoder's steps; empty where it is not needed.
    believed: Sequence[Recording]
    stepped: Sequence[Recording]
    reasons: Mapping[str, str]  # what was estimated or cannot be told, by name

    @property
    def nominal(self) -> Nominal:
        """The beliefs."""
        return self.experiments.nominal

    @property
    def smoothed(self) -> bool:
        """Whether its torques were smoothed after they were recorded."""
        return self.logs[0].experiment.smoothed

    @property
    def guessed(self) -> bool:
        """Whether a controller's demand is a guess, as it falls between rows of the log."""
        return is_guessed(self.nominal, self.logs[0].experiment)


def prepared(experiments: ExperimentSet, library: Collection[str]) -> Prepared:
    """The set made ready; ``library`` holds the effects that may be used."""
    experiments, smoothed = as_smoothed(checked(experiments))
    experiments, tick = as_it_ticks(as_meant(experiments))
    experiments, reasons = completed(in_force(experiments))
    experiments, form = as_it_yields(experiments)
    told = {"band": smoothed, "controller": tick, "presliding": form}
    reasons = {**reasons, **{name: why for name, why in told.items() if why is not None}}
    if (open_question := one_sided(experiments)) is not None:
        reasons["motion"] = open_question
    if one_sinusoid(experiments):
        reasons["sinusoid"] = ONE_SINUSOID
    logs = recordings(experiments)
    nominal = experiments.nominal
    kinematic = fit_kinematics(logs, nominal.encoder_resolution_rad, nominal.velocity_filter_s, library)
    simulation = simulated_joint(experiments, logs)
    believed, stepped = believed_joint(experiments, simulation)
    return Prepared(experiments, logs, kinematic, simulation, believed, stepped, reasons)


def simulated_joint(experiments: ExperimentSet, logs: Sequence[Recording]) -> Simulation | None:
    """The believed joint under its controller; None where that cannot be simulated."""
    if why_not(experiments) is not None:
        return None
    replay, role = Replay(experiments), judged_role(logs)
    bare = replay({}, validation=role)
    return Simulation(replay, role, bare, _white_nm(logs), replay.steps_nm(bare, role))


def believed_joint(
    experiments: ExperimentSet, simulation: Simulation | None
) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """The believed joint recorded as the set was: what sampling and filters make of it is no gap.

    The second is with its encoder's steps, where rows are fewer than ticks: they fold the jumps of its torque.
    """
    if simulation is None or any(e.torque_nm is None for e in experiments.experiments):
        return (), ()
    replay = simulation.replay
    smooth = recordings(replace(experiments, experiments=replay.recorded()))
    if not is_guessed(experiments.nominal, experiments.experiments[0]):
        return smooth, ()
    return smooth, recordings(replace(experiments, experiments=replay.recorded(steps=True)))


def judged_role(logs: Sequence[Recording]) -> bool | None:
    """Which logs a gap is told of: the validation logs, all where there are none."""
    return True if any(r.experiment.validation for r in logs) else None


def _white_nm(logs: Sequence[Recording]) -> float:
    """RMS that white noise of the reported torque leaves behind the low-pass, on the logs a gap is told of, N m."""
    role = judged_role(logs)
    judged = [r for r in logs if role is None or r.experiment.validation]
    gain = logs[0].low_pass.white_gain
    return gain * rms(np.array([white_rms(t) for r in judged if (t := r.experiment.torque_nm) is not None] or [0.0]))
