"""``frictid-hil profile export``: a friction profile in the form of the place where it shall act."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.profile import load_profile, profile_file
from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.friction.curve import FrictionCurve

POINTS = 20
"""Rows of a drive's friction table: ten speeds each way."""


def export(profile: Path, target: str, out: Path, *, force: bool = False) -> dict[str, Any]:
    """Write a profile for another place.

    The target is ``table``, ``ros2`` or ``i2rt``.

    Raises:
        UsageError: no such target, or ``out`` exists.
        ConfigError, IdentificationError: the profile is unusable.

    Returns:
        ``written`` (absolute path), ``lost``, and ``worst_percent``: how far the written form is from the curve within
        its measured range, over the curve, the worst joint.
    """
    if target not in _TARGETS:
        raise UsageError(f"no target {target!r}", where="--to", next_step=f"one of {', '.join(_TARGETS)}")
    refuse_overwriting([out], force=force)
    loaded = load_profile(profile_file(profile))
    pairs = {n: (np.array(one.velocity_rad_s), np.array(one.torque_nm)) for n, one in loaded.joints.items()}
    joints = {name: FrictionCurve.through(*pair, where=f"joint {name}") for name, pair in pairs.items()}
    text, read_back, lost = _TARGETS[target](joints)
    write_whole(out, text)
    worst = max(_off(curve, read_back[name]) for name, curve in joints.items())
    return {"outcome": "ok", "written": str(out.resolve()), "lost": lost, "worst_percent": 100.0 * worst}


Joints = Mapping[str, FrictionCurve]
Torque = Callable[[Any], Any]


def _off(curve: FrictionCurve, written: Torque) -> float:
    speed = np.linspace(*curve.measured_range_rad_s, 200)
    return float(np.max(np.abs(written(speed) - curve.torque(speed)) / curve.torque(speed)))


def _table(joints: Joints) -> tuple[str, dict[str, Torque], str]:
    """Speed and torque in ten rows for each direction, for drives that interpolate between rows."""
    rows = ["joint,velocity_rad_s,torque_nm"]
    back: dict[str, Torque] = {}
    for name, curve in joints.items():
        low, high = curve.measured_range_rad_s
        speed = np.geomspace(low, high, POINTS // 2)
        torque = curve.torque(speed)
        for v, f in zip([*-speed[::-1], *speed], [*-torque[::-1], *torque], strict=True):
            rows.append(f"{name},{v:.6g},{f:.6g}")
        back[name] = partial(np.interp, xp=speed, fp=torque)
    return "\n".join([*rows, ""]), back, "presliding, and the curve below the slowest measured speed"


def _line(curve: FrictionCurve) -> tuple[float, float]:
    """Level and slope nearest to the curve over its measured range, shares of it counted alike."""
    speed = np.linspace(*curve.measured_range_rad_s, 200)
    torque = curve.torque(speed)
    level, slope = np.linalg.lstsq(np.stack([1.0 / torque, speed / torque], axis=1), np.ones_like(speed), rcond=None)[0]
    return float(level), float(slope)


def _ros2(joints: Joints) -> tuple[str, dict[str, Torque], str]:
    """Parameters of a node: level and slope by joint."""
    lines = {name: _line(curve) for name, curve in joints.items()}
    parameters = {
        "joints": list(lines),
        "friction": {
            n: {"coulomb_nm": round(c, 6), "viscous_nm_s_per_rad": round(b, 6)} for n, (c, b) in lines.items()
        },
    }
    return (
        dump({"/**": {"ros__parameters": parameters}}),
        _straight(lines),
        "the curve: a level and a slope are left of it",
    )


def _i2rt(joints: Joints) -> tuple[str, dict[str, Torque], str]:
    """One level by joint, in the order of the arm, times the sign of speed."""
    speeds = {name: np.linspace(*curve.measured_range_rad_s, 200) for name, curve in joints.items()}
    means = {name: (float(np.mean(joints[name].torque(speed))), 0.0) for name, speed in speeds.items()}
    text = dump({"coulomb_friction": [round(level, 6) for level, _ in means.values()]})
    return text, _straight(means), "everything but one level: friction that depends on speed, and presliding"


def _straight(lines: Mapping[str, tuple[float, float]]) -> dict[str, Torque]:
    return {name: np.polynomial.Polynomial(line) for name, line in lines.items()}


_TARGETS: dict[str, Callable[[Joints], tuple[str, dict[str, Torque], str]]] = {
    "table": _table,
    "ros2": _ros2,
    "i2rt": _i2rt,
}
