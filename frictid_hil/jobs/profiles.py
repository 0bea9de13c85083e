"""The verbs of ``frictid-hil profile``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from frictid_hil.config.profile import load_profile


def show(path: Path) -> dict[str, Any]:
    """A profile's values, checked."""
    place = path / "profile.yaml" if path.is_dir() else path
    profile = load_profile(place)
    return {
        "outcome": "ok",
        "profile": str(place.resolve()),
        "robot": profile.robot,
        "joints": {name: joint.model_dump(mode="json") for name, joint in profile.joints.items()},
        "provenance": profile.provenance.model_dump(mode="json"),
    }
