"""``recalibrate`` and ``schedule``: what happens when nobody is there."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import option
from frictid_hil.cli.output import Output, Result, folding, verb

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
            _with_unit(figures["distance_percent"], "%"),
            _with_unit(figures["distance_from_active_percent"], "%"),
            _with_unit(figures["coulomb_nm"], "N m", digits=3),
            _with_unit(figures["temperature_c"], "degC"),
        )
    output.err.print(table)
    # One line for whatever reads the log next morning.
    kept = ("outcome", "robot", "promoted", "active", "drifted", "reason", "next_step", "run", "recalibration_report")
    output.say(json.dumps({key: result.get(key) for key in kept}))


def _with_unit(value: float | None, unit: str, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f} {unit}"


@verb(app, "recalibrate", _show_night)
def recalibrate(
    output: Output,
    robot: opt.Robot,
    bus: opt.Bus = None,
    store: opt.Store = None,
    realtime: opt.Realtime = None,
    seed: opt.Seed = 0,
    notify: opt.Notify = None,
    live: opt.Live = False,
    live_at: opt.LiveAt = None,
    out: opt.Out = None,
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
def schedule(
    output: Output,
    robot: opt.Robot,
    on_calendar: Annotated[str, option("--on-calendar", "WHEN", 'When, e.g. "Mon..Fri 02:30" (man systemd.time).')],
    bus: opt.Bus = None,
    system: Annotated[
        bool, typer.Option("--system/--user", help="For the whole machine, or for this person alone.")
    ] = False,
    user: Annotated[str, option("--account", "NAME", "Account that a system service runs as.")] = "frictid",
    command: opt.Notify = None,
    time_limit_s: Annotated[
        float, option("--time-limit", "TIME", "A longer night is stopped.", parser=opt.quantity("duration"))
    ] = "4h",  # type: ignore[assignment]  # typer parses it
    out: opt.Out = None,
) -> Result:
    """Write and verify the systemd service and timer for `recalibrate`; print a cron line as well."""
    from frictid_hil.jobs.schedule import ScheduleOptions
    from frictid_hil.jobs.schedule import schedule as job

    return job(output.options(ScheduleOptions, notify=command))
