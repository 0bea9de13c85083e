"""A drive along a recording: what torque it makes of its controller's demand, with effects between the two."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Nominal
from frictid_hil.gap.residuals import Recording, demand_of, held, ticks_of
from frictid_hil.simulation.drive_form import ActuationForm
from frictid_hil.simulation.effects import all_effects


def forms() -> dict[str, ActuationForm]:
    """Every effect's form in this channel, in the order in which they act."""
    found = {name: effect.actuation for name, effect in all_effects().items() if effect.actuation is not None}
    return dict(sorted(found.items(), key=lambda item: item[1].order))


def with_one(
    believed: Mapping[str, Mapping[str, float]], name: str, form: ActuationForm, value: float, detail: float
) -> dict[str, Mapping[str, float]]:
    """The effects of a believed drive and one more; a time is beyond what it is believed to be late by."""
    held_by = believed.get(name, {}).get(form.parameter, 0.0) if form.late else 0.0
    values = {form.parameter: held_by + value}
    if form.detail:
        values[form.detail] = detail
    return {**believed, name: values}


def through(demand_nm: Array, effects: Mapping[str, Mapping[str, float]], step_s: float, limit_nm: float) -> Array:
    """Torque reported for a demand in force from each sample on: the mean over the step before, shape (n,)."""
    torque = held(demand_nm)
    for name, form in forms().items():
        if name not in effects or form.torque is None:
            continue
        values = effects[name]
        if values[form.parameter] != all_effects()[name].off[form.parameter]:
            detail = (values.get(form.detail, form.details[0]),) if form.detail else ()
            torque = form.torque(torque, values[form.parameter], step_s, limit_nm, *detail)
    return torque


@dataclass(frozen=True, slots=True)
class DriveReplay:
    """What a drive is asked for in one recording, at every tick of its controller."""

    recording: Recording  # its rows
    demand_nm: Array  # at every tick, shape (n * ticks,)
    ticks: int  # of the controller to a row
    limit_nm: float  # of the torque

    @staticmethod
    def of(recording: Recording, nominal: Nominal, *, as_reported: bool = False) -> DriveReplay:
        """The drive of one recording; its controller may see the reported velocity instead of the believed one."""
        controller, e = nominal.controller, recording.experiment
        assert recording.demand_nm is not None
        limit_nm = math.inf if controller is None else controller.torque_limit_nm
        if controller is None or e.torque_demand_nm is not None:
            return DriveReplay(recording, recording.demand_nm, 1, limit_nm)
        seen = e.velocity_rad_s if as_reported else None
        demand = demand_of(controller, e, recording.step_s, velocity_rad_s=seen, every_tick=True)
        return DriveReplay(recording, demand, ticks_of(controller, recording.step_s), limit_nm)

    def torque(self, effects: Mapping[str, Mapping[str, float]]) -> Array:
        """Torque that the drive makes with these effects, at every row, N m, shape (n,)."""
        return through(self.demand_nm, effects, self.recording.step_s / self.ticks, self.limit_nm)[:: self.ticks]
