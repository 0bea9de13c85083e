"""The verbs of ``frictid-hil profile``: show, export, compare, decide which one is in force, and its history."""

from __future__ import annotations

import getpass
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.profile import FrictionProfile, JointProfile, load_profile, profile_file
from frictid_hil.config.write import dump
from frictid_hil.errors import GateFailed, ProfileMismatch, UsageError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.linear_axis import linear_names
from frictid_hil.profiles.drift import differences, drift
from frictid_hil.profiles.records import Promotion
from frictid_hil.profiles.store import ProfileStore


def show(path: Path) -> dict[str, Any]:
    """A profile's values, checked."""
    place = profile_file(path)
    profile = load_profile(place)
    return {
        "outcome": "ok",
        "profile": str(place.resolve()),
        "robot": profile.robot,
        "joints": {name: _by_axis(joint, joint.model_dump(mode="json")) for name, joint in profile.joints.items()},
        "provenance": profile.provenance.model_dump(mode="json"),
    }


def _by_axis(joint: JointProfile, values: dict[str, Any]) -> dict[str, Any]:
    """Values under the names of their kind of axis."""
    return linear_names(values) if joint.prismatic else values


def diff(older: str, newer: str, *, robot: str | None = None, store: Path | None = None) -> dict[str, Any]:
    """How two profiles, named as for ``named_profile``, differ by joint (``ProfileMismatch``: no joint in common)."""
    (before, before_name), (after, after_name) = (named_profile(text, robot, store) for text in (older, newer))
    joints = {name: _by_axis(after.joints[name], asdict(one)) for name, one in drift(before, after).items()}
    if not joints:
        raise ProfileMismatch(
            f"no joint in common: {', '.join(before.joints)} and {', '.join(after.joints)}", where=str(after_name)
        )
    return {
        "outcome": "ok",
        "older": str(before_name),
        "newer": str(after_name),
        "warnings": differences(before, after),
        "joints": joints,
        "only_in_older": [name for name in before.joints if name not in after.joints],
        "only_in_newer": [name for name in after.joints if name not in before.joints],
    }


def promote(
    named: str,
    *,
    robot: str | None = None,
    store: Path | None = None,
    reason: str = "",
    baseline: bool = False,
    force: bool = False,
    told: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Make a profile the active one; joints that it lacks stay as the active profile has them.

    With ``baseline`` drift is measured from it, too. ``GateFailed``: a gate failed, without ``force``. ``UsageError``:
    none.
    """
    profile, place = named_profile(named, robot, store)
    failed = {joint: [gate.name for gate in one.gates if not gate.passed] for joint, one in profile.joints.items()}
    bad = [f"joint {joint}: {', '.join(gates)}" for joint, gates in failed.items() if gates]
    if bad and not force:
        raise GateFailed(
            f"quality gates failed: {'; '.join(bad)}",
            where=str(place),
            next_step="measure again; or promote with --force, knowing why",
        )
    kept = ProfileStore(store, told)
    before = kept.active(profile.robot)
    active = kept.active_profile(profile.robot)
    whole = profile if active is None else profile.completed_by(active)
    identity = kept.add(whole)
    promotion = kept.promote(profile.robot, identity, by=_person(), reason=reason)
    if baseline:
        kept.pin_baseline(profile.robot, identity, by=_person(), reason=reason)
    return {
        **_in_force(kept, profile.robot, promotion.id, before),
        "joints_kept": [name for name in whole.joints if name not in profile.joints],
        "baseline": kept.baseline(profile.robot),
    }


def rollback(robot: str, *, store: Path | None = None, reason: str = "") -> dict[str, Any]:
    """Make the profile active again that was so before the present one (``UsageError``: there is none before)."""
    kept = ProfileStore(store)
    before = kept.active(robot)
    line = kept.rollback(robot, by=_person(), reason=reason)
    return _in_force(kept, robot, line.id, before)


def _in_force(kept: ProfileStore, robot: str, identity: str, before: Promotion | None) -> dict[str, Any]:
    return {
        "outcome": "ok",
        "robot": robot,
        "active": str(kept.path(robot, identity).resolve()),
        "id": identity,
        "before": before.id if before else None,
    }


_JOINT = ("temperature_c", "distance_percent", "gates_failed")
_PROMOTION = ("action", "id", "utc", "by", "reason")
_NIGHT = ("utc", "outcome", "promoted", "drifted", "reason", "next_step", "run")
"""What is told of each, by its own names."""


def history(store: ProfileStore, robot: str, *, last: int | None = None) -> dict[str, Any]:
    """Profiles, promotions and recalibrations, the ``last`` so many, oldest first (``UsageError``: nothing known)."""
    profiles, promotions = store.history(robot, last), store.promotions(robot, last)
    nights = store.attempts(robot, last)
    if not profiles and not nights:
        raise unknown_robot(store, robot)
    active, baseline = store.active(robot), store.baseline(robot)
    return {
        "outcome": "ok",
        "robot": robot,
        "active": active.id if active else None,
        "baseline": baseline,
        "profiles_kept": store.count(robot),
        "profiles": [
            {
                "id": stored.id,
                "created_utc": stored.created_utc,
                "active": active is not None and stored.id == active.id,
                "joints": {
                    name: {"coulomb_n" if joint.prismatic else "coulomb_nm": joint.coulomb_nm}
                    | {key: getattr(joint, key) for key in _JOINT}
                    for name, joint in stored.joints.items()
                },
            }
            for stored in profiles
        ],
        "promotions": [{key: getattr(one, key) for key in _PROMOTION} for one in promotions],
        "recalibrations": [{key: getattr(one, key) for key in _NIGHT} for one in nights],
    }


def unknown_robot(store: ProfileStore, robot: str) -> UsageError:
    """The error where the store knows nothing of a robot."""
    robots = ", ".join(store.robots()) or "none"
    return UsageError(
        f"the store knows no robot named {robot!r}; it has {robots}",
        where=str(store.root),
        next_step="promote a profile with `frictid-hil profile promote RUN`",
    )


def named_profile(text: str, robot: str | None, store: Path | None) -> tuple[FrictionProfile, Path]:
    """The profile that a person names, and its file (``UsageError``: no such profile; nothing is active yet)."""
    path = Path(text)
    # A file or run folder takes precedence over an id of the store, ``active`` or ``baseline``.
    if robot is None or path.exists() or path.suffix:
        place = profile_file(path)
        return load_profile(place), place.resolve()
    kept = ProfileStore(store)
    identity: str | None = text
    if text in ("active", "baseline"):
        active = kept.active(robot)
        identity = kept.baseline(robot) if text == "baseline" else active.id if active else None
    if identity is None:
        raise UsageError(
            f"no profile of {robot} is active yet",
            where=str(kept.root),
            next_step="`frictid-hil calibrate`, then `frictid-hil profile promote RUN`; or name a profile",
        )
    return kept.load(robot, identity), kept.path(robot, identity).resolve()


def _person() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"


POINTS = 20  # rows of a drive's friction table: ten speeds each way


def export(profile: Path, target: str, out: Path, *, force: bool = False) -> dict[str, Any]:
    """Write a profile for another place: ``table``, ``ros2`` or ``i2rt``.

    ``worst_percent`` is how far that is from the curve within its measured range, over the curve, at the worst joint.
    ``UsageError``: no such target, or ``out`` exists. ``ConfigError``, ``IdentificationError``: an unusable profile.
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
