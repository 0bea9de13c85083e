"""The declared low-pass of a drive's reported torque, as the drive's maker meant it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictid_hil.config.nominal import ReportFilter
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.presliding import CLEARLY
from frictid_hil.gap.residuals import Recording, held, recordings, reported


def as_meant(experiments: ExperimentSet) -> ExperimentSet:
    """The set with the filter that its torques fit best: some give the time constant of each lag, some of the whole.

    Where a controller is known, its demand tells; an encoder's steps drown what the motion says of so short a time. The
    stated filter stands unless the other one leaves clearly less.
    """
    told = experiments.nominal.torque_report_filter
    if told is None or told.order == 1:
        return experiments
    logs = [r for r in recordings(experiments) if r.view is not None and r.plant_nm is not None]
    asked = [r for r in logs if r.demand_nm is not None] or logs
    other = told.model_copy(update={"order": 1})
    stated, changed = (sum(_left(r, form) for r in asked) for form in (told, other))
    if changed >= CLEARLY * stated:
        return experiments
    return replace(experiments, nominal=replace(experiments.nominal, torque_report_filter=other))


def _left(recording: Recording, form: ReportFilter) -> float:
    """Squares that the demand, or the believed joint's own torques, leave of the reported torque behind a filter."""
    view, plant, step_s = recording.view, recording.plant_nm, recording.step_s
    assert view is not None and plant is not None
    believed = view.torque_nm - plant
    columns = [believed, view.acceleration_rad_s2, view.slip]
    measured = view.torque_nm
    if recording.demand_nm is not None and recording.experiment.torque_nm is not None:
        columns, measured = [held(recording.demand_nm)], recording.experiment.torque_nm
    model = np.stack([*columns, np.ones_like(measured)], axis=1)
    table = recording.low_pass(np.concatenate([reported(model, form, step_s), measured[:, None]], axis=1))
    weights = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0]
    return float(np.sum((table[:, -1] - table[:, :-1] @ weights) ** 2))
