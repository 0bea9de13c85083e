"""A stated low-pass of the reported torque: of two lags, or one of the time that was stated."""

from __future__ import annotations

from dataclasses import replace

import gap_sets
import pytest

from frictid_hil.config.nominal import ReportFilter
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.report_filter import as_meant
from frictid_hil.gap.residuals import reported

STATED = ReportFilter(order=2, time_constant_s=0.003)


def _reported_through(drive: ReportFilter, encoder_rad: float, *, controller: bool) -> ExperimentSet:
    nominal = replace(gap_sets.NOMINAL, encoder_resolution_rad=encoder_rad)
    made = gap_sets.make({"torque_bias": {"bias_nm": 0.2}}, nominal, only=("sines_small", "chirp", "sines_repeat"))
    told = replace(nominal, torque_report_filter=STATED, controller=nominal.controller if controller else None)
    filtered = []
    for e in made.experiments:
        assert e.torque_nm is not None
        filtered.append(replace(e, torque_nm=reported(e.torque_nm, drive, gap_sets.STEP_S)))
    return replace(made, nominal=told, experiments=tuple(filtered))


@pytest.mark.parametrize(("encoder_rad", "controller"), [(2e-6, True), (2e-6, False), (3e-3, True)])
def test_the_stated_filter_stands_whatever_an_encoders_steps_say(encoder_rad: float, controller: bool) -> None:
    """Torque that an encoder's steps make along the motion took one lag for two, and left a lag of the drive."""
    found = as_meant(_reported_through(STATED, encoder_rad, controller=controller))
    assert found.nominal.torque_report_filter == STATED


@pytest.mark.parametrize("encoder_rad", [2e-6, 3e-3])
def test_who_states_the_time_of_the_whole_is_understood(encoder_rad: float) -> None:
    one_lag = STATED.model_copy(update={"order": 1})
    assert as_meant(_reported_through(one_lag, encoder_rad, controller=True)).nominal.torque_report_filter == one_lag
