"""``recalibrate`` and ``schedule``: what happens when nobody is there."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import option
from frictid_hil.cli.output import Output, Result, folding, takes, verb
from frictid_hil.units import format_figure

app = typer.Typer()


def _show_night(output: Output, result: Result) -> None:
    headings = ("joint", "outcome", "from reference", "from active", "F_0", "temperature")
    table = folding(*headings, whole=("joint", "F_0"), title=f"Recalibration of {result['robot']}")
    for name, figures in result["drift"].items():
        verdict = "broken" if figures["broken"] else "drifted" if figures["drifted"] else "ok"
        gates = result["joints"].get(name, {}).get("outcome", "ok")
        table.add_row(
            name,
            verdict if gates == "ok" else gates,
            format_figure(figures["distance_percent"], ".1f", "%"),
            format_figure(figures["distance_from_active_percent"], ".1f", "%"),
            format_figure(figures["coulomb_nm"], ".3f", "N m"),
            format_figure(figures["temperature_c"], ".1f", "degC"),
        )
    output.err.print(table)
    # One line for whatever reads the log next morning.
    kept = ("outcome", "robot", "promoted", "active", "drifted", "reason", "next_step", "run", "recalibration_report")
    output.say(json.dumps({key: result.get(key) for key in kept}))


@verb(app, "recalibrate", _show_night)
def recalibrate(
    output: Output,
    robot: str,
    bus: str | None = None,
    store: Path | None = None,
    realtime: bool | None = None,
    seed: int = 0,
    notify: str | None = None,
    live: bool = False,
    live_at: str | None = None,
    out: Path | None = None,
) -> Result:
    """Calibrate with nobody watching; promote or refuse by the robot file's policy. Never asks."""
    from frictid_hil.cli.progress import watching
    from frictid_hil.jobs.recalibrate import RecalibrateOptions
    from frictid_hil.jobs.recalibrate import recalibrate as job

    # The policy in the robot file has said yes, or the job refuses.
    with watching(output, yes=True, live=live, live_at=live_at) as watcher:
        return job(output.options(RecalibrateOptions), watcher)


def _show_units(output: Output, result: Result) -> None:
    output.tell(result, "service", "timer")
    output.out.print(f"next time: {result['next_elapse'] or 'unknown (systemd-analyze is not installed)'}")
    output.out.print(f"verified by systemd-analyze: {'yes' if result['verified'] else 'no'}")
    output.say(f"turn it on: {result['enable']}")
    cron = f"for crontab -e:\n{result['cron']}" if result["cron"] else result["cron_refused"]
    output.say(f"without systemd, {cron}")


@verb(app, "schedule", _show_units)
@takes(
    on_calendar=option("--on-calendar", "WHEN", 'When, e.g. "Mon..Fri 02:30" (man systemd.time).'),
    system=typer.Option("--system/--user", help="For the whole machine, or for this person alone."),
    user=option("--account", "NAME", "Account that a system service runs as."),
    command=opt.SHARED["notify"],
    time_limit_s=option("--time-limit", "TIME", "A longer night is stopped.", parser=opt.quantity("duration")),
)
def schedule(
    output: Output,
    robot: str,
    on_calendar: str,
    bus: str | None = None,
    system: bool = False,
    user: str = "frictid",
    command: str | None = None,
    time_limit_s: float = "4h",  # type: ignore[assignment]  # typer parses it
    out: Path | None = None,
) -> Result:
    """Write and verify the systemd service and timer for `recalibrate`; print a cron line as well."""
    from frictid_hil.jobs.schedule import ScheduleOptions
    from frictid_hil.jobs.schedule import schedule as job

    return job(output.options(ScheduleOptions, notify=command))
