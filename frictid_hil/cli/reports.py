"""``report``: the HTML page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.cli.options import JsonOption, QuietOption
from frictid_hil.cli.output import Output


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("report")(report)


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write the self-contained HTML page of a run."""
    from frictid_hil.jobs.report import report as job

    output = Output(as_json, quiet)
    output.run("report", lambda: job(run), lambda result: output.out.print(result["report"], soft_wrap=True))
