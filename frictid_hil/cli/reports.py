"""``report``: the HTML page of a run, or of a robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.cli.options import JsonOption, QuietOption, StoreOption, robots
from frictid_hil.cli.output import READING, Output, Result


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("report")(report)


def report(
    run: Annotated[Path | None, typer.Argument(metavar="[RUN]", help="Run folder.")] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            "--robot",
            "-r",
            metavar="ROBOT",
            autocompletion=robots,
            help="The page of a robot with its history: its name in the store, or its file.",
        ),
    ] = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write the self-contained HTML page of a run, or the index page of a robot."""
    from frictid_hil.jobs.report import report as job

    output = Output(as_json, quiet)

    def show(result: Result) -> None:
        for key in ("report", "recalibration_report"):
            if key in result:
                output.out.print(result[key], soft_wrap=True)

    output.run("report", lambda: job(run, robot=robot, store=store, told=output.counting(READING)), show)
