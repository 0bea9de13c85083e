"""``recalibrate`` and ``schedule``: what happens when nobody is there."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from frictid_hil.cli.options import (
    BusOption,
    JsonOption,
    LiveAtOption,
    LiveOption,
    NotifyOption,
    OutOption,
    QuietOption,
    RealtimeOption,
    RobotOption,
    SeedOption,
    StoreOption,
    quantity,
)
from frictid_hil.cli.output import Output, Result
from frictid_hil.cli.tables import folding


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("recalibrate")(recalibrate)
    app.command("schedule")(schedule)


def recalibrate(
    robot: RobotOption,
    bus: BusOption = None,
    store: StoreOption = None,
    realtime: RealtimeOption = False,
    seed: SeedOption = 0,
    notify: NotifyOption = None,
    live: LiveOption = False,
    live_at: LiveAtOption = None,
    out: OutOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Calibrate with nobody watching; promote or refuse by the robot file's policy. Never asks."""
    from frictid_hil.cli.progress import watching
    from frictid_hil.jobs.recalibrate import RecalibrateOptions
    from frictid_hil.jobs.recalibrate import recalibrate as job

    output = Output(as_json, quiet, notify)
    options = RecalibrateOptions(robot, bus=bus, store=store, realtime=realtime, seed=seed, out=out)

    def run() -> Result:
        # The policy in the robot file has said yes, or the job refuses.
        with watching(output, yes=True, live=live, live_at=live_at) as watcher:
            return job(options, watcher)

    output.run("recalibrate", run, lambda result: _print_night(output, result))


def schedule(
    robot: RobotOption,
    on_calendar: Annotated[
        str, typer.Option("--on-calendar", metavar="WHEN", help='When, e.g. "Mon..Fri 02:30" (man systemd.time).')
    ],
    bus: BusOption = None,
    system: Annotated[
        bool, typer.Option("--system/--user", help="For the whole machine, or for this person alone.")
    ] = False,
    account: Annotated[
        str, typer.Option("--account", metavar="NAME", help="Account that a system service runs as.")
    ] = "frictid",
    notify: NotifyOption = None,
    time_limit: Annotated[
        float,
        typer.Option("--time-limit", metavar="TIME", parser=quantity("duration"), help="A longer night is stopped."),
    ] = "4h",  # type: ignore[assignment]  # typer parses it
    out: OutOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write and verify the systemd service and timer for `recalibrate`; print a cron line as well."""
    from frictid_hil.jobs.schedule import ScheduleOptions
    from frictid_hil.jobs.schedule import schedule as job

    output = Output(as_json, quiet)
    options = ScheduleOptions(
        robot, on_calendar, bus=bus, system=system, user=account, notify=notify, out=out, time_limit_s=time_limit
    )

    def show(result: Result) -> None:
        for key in ("service", "timer"):
            output.out.print(f"{key}: {result[key]}", soft_wrap=True)
        output.out.print(f"next time: {result['next_elapse'] or 'unknown (systemd-analyze is not installed)'}")
        output.out.print(f"verified by systemd-analyze: {'yes' if result['verified'] else 'no'}")
        output.out.print(f"turn it on: {result['enable']}", soft_wrap=True)
        cron = f"for crontab -e:\n{result['cron']}" if result["cron"] else result["cron_refused"]
        output.out.print(f"without systemd, {cron}", soft_wrap=True)

    output.run("schedule", lambda: job(options), show)


def _print_night(output: Output, result: Result) -> None:
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
    output.out.print(json.dumps({key: result.get(key) for key in kept}), soft_wrap=True)


def _with_unit(value: float | None, unit: str, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f} {unit}"
