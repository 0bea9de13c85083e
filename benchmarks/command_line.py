"""The product's command line, called as a user calls it, answering in JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any


def call(*arguments: str) -> dict[str, Any]:
    """One call of the command line, its JSON; what it said instead ends the benchmark."""
    command = [sys.executable, "-m", "frictid_hil.cli.app", *arguments, "--json", "--yes"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not done.stdout.strip():
        raise SystemExit(done.stderr)
    result: dict[str, Any] = json.loads(done.stdout)
    return result
