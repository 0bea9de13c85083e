"""When the commands of a log took effect, where the controller ran between its rows.

A row says which command was sent, not when it came into force: it may have been held since then, interpolated up to
the next one, or sent a little later. With a stiff loop a millisecond of that is more torque than friction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import GAINS, Controller, Experiment, ExperimentSet, Nominal, with_gains
from frictid_hil.gap.forward import Replay, why_not
from frictid_hil.gap.residuals import LowPass, demand_of, demand_parts, held, uniform

ROUNDS = 3  # times that errors of the gains are fitted: a limited demand, or that of a cascade, is not linear in them
PLAUSIBLE = (-0.9, 4.0)  # errors of a gain that are sought
HALVED = 0.5  # torque that other gains leave over what the stated ones do, above which they are none
ALIKE = 0.03  # part of what a late command makes that other gains do not, below which the two are alike
FASTEST = 1.05  # rows of the log to a control tick, above which it holds what the controller never saw


def between_rows(controller: Controller | None, step_s: float) -> bool:
    """Whether the controller ran between the rows of a log."""
    return controller is not None and controller.rate_hz * step_s > FASTEST


def in_force(experiments: ExperimentSet) -> ExperimentSet:
    """The set with each command at the time when it came into force, up to a row late, as the torques fit best.

    What the believed joint itself shows on a log so slow is no lateness, where it can be simulated.
    """
    nominal = experiments.nominal
    if not any(is_guessed(nominal, e) for e in experiments.experiments):
        return experiments
    known = why_not(experiments) is None
    exact = Replay(experiments).recorded() if known else (None,) * len(experiments.experiments)
    pairs = list(zip(experiments.experiments, exact, strict=True))
    fitted = [(e, own) for e, own in pairs if not e.validation] or pairs
    logs = [(e, own) for e, own in fitted if is_guessed(nominal, e)]
    if not logs or nominal.controller is None:
        return experiments
    late = _lateness(nominal.controller, logs)
    shifted = [_shifted(e, late) for e in experiments.experiments]
    return replace(experiments, experiments=tuple(shifted))


def is_guessed(nominal: Nominal, e: Experiment) -> bool:
    """Whether a log whose demand is replayed lacks ticks of its controller, so that what was asked for is a guess."""
    known = e.torque_nm is not None and e.position_command_rad is not None and e.torque_demand_nm is None
    return known and between_rows(nominal.controller, e.step_s)


def _shifted(e: Experiment, late: float) -> Experiment:
    command = e.position_command_rad
    return e if command is None else replace(e, position_command_rad=(1.0 - late) * command + late * held(command))


def _lateness(controller: Controller, logs: Sequence[tuple[Experiment, Experiment | None]]) -> float:
    """Rows by which commands came into force later than they were sent, as the torques fit best; from 0 to 1.

    Wrong gains would pass for lateness: others are taken where they leave much less. On a joint that trails its command
    a gain and a delay are alike, and the stated gains stand.
    """
    table = _tables(controller, controller, logs)
    numbers, stated = _fitted(table[:, len(GAINS) :])
    late = numbers[0]
    shares = np.zeros(len(GAINS))
    for _ in range(ROUNDS):
        if np.any(shares):
            table = _tables(with_gains(controller, shares.tolist()), controller, logs)
        numbers, left = _fitted(table)
        if left <= HALVED**2 * stated and _apart(table) > ALIKE:
            late = numbers[len(GAINS)]
        shares = np.clip((1.0 + shares) * (1.0 + numbers[: len(GAINS)]) - 1.0, *PLAUSIBLE)
    return float(np.clip(late, 0.0, 1.0))


def _apart(table: Array) -> float:
    """Part of the late command's column that gains and a constant do not make, over the column."""
    late = len(GAINS)
    _, left = _fitted(np.column_stack([np.delete(table[:, :-1], late, axis=1), table[:, late]]))
    return math.sqrt(left / max(float(table[:, late] @ table[:, late]), 1e-300))


def _fitted(table: Array) -> tuple[Array, float]:
    """(Coefficients of all columns that explain the last one best, the sum of squares that stays)."""
    numbers = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0]
    return numbers, float(np.sum((table[:, -1] - table[:, :-1] @ numbers) ** 2))


def _tables(there: Controller, stated: Controller, logs: Sequence[tuple[Experiment, Experiment | None]]) -> Array:
    return np.concatenate([_table(there, stated, e, exact) for e, exact in logs])


def _table(there: Controller, stated: Controller, raw: Experiment, exact: Experiment | None) -> Array:
    """What other gains, a command one row later and a constant would change, and the torque that is left, (rows, 6).

    ``there`` has the gains about which others are tried, ``exact`` is the believed joint under the ``stated`` ones.
    """
    e, step_s, _ = uniform(raw)
    assert e.torque_nm is not None
    demand = demand_of(there, e, step_s)
    late = demand_of(there, _shifted(e, 1.0), step_s) - demand
    left = e.torque_nm - held(demand)
    if exact is not None and exact.torque_nm is not None:
        left -= exact.torque_nm - held(demand_of(stated, exact, step_s))
    gains = demand_parts(there, e, step_s, [0.0] * len(GAINS))
    columns = np.column_stack([held(np.column_stack([gains, late, np.ones_like(demand)])), left])
    low_pass = LowPass.at(1.0 / step_s, e.band_hz)
    return np.asarray(low_pass(columns)[5 : -5 : low_pass.stride])
