"""``profile``: look at friction profiles and manage the store of active ones."""

from __future__ import annotations

from pathlib import Path

import typer
from rich.text import Text

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import argument, option
from frictid_hil.cli.output import READING, Output, Result, folding, takes, verb
from frictid_hil.plan.linear_axis import rotary_names
from frictid_hil.units import degrees, format_figure

_SHOWN = 50  # profiles, promotions and nights in a table that a person reads

app = typer.Typer(help="Show, compare and manage friction profiles.", no_args_is_help=True)


def _show_profile(output: Output, result: Result) -> None:
    for name, joint in rotary_names(result["joints"]).items():
        linear = bool(joint.get("prismatic"))
        force, speed = ("N", "m/s") if linear else ("N m", "deg/s")
        output.out.print(f"joint {name}: {joint['method']}, F_0 = {joint['coulomb_nm']['value']:.4g} {force}")
        table = folding()
        for heading in (f"V_n [{speed}]", f"F_n [{force}]", "95 % interval"):
            table.add_column(heading, justify="right")
        intervals = joint.get("torque_interval_nm") or [None] * len(joint["torque_nm"])
        for velocity, torque, interval in zip(joint["velocity_rad_s"], joint["torque_nm"], intervals, strict=True):
            known = f"{interval[0]:.4g} .. {interval[1]:.4g}" if interval else ""
            table.add_row(f"{velocity if linear else degrees(velocity):.4g}", f"{torque:.4g}", known)
        output.out.print(table)
        output.out.print(_timing(joint), highlight=False)
    provenance = result["provenance"]
    output.out.print(f"{result['robot']}, {provenance['created_utc']}, frictid-hil {provenance['tool_version']}")


def _timing(joint: Result) -> str:
    """By how much torque was taken to lag position, and why."""
    used = f"torque taken {1e3 * joint.get('time_skew_s', 0.0):.3f} ms later than position"
    skew = joint.get("time_skew")
    if not skew:
        return f"{used}, as declared"
    measured, declared = (
        f"{1e3 * skew[f'{name}_s']:.3f} +- {2e3 * skew[f'{name}_deviation_s']:.3f}" for name in ("measured", "declared")
    )
    return f"{used} (+- {2e3 * skew['used_deviation_s']:.3f}): measured {measured} ms, declared {declared} ms"


@verb(app, "show", _show_profile, schema="profile_show")
def show(output: Output, profile: Path) -> Result:
    """Print a profile as a person reads it."""
    from frictid_hil.jobs.profiles import show as job

    return job(profile)


def _show_export(output: Output, result: Result) -> None:
    output.tell(result, "written")
    output.out.print(f"off the curve by {result['worst_percent']:.1f} % at most, within what was measured")
    output.tell(result, "lost")


@verb(app, "export", _show_export, schema="profile_export")
@takes(
    to=option("--to", "TARGET", "table (20 points, CSV), ros2 (YAML) or i2rt (YAML)."),
    out=option("--out", "FILE", "File to write."),
)
def export(output: Output, profile: Path, to: str, out: Path, force: bool = False) -> Result:
    """Write a profile in the form of the place where it shall act, and say what is lost."""
    from frictid_hil.jobs.profiles import export as job

    return job(profile, to, out, force=force)


def _show_diff(output: Output, result: Result) -> None:
    rows = [
        (
            name,
            f"{figures['distance_percent']:.2f}",
            format_figure(figures["coulomb_change_percent"], "+.1f"),
            "" if figures["overlap_share"] is None else f"{100 * figures['overlap_share']:.0f}",
            format_figure(figures["temperature_change_c"], "+.1f"),
            "; ".join(f"{what}: {how}" for what, how in figures["other_changes"].items()),
        )
        for name, figures in result["joints"].items()
    ]
    headings = ("joint", "distance [%]", "F_0 [%]", "intervals that overlap [%]", "temperature [K]", "also changed")
    output.table(headings, rows, ("joint",))
    for warning in result["warnings"]:
        output.out.print(Text.assemble(("note:", "yellow"), f" {warning}"), soft_wrap=True)


@verb(app, "diff", _show_diff, schema="profile_diff")
@takes(
    older=argument(
        "PROFILE", "Profile, run folder; or with --robot an id, `active`, `baseline`.", complete=opt.profiles
    ),
    newer=argument("PROFILE", "The same.", complete=opt.profiles),
    robot=option("--robot -r", "ROBOT", "Name of the robot whose store is meant by ids.", complete=opt.robots),
)
def diff(output: Output, older: str, newer: str, robot: str | None = None, store: Path | None = None) -> Result:
    """How two profiles differ: distance (15), F_0, overlap of intervals, temperature, and what else changed."""
    from frictid_hil.jobs.profiles import diff as job

    return job(older, newer, robot=robot, store=store)


def _show_active(output: Output, result: Result) -> None:
    output.tell(result, "active")
    if kept := result.get("joints_kept"):
        output.out.print(f"joints {', '.join(kept)} are not in this profile, and stay as {result['before']} has them")


@verb(app, "promote", _show_active, schema="profile_promote")
@takes(
    profile=argument("PROFILE", "Profile, run folder; or with --robot an id of the store.", complete=opt.profiles),
    robot=option("--robot -r", "ROBOT", "Name of the robot whose store is meant by ids.", complete=opt.robots),
    reason=option("--reason", "TEXT", "For the history."),
    baseline=typer.Option("--baseline", help="Measure drift from it from now on."),
    force=typer.Option("--force", help="Although a quality gate failed."),
)
def promote(
    output: Output,
    profile: str,
    robot: str | None = None,
    reason: str = "",
    baseline: bool = False,
    force: bool = False,
    store: Path | None = None,
) -> Result:
    """Make a profile the active one of its robot; joints that it lacks stay, and one command goes back."""
    from frictid_hil.jobs.profiles import promote as job

    told = output.counting(READING)
    return job(profile, robot=robot, store=store, reason=reason, baseline=baseline, force=force, told=told)


@verb(app, "rollback", _show_active, schema="profile_rollback")
@takes(
    robot=argument("ROBOT", "Name of the robot.", complete=opt.robots),
    reason=option("--reason", "TEXT", "For the history."),
)
def rollback(output: Output, robot: str, reason: str = "", store: Path | None = None) -> Result:
    """Make the profile active again that was so before the present one."""
    from frictid_hil.jobs.profiles import rollback as job

    return job(robot, store=store, reason=reason)


def _show_history(output: Output, result: Result) -> None:
    headings = ("profile (* active)", "F_0", "from baseline", "temperature")
    table = folding(*headings, whole=headings[:2], title=result["robot"])
    for profile in result["profiles"]:
        table.add_row(f"{profile['id']}{' *' if profile['active'] else ''}")
        for name, figures in profile["joints"].items():
            table.add_row(f"  joint {name}", *_figures(figures))
        table.add_section()
    output.out.print(table)
    for line in _events(result):
        output.say(line)
    if older := result["profiles_kept"] - len(result["profiles"]):
        output.out.print(f"{older} older profiles are not shown; see them with --last 0")


def _figures(joint: Result) -> tuple[str, str, str]:
    """F_0, distance from the baseline and temperature, with their units."""
    unit = "N" if "coulomb_n" in joint else "N m"
    joint = rotary_names(joint)
    forms = ("coulomb_nm", ".4g", unit), ("distance_percent", ".1f", "%"), ("temperature_c", ".0f", "degC")
    level, distance, temperature = (format_figure(joint[key], form, unit) for key, form, unit in forms)
    return level, distance, temperature


def _events(result: Result) -> list[str]:
    """Promotions, and nights that promoted nothing, by their times."""
    events = [
        f"{one['utc']} {one['action']} {one['id']} by {one['by']}: {one['reason']}" for one in result["promotions"]
    ]
    events += [
        f"{one['utc']} nothing promoted ({one['outcome']}): {one['reason']}"
        for one in result["recalibrations"]
        if not one["promoted"]
    ]
    return sorted(events)


@verb(app, "history", _show_history, schema="profile_history")
@takes(
    robot=argument("ROBOT", "Name of the robot.", complete=opt.robots),
    last=option("--last", "N", "Only so many, 0 for all. Default: 50 in a table, all with --json.", min=0),
)
def history(output: Output, robot: str, last: int | None = None, store: Path | None = None) -> Result:
    """Every profile of a robot, with F_0, distance from the baseline and temperature of every joint."""
    from frictid_hil.jobs.profiles import history as job
    from frictid_hil.profiles.store import ProfileStore

    shown = last if last is not None else 0 if output.as_json else _SHOWN
    return job(ProfileStore(store, output.counting(READING)), robot, last=shown or None)
