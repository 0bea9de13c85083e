"""The declared low-pass of a drive's reported torque, as the drive's maker meant it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.residuals import LowPass, recordings, reported


def as_meant(experiments: ExperimentSet) -> ExperimentSet:
    """The set with the filter that its torques fit best: some give the time constant of each lag, some of the whole."""
    told = experiments.nominal.torque_report_filter
    if told is None or told.order == 1:
        return experiments
    meant = (told, told.model_copy(update={"order": 1}))
    left = [0.0, 0.0]
    for log in recordings(experiments):
        if log.view is None or log.plant_nm is None:
            continue
        view, step_s = log.view, log.step_s
        asked = view.torque_nm - log.plant_nm
        model = np.stack([asked, view.acceleration_rad_s2, view.slip, np.ones_like(asked)], axis=1)
        low_pass = LowPass.at(1.0 / step_s)
        for k, form in enumerate(meant):
            table = low_pass(np.concatenate([reported(model, form, step_s), view.torque_nm[:, None]], axis=1))
            weights = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0]
            left[k] += float(np.sum((table[:, -1] - table[:, :-1] @ weights) ** 2))
    nominal = replace(experiments.nominal, torque_report_filter=meant[int(np.argmin(left))])
    return replace(experiments, nominal=nominal)
