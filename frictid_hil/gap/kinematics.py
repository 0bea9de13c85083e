"""The kinematic channel: what reported velocity and position steps say, by the effects that read them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.gap.residuals import Recording
from frictid_hil.simulation.drive_form import Believed, MotionView
from frictid_hil.simulation.effects import all_effects


@dataclass(frozen=True, slots=True)
class KinematicFit:
    """What the kinematic channel says.

    Attributes:
        read: effect name -> value of its parameter, whether it shows or not.
        found: effect name -> parameters, of those that show.
        step_rad: step of the position; the nominal one where no coarser lattice is seen.
        step_factor: that over the nominal resolution; 1 where it is not coarser.
        held_share: share of moving rows whose position repeats the row before although the step is fine enough to move.
    """

    read: Mapping[str, float]
    found: Mapping[str, Mapping[str, float]]
    step_rad: float
    step_factor: float
    held_share: float


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
    step, factor = believed.resolution_rad, 1.0
    for name, effect in all_effects().items():
        form = effect.kinematic
        finding = form.read(views, believed) if form is not None else None
        if form is None or finding is None:
            continue
        read[name] = finding.value
        if finding.shows and (library is None or name in library):
            found[name] = {form.parameter: finding.value}
        if form.position_step:
            step = finding.value
            factor = step / believed.resolution_rad if finding.shows and believed.resolution_rad > 0.0 else 1.0
    return KinematicFit(read, found, step, factor, held_rows(recordings, step))


def held_rows(recordings: Sequence[Recording], step_rad: float) -> float:
    """Share of rows that repeat a position although both neighbours say the joint moved by several steps."""
    held = moving = 0
    for recording in recordings:
        moved = np.diff(recording.experiment.position_rad)
        if moved.size < 3:
            continue
        fast = (np.abs(moved[:-2]) > 4.0 * step_rad + 1e-6) & (np.sign(moved[:-2]) == np.sign(moved[2:]))
        fast &= np.abs(moved[2:]) > 4.0 * step_rad + 1e-6
        held += int(np.count_nonzero(fast & (moved[1:-1] == 0.0)))
        moving += int(np.count_nonzero(fast))
    return held / moving if moving else 0.0
