"""Where a profile comes from: everything that a later reader needs to trust it, or to find out why not."""

from __future__ import annotations

import hashlib
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import Field

from frictid_hil.config.schema import Strict
from frictid_hil.version import __version__


class Provenance(Strict):
    """Of one profile."""

    created_utc: str = Field(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ$")  # ``2026-11-21T05:15:00Z``
    tool_version: str = ""  # of frictid-hil; "" in a profile that was not written by it
    git_revision: str = ""  # of the checkout it ran from; "" from an installed wheel
    robot_file: str = ""  # name of the robot file
    config_sha256: str = ""  # ``Robot.digest``
    driver: str = ""  # name
    bus: str = ""  # ``interface:channel``; "" where a recording was identified
    settings: dict[str, Any] = Field(default_factory=dict)  # of driver and bus (bitrate, cycle rate, time-outs, ...)
    realtime: bool = False  # wall clock
    seed: int | None = None  # of simulated noise; None on real hardware
    run: str = ""  # the run folder, or the recordings
    log_sha256: dict[str, str] = Field(default_factory=dict)  # of each recording, by file name
    temperatures_c: dict[str, float] = Field(default_factory=dict)  # by name of the place measured
    command: str = ""  # the command line
    notes: list[str] = Field(default_factory=list)  # anything else worth a line

    @classmethod
    def now(cls, **facts: Any) -> Provenance:
        """Of a profile that this program writes at this moment."""
        return cls(created_utc=utc_now(), tool_version=__version__, git_revision=git_revision(), **facts)


def utc_now() -> str:
    """Now, as provenance writes it."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def git_revision() -> str:
    """Revision of the checkout this program runs from, with ``+`` where files differ from it; "" outside a checkout."""
    checkout = Path(__file__).parents[2]
    if not (checkout / ".git").exists():
        return ""
    try:
        answer = subprocess.run(
            ["git", "-C", str(checkout), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return answer.stdout.strip()


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
