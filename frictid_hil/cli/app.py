"""The ``frictid-hil`` command: its verbs, in groups, each group a module that is loaded with its verbs."""

from __future__ import annotations

import logging
import sys
from typing import Any

import typer

from frictid_hil.cli import calibrate, columns, emulate, gap, jobs, new, profiles, reports
from frictid_hil.cli.output import Output
from frictid_hil.cli.terminal import outlive_the_terminal
from frictid_hil.errors import UsageError
from frictid_hil.version import __version__

app = typer.Typer(
    name="frictid-hil",
    help="Identify, compensate and explain the friction of a robot joint on a CAN or serial bus.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for group in (calibrate, reports, jobs, columns):
    app.add_typer(group.app)
app.add_typer(profiles.app, name="profile")
app.add_typer(gap.app, name="gap")
app.add_typer(emulate.app, name="emulate")
app.add_typer(new.app, name="new")

_WRONG_USAGE: Any = typer.BadParameter.__bases__[0]
"""Typer's error for every option that is missing, unknown or wrong; it has no public name."""


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"frictid-hil {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """Identify, compensate and explain the friction of a robot joint on a CAN or serial bus."""


def main() -> None:
    """Entry point of the console script."""
    outlive_the_terminal()
    # Libraries log what we tell better as errors with cause and next step.
    logging.getLogger().addHandler(logging.NullHandler())
    if "--json" not in sys.argv[1:]:
        app(prog_name="frictid-hil")
    try:
        sys.exit(app(prog_name="frictid-hil", standalone_mode=False))
    except _WRONG_USAGE as error:
        words = error.ctx.command_path.split()[1:] if error.ctx else []
        help_of = " ".join(["frictid-hil", *words, "--help"])
        told = UsageError(error.format_message(), next_step=f"`{help_of}`")
        Output(as_json=True).refuse("_".join(words) or "usage", told)


if __name__ == "__main__":
    main()
