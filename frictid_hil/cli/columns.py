"""``columns``: what a log holds, and the column map that reads it."""

from __future__ import annotations

from pathlib import Path

import typer

from frictid_hil.cli.options import argument, option
from frictid_hil.cli.output import Output, Result, takes, verb

app = typer.Typer()


def _show(output: Output, result: Result) -> None:
    for line in result["findings"]:
        output.say(f"- {line}")
    for name, joint in result["joints"].items():
        unit = "m" if joint["prismatic"] else "rad"
        output.say(
            f"joint {name}: {joint['rows']} rows, {joint['duration_s']:.4g} s at {joint['rate_hz']:.4g} Hz, "
            f"travel {joint['travel']:.4g} {unit}; {', '.join(joint['columns'])}"
        )
        for line in [*joint["told"], *joint["doubts"]]:
            output.say(f"  - {line}")
    if result.get("written"):
        output.say(f"column map: {result['written']}")
    elif result["map"]:
        output.say(result["map"])


@verb(app, "columns", _show)
@takes(
    log=argument("LOG", "A log in whatever form: CSV, bag, MCAP, parquet, ..."),
    known=option("--columns", "FILE", "Try this column map instead of drafting one."),
    out=option("--out", "FILE.yaml", "Write the draft to this file."),
)
def columns(
    output: Output,
    log: Path,
    known: str | None = None,
    out: Path | None = None,
    force: bool = False,
) -> Result:
    """Look at a log: what its columns are, in what units, what is odd; drafts the column map for --columns."""
    from frictid_hil.jobs.columns import columns as job

    return job(log, columns=known, out=out, force=force)
