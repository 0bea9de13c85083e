"""What the inverse form of an effect of drive or encoder is: how it shows between demand, motion and their reports.

Such an effect is no torque of the joint's balance. It stands between the controller's demand and the reported torque
(``ActuationForm``), or in the reported position and velocity themselves (``KinematicForm``), or both. The diagnosis
composes whatever forms there are and knows none of them by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from frictid_hil.friction.trajectory import Array


@dataclass(frozen=True, slots=True)
class DriveView:
    """One recording as the drive saw it; arrays have shape (n,).

    Attributes:
        step_s: sampling step.
        limit_nm: torque limit that the controller knows of; infinite where it has none.
        demand_nm: the controller's replayed demand, in force from each sample on.
        torque_nm: reported.
        parts_nm: proportional, integral and derivative part of the demand, (n, 3); empty where no law is known.
    """

    step_s: float
    limit_nm: float
    demand_nm: Array
    torque_nm: Array
    parts_nm: Array = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, slots=True)
class DemandForm:
    """Columns that an effect adds to the demand itself, before the drive makes torque of it.

    Attributes:
        parameters: the effect's parameters, one for each column, each its coefficient.
        regressors: recordings -> per recording the columns (n, k), N m per unit of coefficient.
    """

    parameters: tuple[str, ...]
    regressors: Callable[[Sequence[DriveView]], list[Array]]


@dataclass(frozen=True, slots=True)
class ActuationForm:
    """What an effect makes of the torque, or of the velocity that the controller sees.

    Attributes:
        parameter: the effect's parameter that is fitted.
        guesses: (recordings, value found in the kinematic channel or None) -> values to try, rising; the best one is
            refined between its neighbours; a single one is taken as it is, none at all says that it cannot show.
        torque: (torque it is given (n,), value, step_s, limit_nm and, where there is one, detail) -> torque it lets
            through (n,); None where it acts on the controller's velocity instead, its value being the time constant of
            a further first-order lag there.
        order: forms of a chain act by rising order.
        late: its value is a time by which the torque comes late.
        detail: a further parameter, ``torque``'s fifth argument, that shapes the effect; empty where there is none.
        details: values of it to try, the plainest first; it stays where no other predicts better.
        believed_as: key in the ``drive`` section of nominal.yaml that already states it; empty where there is none.
    """

    parameter: str
    guesses: Callable[[Sequence[DriveView], float | None], Array]
    torque: Callable[..., Array] | None
    order: int = 50
    late: bool = False
    detail: str = ""
    details: tuple[float, ...] = ()
    believed_as: str = ""


@dataclass(frozen=True, slots=True)
class MotionView:
    """One recording as the encoder gave it; arrays have shape (n,).

    Attributes:
        step_s: sampling step.
        position_rad: reported.
        velocity_rad_s: reported; None where it is not.
        validation: judged on, not fitted.
    """

    step_s: float
    position_rad: Array
    velocity_rad_s: Array | None
    validation: bool


@dataclass(frozen=True, slots=True)
class Believed:
    """What the nominal joint says of its encoder: step of the position, 0 where unknown; filter of the velocity."""

    resolution_rad: float
    velocity_filter_s: float


@dataclass(frozen=True, slots=True)
class Finding:
    """What a kinematic form reads from recordings.

    Attributes:
        value: of its parameter.
        shows: it is beyond what the nominal joint believes.
    """

    value: float
    shows: bool


@dataclass(frozen=True, slots=True)
class KinematicForm:
    """How an effect is read from positions and velocities alone.

    Attributes:
        parameter: the effect's parameter that is read.
        read: (recordings, belief) -> the finding; None where the recordings lack what it takes.
        position_step: its value is the step of the reported position, which makes noise wherever position is
            differentiated or a stiff spring is driven by it.
    """

    parameter: str
    read: Callable[[Sequence[MotionView], Believed], Finding | None]
    position_step: bool = False


LATEST_S = 0.05
"""Longest time by which a torque comes late."""


def guesses_by_sample(views: Sequence[DriveView], seen: float | None) -> Array:
    """Times to try for what comes late: parts of a sample, then up to eight of them, none above ``LATEST_S``."""
    times = np.concatenate([[0.125, 0.25], np.arange(0.5, 8.1, 0.5)]) * views[0].step_s
    guesses: Array = times[times <= LATEST_S]
    return guesses
