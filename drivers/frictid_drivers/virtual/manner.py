"""What sets a family of drives apart from the standard servo, beyond its table of objects."""

from __future__ import annotations

from dataclasses import dataclass

from frictid_drivers.virtual.objects import Key


@dataclass(frozen=True, slots=True)
class Manner:
    """One family.

    Attributes:
        absent: objects that it does not have.
        no_object: the abort code by which it says so.
        transmission_types: those that its PDOs take; empty for all.
        position_units_per_rad: at the joint; None where 608Fh, 6091h and 6092h say it.
        velocity_unit_rad_s: at the joint; None where 60A9h says it.
        mode_change_s: from 6060h to 6061h.
        power_on_s: from "switched on" to "enabled".
    """

    absent: frozenset[Key] = frozenset()
    no_object: int = 0x06020000
    transmission_types: tuple[int, ...] = ()
    position_units_per_rad: float | None = None
    velocity_unit_rad_s: float | None = None
    mode_change_s: float = 0.0
    power_on_s: float = 0.0


STANDARD = Manner()
