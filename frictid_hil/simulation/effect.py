"""What a physical effect is: a name, parameters with units and bounds, where it shows, and two forms of one formula.

The **forward** form is a set of hooks: plain scalar functions that the joint's kernel calls at named places (*stages*)
of ``plant.py``. A hook names what it needs in its own signature: parameters of its effect, ``state`` and ``at`` (the
flat state vector and the effect's first slot in it), or any quantity the stage knows (``velocity_rad_s``, ``step_s``).
The **inverse** forms tell the diagnosis how it shows in a recording: as columns of the torque balance (``inverse``),
as columns of the controller's demand (``demand``), between demand and reported torque (``actuation``), in reported
position and velocity (``kinematic``), between command and position where there is nothing else (``tracking``). Nothing
outside an effect's file lists it.

An effect that is an error of a believed number names it (``belief``): inside the tolerance of that number it is a
nuisance, beyond it a cause.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import ActuationForm, DemandForm, KinematicForm, TrackingForm
from frictid_hil.simulation.inverse import InverseForm


class Channel(Enum):
    """Which residual of a recording an effect can show in."""

    KINEMATIC = "K"  # reported velocity against differenced position, the position steps themselves
    ACTUATION = "A"  # reported torque against the controller's demand
    PLANT = "P"  # reported torque against the joint's equation of motion


class Region(Enum):
    """Where in a recording an effect shows."""

    VELOCITY_BAND = "velocity band"
    POSITION = "position"
    REVERSAL = "reversal"
    STANDSTILL = "standstill"
    ACCELERATION = "acceleration"
    LOAD = "load"
    TEMPERATURE = "time and temperature"
    FREQUENCY = "frequency"
    ACTUATION = "actuation"
    KINEMATICS = "kinematics"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect."""

    # With its unit as suffix; ``_share`` is a fraction of the joint's Coulomb level unless described otherwise.
    name: str
    lower: float  # bound of what a file may say and a fit may find
    upper: float
    typical: float  # a size met on real joints; the default of a parameter that a file leaves out
    description: str  # what it is
    off: float | None = None  # the value that makes the whole effect vanish, or None where the parameter only shapes it
    # A replay of the closed loop can refine it; false where it is read elsewhere, or leaves no clear trace.
    replayed: bool = True


@dataclass(frozen=True, slots=True)
class Signature:
    """Where an effect shows."""

    channels: tuple[Channel, ...]  # residuals it appears in, the clearest first
    regions: tuple[Region, ...]  # parts of a recording it appears in, the clearest first


@dataclass(frozen=True, slots=True)
class Illustration:
    """Data of one small plot; each curve is (label, x, y)."""

    x_label: str  # with unit
    y_label: str  # with unit
    curves: tuple[tuple[str, Array, Array], ...]  # equal-length arrays of shape (k,) each

    @staticmethod
    def over(x_label: str, x: Array, y_label: str, curves: Mapping[str, Callable[[Array], Array]]) -> Illustration:
        """Curves over one x, each the function of it that stands by its label."""
        return Illustration(x_label, y_label, tuple((label, x, curve(x)) for label, curve in curves.items()))

    @staticmethod
    def lagging_step(time_constant_s: float, y_label: str, true: str, lagging: str) -> Illustration:
        """A step and its first-order lag, under the names given."""
        constant = max(time_constant_s, 1e-5)
        curves: dict[str, Callable[[Array], Array]] = {
            true: lambda t: np.where(t >= 0.0, 1.0, 0.0),
            lagging: lambda t: np.where(t >= 0.0, 1.0 - np.exp(-np.maximum(t, 0.0) / constant), 0.0),
        }
        return Illustration.over("time (s)", np.linspace(-1.0, 5.0, 601) * constant, y_label, curves)


@dataclass(frozen=True, slots=True)
class Hook:
    """One function at one stage of the kernel."""

    stage: str  # name of the stage in ``plant.py``
    # Scalars in, the transformed scalar out (nothing for stages that only update ``state``).
    function: Callable[..., Any]
    order: int = 50  # hooks of a stage run by rising order


@dataclass(frozen=True, slots=True)
class Parting:
    """The experiment in which an effect behaves differently from one that looks like it."""

    rival: str  # name of the other effect; either one's file may tell
    experiment: str  # to record
    why: str  # what happens in it, one line
    duration_s: float  # of its motion


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect; see the module's first page."""

    name: str  # as in robot files and diagnoses; the name of its file
    summary: str  # one line
    documentation: str  # a paragraph: formula, when it appears, source
    parameters: tuple[Parameter, ...]  # in the order of its files
    signature: Signature  # where it shows
    hooks: tuple[Hook, ...]  # the forward form
    illustrate: Callable[[Mapping[str, float]], Illustration]  # a plot of the effect at given parameters, all of them
    inverse: InverseForm | None = None  # how it shows in the plant; None for effects of drive and encoder
    actuation: ActuationForm | None = None  # how it shows between demand and reported torque, where it does
    kinematic: KinematicForm | None = None  # how it shows in reported position and velocity, where it does
    demand: DemandForm | None = None  # how it shows in the controller's own demand, where it does
    # The number of a nominal joint that it is an error of, as ``tolerance:`` names it; empty for others.
    belief: str = ""
    # A rigid link, a factor of the torque or a constant gives its form; others are near theirs to a tenth.
    exact: bool = False
    # What it makes of a command on its way to the position, where that alone may tell of it.
    tracking: TrackingForm | None = None
    parted: tuple[Parting, ...] = ()  # what tells it from effects that look like it
    state_size: int = 0  # number of slots in the state vector
    carried: bool = False  # its state survives from one recording to the next (temperature)

    @property
    def typical(self) -> dict[str, float]:
        """Parameters of a typical size."""
        return {parameter.name: parameter.typical for parameter in self.parameters}

    @property
    def off(self) -> dict[str, float]:
        """Parameters at which the effect vanishes; shapes keep their typical value."""
        return {p.name: p.typical if p.off is None else p.off for p in self.parameters}

    @property
    def strengths(self) -> tuple[Parameter, ...]:
        """The parameters whose ``off`` value makes the effect vanish."""
        return tuple(parameter for parameter in self.parameters if parameter.off is not None)

    @property
    def swings(self) -> bool:
        """Whether it lets the link swing by itself."""
        return self.inverse is not None and self.inverse.swings

    @property
    def is_line(self) -> bool:
        """Whether it looks for lines over position in the recordings themselves."""
        looks = self.inverse is not None and self.inverse.shapes_for is not None
        return looks and Region.POSITION in self.signature.regions

    def complete(self, given: Mapping[str, float]) -> dict[str, float]:
        """All parameters: the given ones, typical values for shapes left out, off for strengths left out."""
        return {**self.off, **given}
