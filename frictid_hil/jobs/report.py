"""``frictid-hil report``: makes the HTML page of a run from its folder, or the page of a robot."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from frictid_hil.config.profile import FrictionProfile, JointProfile, load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError, UsageError
from frictid_hil.jobs.profiles import unknown_robot
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples
from frictid_hil.report.calibration import calibration_page
from frictid_hil.report.index import index_page
from frictid_hil.report.pages import Page, write_page
from frictid_hil.runs.folder import load_manifest

NIGHT_PAGE = "recalibration.html"  # in the run folder of a recalibration


def report(
    run: Path | None = None,
    *,
    robot: str | None = None,
    store: Path | None = None,
    told: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Write ``report.html`` into a run folder, or the index page of a robot, named by file or as the store knows it.

    ``UsageError``: not one of both; no run, or nothing identified in it; nothing known of the robot.
    """
    if (run is None) == (robot is None):
        raise UsageError("name one: the folder of a run, or a robot with --robot")
    if robot is not None:
        named = load_robot(robot).name if Path(robot).suffix in (".yaml", ".yml") else robot
        page = write_index_page(ProfileStore(store, told), named)
        return {"outcome": "ok", "report": str(page.resolve())}
    assert run is not None  # by the check above
    manifest = load_manifest(run)
    if (run / "profile.yaml").exists():
        page = write_run_page(run, whole_profile(run), manifest)
    elif not (page := run / "report.html").exists():
        raise UsageError(
            "nothing was identified in this run",
            where=str(run),
            next_step="look at manifest.json for how it ended; `frictid-hil identify` reads its samples",
        )
    result = {"outcome": "ok", "report": str(page.resolve())}
    if (run / NIGHT_PAGE).exists():
        result["recalibration_report"] = str((run / NIGHT_PAGE).resolve())
    return result


def whole_profile(run: Path) -> FrictionProfile:
    """The profile of a run with all that was kept of each joint: also what Function A gave, and why gates passed."""
    profile = load_profile(run / "profile.yaml")
    joints = dict(profile.joints)
    for name in joints:
        if (path := run / "joints" / f"{name}.json").exists():
            joints[name] = JointProfile.model_validate(json.loads(path.read_text())["profile"])
    return profile.model_copy(update={"joints": joints})


def write_run_page(run: Path, profile: FrictionProfile, manifest: dict[str, Any]) -> Path:
    """The page of a run whose profile and manifest are at hand."""
    samples: dict[str, Samples] = {}
    # A page without loops is better than none; the recording's own defect is told by `identify`.
    with contextlib.suppress(FrictidError):
        samples = {one.joint: one for one in read(run) if one.marks}
    previous = None
    # What was in force when the run ended, where it is still at hand.
    with contextlib.suppress(FrictidError):
        previous = load_profile(manifest["active_profile"]) if manifest.get("active_profile") else None
    outcome, error = str(manifest.get("outcome") or "interrupted"), manifest.get("error") or {}
    page = calibration_page(profile, samples, outcome=outcome, error=str(error.get("what", "")), previous=previous)
    return write_page(page, run / "report.html")


def write_index_page(store: ProfileStore, robot: str) -> Path:
    """The index page of a robot, in its folder of the store (``UsageError``: nothing is known of such a robot)."""
    path = store.root / robot / "index.html"
    folder = path.parent.resolve()
    page = page_of(store, robot, lambda run: Path(os.path.relpath(run / NIGHT_PAGE, folder)).as_posix())
    return write_page(page, path)


def page_of(store: ProfileStore, robot: str, address: Callable[[Path], str]) -> Page:
    """The index page of a robot; ``address`` is of a night's page, or "" (``UsageError``: nothing is known of it)."""
    trends, nights = store.trends(robot), store.attempts(robot)
    if not trends and not nights:
        raise unknown_robot(store, robot)
    with_page = {
        one.utc: Path(one.run).resolve() for one in nights if one.run and (Path(one.run) / NIGHT_PAGE).exists()
    }
    addresses = {utc: found for utc, run in with_page.items() if (found := address(run))}
    active, baseline = store.active(robot), store.baseline(robot)
    return index_page(robot, trends, store.promotions(robot), nights, active, baseline, addresses)
