"""Manufacturer objects worth recording: the drive's own friction compensation, feed-forward and filters.

A drive that compensates friction by itself falsifies every curve identified through it, and a filter on its torque
shifts the curve (see the time skew in docs). Where an object is known it is read and kept in the profile; a vendor's
table is data, and adding one is all it takes to support another drive.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from frictid_drivers.cia402.access import Drive
from frictid_drivers.cia402.objects import IntegerType, Object
from frictid_hil.protocol.driver import Timing


class Effect(Enum):
    """What a setting does to an identification."""

    FRICTION_COMPENSATION = "friction compensation"  # must be off: it hides what is to be measured
    FEED_FORWARD = "feed-forward"  # recorded; harmless to the measured torque
    VELOCITY_FILTER_US = "velocity filter, us"  # delays the reported velocity
    TORQUE_FILTER_US = "torque filter, us"  # delays the reported torque


@dataclass(frozen=True, slots=True)
class Setting:
    """One manufacturer object."""

    object: Object
    effect: Effect


def _setting(index: int, sub: int, kind: str, name: str, effect: Effect) -> Setting:
    return Setting(Object(index, sub, IntegerType.parse(kind), name), effect)


KNOWN_SETTINGS: dict[tuple[int, int], tuple[Setting, ...]] = {
    # The servo of the virtual robot.
    (0x00000000, 0x46524943): (
        _setting(0x2020, 1, "u16", "friction compensation, Coulomb", Effect.FRICTION_COMPENSATION),
        _setting(0x2020, 2, "u16", "friction compensation, viscous", Effect.FRICTION_COMPENSATION),
        _setting(0x2021, 1, "u16", "velocity feed-forward, percent", Effect.FEED_FORWARD),
        _setting(0x2021, 2, "u32", "inertia feed-forward, 1e-6 kg m2", Effect.FEED_FORWARD),
        _setting(0x2022, 1, "u32", "velocity low-pass, us", Effect.VELOCITY_FILTER_US),
        _setting(0x2022, 2, "u32", "torque low-pass, us", Effect.TORQUE_FILTER_US),
    ),
}
"""By vendor id and product code (1018:01, 1018:02)."""


def read_settings(drive: Drive, vendor: int, product: int) -> dict[Setting, int]:
    """Values of all known settings that this drive has; empty for an unknown vendor."""
    known = KNOWN_SETTINGS.get((vendor, product), ())
    return {setting: value for setting in known if (value := drive.find(setting.object)) is not None}


def timing_of(settings: dict[Setting, int], cycle_s: float) -> Timing | None:
    """When reported figures were true, where the drive's filters are known; None where they are not."""
    velocity_s, torque_s = (
        [value * 1e-6 for setting, value in settings.items() if setting.effect is effect]
        for effect in (Effect.VELOCITY_FILTER_US, Effect.TORQUE_FILTER_US)
    )
    if not velocity_s and not torque_s:
        return None
    return Timing(
        position_delay_s=0.0,
        velocity_delay_s=sum(velocity_s, 0.0),
        # Applied during the cycle before SYNC; a first-order low-pass delays by its time constant.
        torque_delay_s=cycle_s / 2 + sum(torque_s, 0.0),
        torque_lag_s=sum(torque_s, 0.0),
        uncertainty_s=0.0002,
        source="drive",
    )
