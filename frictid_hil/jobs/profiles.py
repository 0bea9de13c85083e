"""The verbs of ``frictid-hil profile``: look at one, compare two, decide which is in force, see how it came to be."""

from __future__ import annotations

import getpass
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from frictid_hil.config.profile import FrictionProfile, load_profile, profile_file
from frictid_hil.errors import GateFailed, ProfileMismatch
from frictid_hil.profiles.drift import drift
from frictid_hil.profiles.store import ProfileStore


def show(path: Path) -> dict[str, Any]:
    """A profile's values, checked."""
    place = profile_file(path)
    profile = load_profile(place)
    return {
        "outcome": "ok",
        "profile": str(place.resolve()),
        "robot": profile.robot,
        "joints": {name: joint.model_dump(mode="json") for name, joint in profile.joints.items()},
        "provenance": profile.provenance.model_dump(mode="json"),
    }


def diff(older: str, newer: str, *, robot: str | None = None, store: Path | None = None) -> dict[str, Any]:
    """How two profiles differ, joint by joint.

    Args:
        older: a file, a run folder, or (with ``robot``) an id of the store, ``active`` or ``baseline``.
        newer: the same.
        robot: whose store is meant by ids.
        store: folder of the store.

    Raises:
        ProfileMismatch: no joint in common.
        UsageError: no such profile.
    """
    (before, before_name), (after, after_name) = (_named(text, robot, store) for text in (older, newer))
    joints = {name: asdict(one) for name, one in drift(before, after).items()}
    if not joints:
        raise ProfileMismatch(
            f"no joint in common: {', '.join(before.joints)} and {', '.join(after.joints)}", where=after_name
        )
    return {
        "outcome": "ok",
        "older": before_name,
        "newer": after_name,
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
    """Make a profile the active one.

    Args:
        named: a file or run folder, which is added to the store; or (with ``robot``) an id of the store.
        robot: whose store is meant by an id.
        store: folder of the store.
        reason: for the history.
        baseline: drift is measured from it from now on, too.
        force: also with failed quality gates.
        told: as ``ProfileStore``'s.

    Raises:
        GateFailed: a quality gate failed.
        UsageError: no such profile.
    """
    profile, name = _named(named, robot, store)
    bad = {
        joint: [gate.name for gate in one.gates if not gate.passed]
        for joint, one in profile.joints.items()
        if any(not gate.passed for gate in one.gates)
    }
    if bad and not force:
        failed = "; ".join(f"joint {joint}: {', '.join(gates)}" for joint, gates in bad.items())
        raise GateFailed(
            f"quality gates failed: {failed}",
            where=name,
            next_step="measure again; or promote with --force, knowing why",
        )
    kept = ProfileStore(store, told)
    identity = kept.add(profile)
    before = kept.active(profile.robot)
    promotion = kept.promote(profile.robot, identity, by=_person(), reason=reason)
    if baseline:
        kept.pin_baseline(profile.robot, identity, by=_person(), reason=reason)
    return {
        "outcome": "ok",
        "robot": profile.robot,
        "active": str(kept.path(profile.robot, promotion.id).resolve()),
        "id": promotion.id,
        "before": before.id if before else None,
        "baseline": kept.baseline(profile.robot),
    }


def rollback(robot: str, *, store: Path | None = None, reason: str = "") -> dict[str, Any]:
    """Make the profile active again that was so before the present one.

    Raises:
        UsageError: there is none before.
    """
    kept = ProfileStore(store)
    before = kept.active(robot)
    line = kept.rollback(robot, by=_person(), reason=reason)
    return {
        "outcome": "ok",
        "robot": robot,
        "active": str(kept.path(robot, line.id).resolve()),
        "id": line.id,
        "before": before.id if before else None,
    }


def _named(text: str, robot: str | None, store: Path | None) -> tuple[FrictionProfile, str]:
    """The profile a person means, and where it is; a file goes before an id of the store."""
    path = Path(text)
    if robot is None or path.exists():
        place = profile_file(path)
        return load_profile(place), str(place.resolve())
    kept = ProfileStore(store)
    active, baseline = kept.active(robot), kept.baseline(robot)
    special = {"active": active.id if active else None, "baseline": baseline}
    identity = special.get(text) or text
    return kept.load(robot, identity), str(kept.path(robot, identity).resolve())


def _person() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"
