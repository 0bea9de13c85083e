"""Ranges by model, from manuals and the makers' own code; where they disagree, the comment says so.

A Damiao tells its own ranges, and they win over this table. The others cannot: a wrong model here gives a plausible,
wrong torque, so the robot file must name the model that is written on the motor.
"""

from __future__ import annotations

from dataclasses import dataclass

from frictid_drivers.mit.frames import Ranges

_FOUR_PI = 12.57  # the RobStride manuals' "4 pi" as the maker's code has it


@dataclass(frozen=True, slots=True)
class Model:
    """One motor of a catalogue."""

    maker: str  # ``damiao``, ``robstride`` or ``cubemars``
    ranges: Ranges  # of its frames


def _damiao(velocity: float, torque: float) -> Model:
    return Model("damiao", Ranges(12.5, velocity, torque))


def _robstride(velocity: float, torque: float, *, strong: bool = False, position: float = _FOUR_PI) -> Model:
    gains = (5000.0, 100.0) if strong else (500.0, 5.0)
    return Model("robstride", Ranges(position, velocity, torque, *gains))


def _cubemars(velocity: float, torque: float) -> Model:
    return Model("cubemars", Ranges(12.5, velocity, torque))


MODELS = {
    "DM-J4310": _damiao(30.0, 10.0),  # the 48 V kind: 50 rad/s in three codes, 30 in one
    "DM-J4340": _damiao(8.0, 28.0),  # 10 rad/s in openarm_can
    "DM-J6006": _damiao(45.0, 20.0),
    "DM-J8006": _damiao(45.0, 40.0),
    "DM-J8009": _damiao(45.0, 54.0),
    "DM-J10010": _damiao(20.0, 200.0),
    "RS00": _robstride(33.0, 14.0),
    "RS01": _robstride(44.0, 17.0),
    "RS02": _robstride(44.0, 17.0),
    "RS03": _robstride(20.0, 60.0, strong=True),
    "RS04": _robstride(15.0, 120.0, strong=True),
    "RS05": _robstride(50.0, 5.5),
    "RS06": _robstride(50.0, 36.0, strong=True),
    "EL05": _robstride(50.0, 6.0),  # 5.5 N m in the maker's code
    "CyberGear": _robstride(30.0, 12.0, position=12.5),
    "AK10-9": _cubemars(50.0, 65.0),
    "AK60-6": _cubemars(50.0, 15.0),
    "AK70-10": _cubemars(50.0, 25.0),
    "AK80-6": _cubemars(76.0, 12.0),
    "AK80-9": _cubemars(50.0, 18.0),  # one code: 15.5 rad/s and 45 N m
    "AK80-64": _cubemars(8.0, 144.0),
}
