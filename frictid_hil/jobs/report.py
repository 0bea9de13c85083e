"""``frictid-hil report``: the HTML page of a run, made from what lies in its folder."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from frictid_hil.config.profile import FrictionProfile, load_profile
from frictid_hil.errors import FrictidError, UsageError
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples
from frictid_hil.report.calibration import calibration_page
from frictid_hil.report.pages import write_page
from frictid_hil.runner.run_folder import load_manifest


def report(run: Path) -> dict[str, Any]:
    """Write ``report.html`` into a run folder.

    Raises:
        UsageError: not a run folder, or nothing was identified in it.
    """
    manifest = load_manifest(run)
    if not (run / "profile.yaml").exists():
        raise UsageError(
            "nothing was identified in this run",
            where=str(run),
            next_step="look at manifest.json for how it ended; `frictid-hil identify` reads its samples",
        )
    page = write_run_page(run, load_profile(run / "profile.yaml"), manifest)
    return {"outcome": "ok", "report": str(page.resolve())}


def write_run_page(run: Path, profile: FrictionProfile, manifest: dict[str, Any]) -> Path:
    """The page of a run whose profile and manifest are at hand."""
    samples: dict[str, Samples] = {}
    # A page without loops is better than none; the recording's own defect is told by `identify`.
    with contextlib.suppress(FrictidError):
        samples = {one.joint: one for one in read(run) if one.marks}
    error = manifest.get("error") or {}
    page = calibration_page(
        profile, samples, outcome=str(manifest.get("outcome") or "interrupted"), error=str(error.get("what", ""))
    )
    return write_page(page, run / "report.html")
