"""Errors of a controller's gains as the torques fit best: the point about which all else between them is linear."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.command_timing import PLAUSIBLE, ROUNDS
from frictid_hil.gap.drive_replay import DriveReplay, forms, with_one
from frictid_hil.gap.experiment_set import GAINS, Nominal, with_gains
from frictid_hil.gap.residuals import LEAST_SHARE, Recording, reported
from frictid_hil.simulation.drive_form import DriveView


def gain_errors(
    nominal: Nominal,  # the believed joint
    logs: Sequence[Recording],  # with torque and demand
    shown: Sequence[Array],  # of each log's torque, what the believed joint recorded alike shows beside its own demand
    library: Collection[str],  # effects that may be used
    *,
    lags: bool,  # the reported velocity does, and the controller may act on it
) -> Array:
    """Errors of kp, ki and kd as shares, (3,), as the torques fit best beside any one effect of the drive.

    A drive is late with what wrong gains ask for, and a limit cuts it: neither is found by itself where both are large.
    All 0 where no law is known.
    """
    shares: Array = np.zeros(len(GAINS))
    controller = nominal.controller
    if controller is None or any(r.experiment.torque_demand_nm is not None for r in logs):
        return shares
    pairs = list(zip(logs, shown, strict=True))
    fitted = [(r, own) for r, own in pairs if not r.experiment.validation] or pairs
    ways = list(itertools.product(_drives(nominal, logs, library), (False, True) if lags else (False,)))
    for _ in range(ROUNDS):
        steps = np.concatenate([np.zeros((1, len(GAINS))), LEAST_SHARE * np.eye(len(GAINS))])
        near = [replace(nominal, controller=with_gains(controller, (shares + step).tolist())) for step in steps]
        asked = {
            seen: [([DriveReplay.of(r, one, as_reported=seen) for one in near], own) for r, own in fitted]
            for seen in {seen for _, seen in ways}
        }
        tried = [(*_fitted(asked[seen], effects, nominal), (effects, seen)) for effects, seen in ways]
        numbers, _, best = min(tried, key=lambda one: one[1])
        shares, ways = np.clip(shares + numbers, *PLAUSIBLE), [best]
    return shares


def _drives(
    nominal: Nominal, logs: Sequence[Recording], library: Collection[str]
) -> list[Mapping[str, Mapping[str, float]]]:
    """Effects of the believed drive, and those with one more, at every value worth trying."""
    believed, limit_nm = nominal.believed_effects, DriveReplay.of(logs[0], nominal).limit_nm
    views = [DriveView(r.step_s, limit_nm, r.demand_nm, _torque(r)) for r in logs if r.demand_nm is not None]
    drives: list[Mapping[str, Mapping[str, float]]] = [believed]
    for name, form in forms().items():
        if form.torque is not None and name in library:
            guesses = itertools.product(form.guesses(views, None), form.details or (0.0,))
            drives += [with_one(believed, name, form, float(value), detail) for value, detail in guesses]
    return drives


def _fitted(
    asked: Sequence[tuple[Sequence[DriveReplay], Array]], effects: Mapping[str, Mapping[str, float]], nominal: Nominal
) -> tuple[Array, float]:
    """(Changes of the gains that bring drives with these effects nearest, the sum of squares that stays).

    ``asked`` holds of each log the drive as it is and with each gain larger by ``LEAST_SHARE``, and what is no gap.
    """
    tables = []
    for drives, own in asked:
        r = drives[0].recording
        made = [reported(d.torque(effects), nominal.torque_report_filter, r.step_s) for d in drives]
        columns = np.stack([*((m - made[0]) / LEAST_SHARE for m in made[1:]), _torque(r) - made[0] - own], axis=1)
        tables.append(columns - np.mean(columns, axis=0))
    table = np.concatenate(tables)
    gram = table.T @ table
    numbers: Array = np.linalg.lstsq(gram[:-1, :-1], gram[:-1, -1], rcond=None)[0]
    return numbers, float(np.sum((table[:, -1] - table[:, :-1] @ numbers) ** 2))


def _torque(recording: Recording) -> Array:
    assert recording.experiment.torque_nm is not None
    return recording.experiment.torque_nm
