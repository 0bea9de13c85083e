"""A robot's history: its profiles, promotions and recalibrations, as values and as its index page."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from frictid_hil.errors import UsageError
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.report.index import index_page
from frictid_hil.report.pages import Page, write_page

NIGHT_PAGE = "recalibration.html"
"""In the run folder of a recalibration."""


_JOINT = ("temperature_c", "distance_percent", "gates_failed")
_PROMOTION = ("action", "id", "utc", "by", "reason")
_NIGHT = ("utc", "outcome", "promoted", "drifted", "reason", "next_step", "run")
"""What is told of each, by its own names."""


def history(store: ProfileStore, robot: str, *, last: int | None = None) -> dict[str, Any]:
    """Profiles, promotions and recalibrations of a robot, oldest first.

    With ``last``, only so many of each.

    Raises:
        UsageError: nothing is known of such a robot.
    """
    profiles, promotions = store.history(robot, last), store.promotions(robot, last)
    nights = store.attempts(robot, last)
    if not profiles and not nights:
        raise _unknown(store, robot)
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


def write_index_page(store: ProfileStore, robot: str) -> Path:
    """The index page of a robot, in its folder of the store.

    Raises:
        UsageError: nothing is known of such a robot.
    """
    path = store.root / robot / "index.html"
    folder = path.parent.resolve()
    page = page_of(store, robot, lambda run: Path(os.path.relpath(run / NIGHT_PAGE, folder)).as_posix())
    return write_page(page, path)


def page_of(store: ProfileStore, robot: str, address: Callable[[Path], str]) -> Page:
    """The index page of a robot.

    ``address`` is of the page of a night, by its run folder; "" where it cannot be reached.

    Raises:
        UsageError: nothing is known of such a robot.
    """
    trends, nights = store.trends(robot), store.attempts(robot)
    if not trends and not nights:
        raise _unknown(store, robot)
    with_page = {
        one.utc: Path(one.run).resolve() for one in nights if one.run and (Path(one.run) / NIGHT_PAGE).exists()
    }
    addresses = {utc: found for utc, run in with_page.items() if (found := address(run))}
    active, baseline = store.active(robot), store.baseline(robot)
    return index_page(robot, trends, store.promotions(robot), nights, active, baseline, addresses)


def _unknown(store: ProfileStore, robot: str) -> UsageError:
    robots = ", ".join(store.robots()) or "none"
    return UsageError(
        f"the store knows no robot named {robot!r}; it has {robots}",
        where=str(store.root),
        next_step="promote a profile with `frictid-hil profile promote RUN`",
    )
