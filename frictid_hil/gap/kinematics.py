"""The kinematic channel: what reported velocity and position steps say, by the effects that read them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from frictid_hil.gap.residuals import Recording
from frictid_hil.simulation.drive_form import Believed, MotionView
from frictid_hil.simulation.effects import all_effects


def fit_kinematics(
    recordings: Sequence[Recording], resolution_rad: float | None, velocity_filter_s: float, library: Collection[str]
) -> dict[str, float]:
    """The one parameter of every effect of the library that shows in positions and velocities themselves, by effect."""
    views = [
        MotionView(r.step_s, r.experiment.position_rad, r.experiment.velocity_rad_s, r.experiment.validation)
        for r in recordings
    ]
    believed = Believed(resolution_rad or 0.0, velocity_filter_s)
    forms = {name: form for name in library if (form := all_effects()[name].kinematic) is not None}
    readings = {name: form.read(views, believed) for name, form in forms.items()}
    return {name: finding.value for name, finding in readings.items() if finding is not None and finding.shows}
