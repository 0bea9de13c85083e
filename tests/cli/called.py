"""The command line, called in this very process: what it prints, and the code it would leave with.

It is the entry point of the installed command, without the second and a half that a new process takes to import numpy
and scipy. That the command itself starts is seen by the tests that run it.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

from frictid_hil.cli.app import main

PROGRAM = str(Path(sys.executable).parent / "frictid-hil")


def run(*arguments: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """``frictid-hil ARGUMENTS`` in a folder, with nothing to read on its standard input."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        patch.object(sys, "argv", ["frictid-hil", *arguments]),
        patch.dict(os.environ, environment),
        patch.object(sys, "stdin", io.StringIO()),
        contextlib.chdir(cwd or Path.cwd()),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    return subprocess.CompletedProcess(["frictid-hil", *arguments], code, out.getvalue(), err.getvalue())
