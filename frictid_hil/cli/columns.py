"""``columns``: what a log holds, and the column map that reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.cli.options import ForceOption, JsonOption, QuietOption
from frictid_hil.cli.output import Output, Result


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("columns")(columns)


def columns(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log in whatever form: CSV, bag, MCAP, parquet, ...")],
    known: Annotated[
        str | None, typer.Option("--columns", metavar="FILE", help="Try this column map instead of drafting one.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.yaml", help="Write the draft to this file.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Look at a log: what its columns are, in what units, what is odd; drafts the column map for --columns."""
    from frictid_hil.jobs.columns import columns as job

    output = Output(as_json, quiet)

    def show(result: Result) -> None:
        for line in result["findings"]:
            output.out.print(f"- {line}", soft_wrap=True)
        for name, joint in result["joints"].items():
            unit = "m" if joint["prismatic"] else "rad"
            output.out.print(
                f"joint {name}: {joint['rows']} rows, {joint['duration_s']:.4g} s at {joint['rate_hz']:.4g} Hz, "
                f"travel {joint['travel']:.4g} {unit}; {', '.join(joint['columns'])}",
                soft_wrap=True,
            )
            for line in [*joint["told"], *joint["doubts"]]:
                output.out.print(f"  - {line}", soft_wrap=True)
        if result["map"] and not result.get("written"):
            output.out.print(result["map"], soft_wrap=True)
        if result.get("written"):
            output.out.print(f"column map: {result['written']}", soft_wrap=True)

    output.run("columns", lambda: job(log, columns=known, out=out, force=force), show)
