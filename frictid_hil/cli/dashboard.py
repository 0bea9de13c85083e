"""``dashboard``: store and runs in a browser of this computer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.cli.options import JsonOption, QuietOption, StoreOption
from frictid_hil.cli.output import Output, Result


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("dashboard")(dashboard)


def dashboard(
    runs: Annotated[
        Path, typer.Option("--runs", metavar="DIR", file_okay=False, help="Folder under which runs are looked for.")
    ] = Path("runs"),
    store: StoreOption = None,
    port: Annotated[int, typer.Option("--port", min=1, max=65535, help="Port of 127.0.0.1 to listen on.")] = 8642,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Show robots, runs and a run as it moves, in a browser on this computer; it reads only. Runs until Ctrl-C."""
    from frictid_hil.jobs.dashboard import serve
    from frictid_hil.profiles.store import ProfileStore

    output = Output(as_json, quiet)

    def announce(address: str) -> None:
        if as_json:
            typer.echo(f'{{"schema": "frictid.dashboard/1", "outcome": "ok", "address": "{address}"}}')
        else:
            typer.echo(f"dashboard: {address}")

    def run() -> Result:
        serve(runs, ProfileStore(store), port, announce)
        raise typer.Exit(0)

    output.run("dashboard", run)
