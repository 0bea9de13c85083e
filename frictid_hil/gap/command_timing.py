"""When the commands of a log took effect, where the controller ran between its rows.

A row says which command was sent, not when it came into force: it may have been held since then, interpolated up to
the next one, or sent a little later. With a stiff loop a millisecond of that is more torque than friction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Controller, Experiment, ExperimentSet, Nominal
from frictid_hil.gap.forward import Replay, why_not
from frictid_hil.gap.residuals import LowPass, demand_of, held, uniform

FASTEST = 1.05  # rows of the log to a control tick, above which it holds what the controller never saw


def between_rows(controller: Controller | None, step_s: float) -> bool:
    """Whether the controller ran between the rows of a log."""
    return controller is not None and controller.rate_hz * step_s > FASTEST


def in_force(experiments: ExperimentSet) -> ExperimentSet:
    """The set with each command at the time when it came into force, up to a row late, as the torques fit best.

    What the believed joint itself shows on a log so slow is no lateness, where it can be simulated.
    """
    nominal = experiments.nominal
    tables = []
    if any(is_guessed(nominal, e) for e in experiments.experiments):
        known = why_not(experiments) is None
        exact = Replay(experiments).recorded() if known else (None,) * len(experiments.experiments)
        pairs = list(zip(experiments.experiments, exact, strict=True))
        fitted = [(e, own) for e, own in pairs if not e.validation] or pairs
        tables = [_table(nominal.controller, e, own) for e, own in fitted if is_guessed(nominal, e)]
    if not tables:
        return experiments
    table = np.concatenate(tables)
    late = float(np.clip(np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0][0], 0.0, 1.0))
    shifted = [_shifted(e, late) for e in experiments.experiments]
    return replace(experiments, experiments=tuple(shifted))


def is_guessed(nominal: Nominal, e: Experiment) -> bool:
    """Whether a log whose demand is replayed lacks ticks of its controller, so that what was asked for is a guess."""
    known = e.torque_nm is not None and e.position_command_rad is not None and e.torque_demand_nm is None
    return known and between_rows(nominal.controller, e.step_s)


def _shifted(e: Experiment, late: float) -> Experiment:
    command = e.position_command_rad
    return e if command is None else replace(e, position_command_rad=(1.0 - late) * command + late * held(command))


def _table(controller: Controller | None, raw: Experiment, exact: Experiment | None) -> Array:
    """What a command one row later and a constant would change, and the torque that is left, (rows, 3)."""
    e, step_s, _ = uniform(raw)
    assert controller is not None and e.torque_nm is not None
    demand = demand_of(controller, e, step_s)
    late = demand_of(controller, _shifted(e, 1.0), step_s) - demand
    left = e.torque_nm - held(demand)
    if exact is not None and exact.torque_nm is not None:
        left -= exact.torque_nm - held(demand_of(controller, exact, step_s))
    columns = np.column_stack([held(np.column_stack([late, np.ones_like(demand)])), left])
    low_pass = LowPass.at(1.0 / step_s)
    rows: Array = low_pass(columns)[5 : -5 : low_pass.stride]
    return rows
