"""What a file rarely says of a controller's tick, as its torques tell where a log has every tick.

A drive takes the difference of its last two positions for the velocity, which is half a tick old, and reports the
torque that was asked for a tick ago. A simulator often uses the velocity of the moment, and logs what it asks for now.
With a stiff loop half a tick is more torque than friction. Both are earlier than a drive can be, so that no delay, lag
or filter passes for them.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.command_timing import is_guessed
from frictid_hil.gap.experiment_set import GAINS, Controller, Experiment, ExperimentSet, Nominal
from frictid_hil.gap.residuals import LowPass, demand_of, demand_parts, held, recordings, reported, uniform

CLEARLY = 0.5
"""Squares that remain with another timing over those with the usual one, at most. Of 227 joints that were drawn with
the usual one and log every tick none came below 0.99; a loop whose law is another one than stated did, at 0.56."""
NOW = "the controller uses the velocity of the moment"
OWN = "a row holds the torque that was asked for in its own tick, not in the one before"


def as_it_ticks(experiments: ExperimentSet) -> tuple[ExperimentSet, str | None]:
    """(the set with the timing that its torques fit clearly best beside its gains, what to tell of it).

    A row holds the torque of its own tick only if the joint's motion says so, too.
    """
    nominal, controller = experiments.nominal, experiments.nominal.controller
    known = [e for e in experiments.experiments if e.torque_nm is not None and e.position_command_rad is not None]
    logs = [e for e in known if not e.validation] or known
    if controller is None or not logs or any(e.torque_demand_nm is not None or is_guessed(nominal, e) for e in known):
        return experiments, None
    velocities = (controller.velocity, "now") if controller.velocity is None else (controller.velocity,)
    owns = (False, True) if _moves_so(experiments) else (False,)
    ways = list(itertools.product(velocities, owns))
    made = {velocity: replace(controller, velocity=velocity) for velocity in velocities}
    left = {way: sum(_left(nominal, made[way[0]], e, own=way[1]) for e in logs) for way in ways}
    best = min(ways, key=lambda way: left[way])
    if left[best] >= CLEARLY * left[ways[0]]:
        return experiments, None
    velocity, own = best
    told = [words for words, applies in ((NOW, velocity != controller.velocity), (OWN, own)) if applies]
    nominal = replace(nominal, controller=made[velocity])
    return replace(_of_own_ticks(experiments) if own else experiments, nominal=nominal), "; ".join(told)


def _of_own_ticks(experiments: ExperimentSet) -> ExperimentSet:
    """Rows that hold the torque of their own tick, as if each held that of the tick before."""
    return replace(experiments, experiments=tuple(_of_own_tick(e) for e in experiments.experiments))


def _of_own_tick(e: Experiment) -> Experiment:
    return e if e.torque_nm is None else replace(e, torque_nm=held(e.torque_nm))


def _moves_so(experiments: ExperimentSet) -> bool:
    """Whether the believed joint moves as if its rows held the torque of their own tick."""
    return _along(_of_own_ticks(experiments)) < _along(experiments)


def _along(experiments: ExperimentSet) -> float:
    """Squares that the believed joint leaves of the torque along the motion, whatever its size, inertia and level."""
    left = 0.0
    for r in recordings(experiments):
        if r.view is not None and r.plant_nm is not None:
            believed = r.view.torque_nm - r.plant_nm
            columns = np.stack([believed, r.view.acceleration_rad_s2, r.view.slip], axis=1)
            asked = reported(columns, experiments.nominal.torque_report_filter, r.step_s)
            left += _squares(asked, r.view.torque_nm, r.low_pass)
    return left


def _left(nominal: Nominal, controller: Controller, raw: Experiment, *, own: bool) -> float:
    """Squares that a controller leaves of a log's torques, whatever its gains and its level."""
    e, step_s, _ = uniform(_of_own_tick(raw) if own else raw)
    assert e.torque_nm is not None
    gains = demand_parts(controller, e, step_s, [0.0] * len(GAINS))
    columns = np.column_stack([gains, demand_of(controller, e, step_s)])
    asked = reported(held(columns), nominal.torque_report_filter, step_s)
    return _squares(asked, e.torque_nm, LowPass.at(1.0 / step_s, e.band_hz))


def _squares(columns: Array, torque_nm: Array, low_pass: LowPass) -> float:
    """Of a torque, behind the low-pass, less what the columns and a constant make of it."""
    table = low_pass(np.column_stack([columns, np.ones_like(torque_nm), torque_nm]))[5 : -5 : low_pass.stride]
    numbers = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0]
    return float(np.sum((table[:, -1] - table[:, :-1] @ numbers) ** 2))
