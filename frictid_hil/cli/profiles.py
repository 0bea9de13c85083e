"""``profile``: look at friction profiles and manage the store of active ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from frictid_hil.cli.output import JsonOption, Output, QuietOption, Result
from frictid_hil.units import degrees

app = typer.Typer(help="Show, compare and manage friction profiles.", no_args_is_help=True)


@app.command("show")
def show(
    profile: Annotated[Path, typer.Argument(help="Profile, or a run folder that holds one.")],
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Print a profile as a person reads it."""
    from frictid_hil.jobs.profiles import show as job

    output = Output(as_json, quiet)

    def print_profile(result: Result) -> None:
        for name, joint in result["joints"].items():
            linear = bool(joint.get("prismatic"))
            force, speed = ("N", "m/s") if linear else ("N m", "deg/s")
            table = Table(title=f"joint {name}: {joint['method']}, F_0 = {joint['coulomb_nm']['value']:.4g} {force}")
            table.add_column(f"V_n [{speed}]", justify="right")
            table.add_column(f"F_n [{force}]", justify="right")
            table.add_column("95 % interval", justify="right")
            intervals = joint.get("torque_interval_nm") or [None] * len(joint["torque_nm"])
            for velocity, torque, interval in zip(joint["velocity_rad_s"], joint["torque_nm"], intervals, strict=True):
                table.add_row(
                    f"{velocity if linear else degrees(velocity):.4g}",
                    f"{torque:.4g}",
                    f"{interval[0]:.4g} .. {interval[1]:.4g}" if interval else "",
                )
            output.out.print(table)
        provenance = result["provenance"]
        output.out.print(f"{result['robot']}, {provenance['created_utc']}, frictid-hil {provenance['tool_version']}")

    output.run("profile_show", lambda: job(profile), print_profile)
