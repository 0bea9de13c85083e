"""The kinematic channel: what reported velocity and position steps say, by the effects that read them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from frictid_hil.gap.residuals import Recording
from frictid_hil.simulation.drive_form import Believed, MotionView
from frictid_hil.simulation.effects import all_effects


@dataclass(frozen=True, slots=True)
class KinematicFit:
    """What the kinematic channel says."""

    read: Mapping[str, float]  # effect name -> value of its parameter, whether it shows or not
    found: Mapping[str, Mapping[str, float]]  # effect name -> parameters, of those that show


def fit_kinematics(
    recordings: Sequence[Recording],
    resolution_rad: float | None,
    velocity_filter_s: float,
    library: Collection[str] | None = None,
) -> KinematicFit:
    """Read every effect that has a kinematic form; those outside the library are read but never found."""
    views = [
        MotionView(r.step_s, r.experiment.position_rad, r.experiment.velocity_rad_s, r.experiment.validation)
        for r in recordings
    ]
    believed = Believed(resolution_rad or 0.0, velocity_filter_s)
    read: dict[str, float] = {}
    found: dict[str, dict[str, float]] = {}
    for name, effect in all_effects().items():
        form = effect.kinematic
        finding = form.read(views, believed) if form is not None else None
        if form is None or finding is None:
            continue
        read[name] = finding.value
        if finding.shows and (library is None or name in library):
            found[name] = {form.parameter: finding.value}
    return KinematicFit(read, found)
