"""What the inverse form of an effect of drive or encoder is: how it shows between demand, motion and their reports.

Such an effect stands between the controller's demand and the reported torque (``ActuationForm``), in the reported
position and velocity themselves (``KinematicForm``), or both; where nothing but command and position is recorded,
effects form a chain from one to the other (``TrackingForm``). The diagnosis knows none of them by name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from frictid_hil.friction.trajectory import Array


@dataclass(frozen=True, slots=True)
class DriveView:
    """One recording as the drive saw it; arrays have shape (n,)."""

    step_s: float  # sampling step
    limit_nm: float  # torque limit that the controller knows of; infinite where it has none
    demand_nm: Array  # the controller's replayed demand, in force from each sample on
    torque_nm: Array  # reported
    # Change of the demand per share of kp, ki and kd, (n, 3); empty where no law is known.
    parts_nm: Array = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, slots=True)
class DemandForm:
    """Columns that an effect adds to the demand itself, before the drive makes torque of it."""

    parameters: tuple[str, ...]  # the effect's parameters, one for each column, each its coefficient
    # Recordings -> per recording the columns (n, k), N m per unit of coefficient.
    regressors: Callable[[Sequence[DriveView]], list[Array]]


@dataclass(frozen=True, slots=True)
class ActuationForm:
    """What an effect makes of the torque, or of the velocity that the controller sees."""

    parameter: str  # the effect's parameter that is fitted
    # (recordings, value found in the kinematic channel or None) -> values to try, rising; the best one is refined
    # between its neighbours; a single one is taken as it is, none at all says that it cannot show.
    guesses: Callable[[Sequence[DriveView], float | None], Array]
    # (torque it is given (n,), value, step_s, limit_nm and, where there is one, detail) -> torque it lets through
    # (n,); None where it acts on the controller's velocity instead, its value being the time constant of a further
    # first-order lag there.
    torque: Callable[..., Array] | None
    order: int = 50  # forms of a chain act by rising order
    late: bool = False  # its value is a time by which the torque comes late
    # A further parameter, ``torque``'s fifth argument, that shapes the effect; empty where there is none.
    detail: str = ""
    details: tuple[float, ...] = ()  # values of it to try, the plainest first; it stays where no other predicts better
    # Ticks of the controller by which it may be later than the reported torque tells; the closed loop decides it.
    unreported_ticks: float = 0.0
    # Key in the ``drive`` section of nominal.yaml that already states it; empty where there is none.
    believed_as: str = ""


@dataclass(frozen=True, slots=True)
class MotionView:
    """One recording as the encoder gave it; arrays have shape (n,)."""

    step_s: float  # sampling step
    position_rad: Array  # reported
    velocity_rad_s: Array | None  # reported; None where it is not
    validation: bool  # judged on, not fitted


@dataclass(frozen=True, slots=True)
class Believed:
    """What the nominal joint says of its encoder: step of the position, 0 where unknown; filter of the velocity."""

    resolution_rad: float
    velocity_filter_s: float


@dataclass(frozen=True, slots=True)
class Finding:
    """What a kinematic form reads from recordings."""

    value: float  # of its parameter
    shows: bool  # it is beyond what the nominal joint believes


@dataclass(frozen=True, slots=True)
class KinematicForm:
    """How an effect is read from positions and velocities alone."""

    parameter: str  # the effect's parameter that is read
    # (recordings, belief) -> the finding; None where the recordings lack what it takes.
    read: Callable[[Sequence[MotionView], Believed], Finding | None]
    # Its value is the step of the reported position, which makes noise wherever position is differentiated or a stiff
    # spring is driven by it.
    position_step: bool = False
    # The effect's parameter that tells how far the controller acts on what is reported; the closed loop decides it.
    in_loop: str = ""


@dataclass(frozen=True, slots=True)
class Link:
    """One number of the chain."""

    name: str  # with its unit, as reported
    position: Callable[[Array, float, float], Array]  # (what comes in (n,), value, step_s) -> what goes on (n,)
    start: float  # size from which it is sought
    upper: float  # largest value
    lower: float = 0.0  # smallest value
    neutral: float = 0.0  # value that changes nothing
    of_travel: bool = False  # start and upper are shares of the longest travel


@dataclass(frozen=True, slots=True)
class TrackingForm:
    """An effect in the chain."""

    links: tuple[Link, ...]  # its numbers, fitted together
    order: int  # effects act, and are sought, by rising order; the links of those before are fitted again beside it
    # Confidence in it where it pays on logs not fitted; position alone tells some effects better.
    certainty: float = 0.6
    looks_like: tuple[str, ...] = ()  # effects that position alone cannot tell from it
    # Effects that it may imitate on few motions; it is then named beside them, never by itself.
    mimics: tuple[str, ...] = ()


LATEST_S = 0.05  # longest time by which a torque comes late


def guesses_by_sample(views: Sequence[DriveView], seen: float | None) -> Array:
    """Times to try for what comes late: parts of a sample, then up to eight of them, none above ``LATEST_S``."""
    times = np.concatenate([[0.125, 0.25], np.arange(0.5, 8.1, 0.5)]) * views[0].step_s
    guesses: Array = times[times <= LATEST_S]
    return guesses
