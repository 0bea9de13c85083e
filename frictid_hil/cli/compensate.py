"""``compensate``: friction compensation live on the bus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from frictid_hil.cli import options as opt
from frictid_hil.cli.options import option
from frictid_hil.cli.output import Output, Result, Told, takes, verb
from frictid_hil.errors import UsageError
from frictid_hil.plan.mode import Mode
from frictid_hil.units import degrees

app = typer.Typer()

_DRIVE_MODES = {"torque": Mode.TORQUE, "position": Mode.POSITION, "velocity": Mode.VELOCITY}


def _drive_mode(name: str) -> Mode:
    if name not in _DRIVE_MODES:
        raise UsageError(f"no drive mode {name!r}; there are {', '.join(_DRIVE_MODES)}")
    return _DRIVE_MODES[name]


def _duration(text: str) -> float:
    return 0.0 if text.strip() == "0" else opt.quantity("duration")(text)


_HAND: dict[str, tuple[str, str, float]] = {
    "V_s": ("velocity_rms_rad_s", "deg/s", degrees(1.0)),
    "F_s": ("torque_rms_nm", "N m", 1.0),
    "reduced by": ("reduction_percent", "%", 1.0),
    "ceiling": ("ceiling_percent", "%", 1.0),
    "inertia removed": ("torque_rms_inertia_removed_nm", "N m", 1.0),
    "reduced by, inertia removed": ("reduction_inertia_removed_percent", "%", 1.0),
}
_TRACK: dict[str, tuple[str, str, float]] = {
    "E_s": ("tracking_rms_rad", "deg", degrees(1.0)),
    "reduced by": ("reduction_percent", "%", 1.0),
    "ceiling": ("ceiling_percent", "%", 1.0),
    "V_s": ("velocity_rms_rad_s", "deg/s", degrees(1.0)),
}
"""By heading of the table: key of the JSON, unit, factor."""


def _show(output: Output, result: Result) -> None:
    columns = _HAND if result["task"] == "hand" else _TRACK
    title = f"Joint {result['joint']} of {result['robot']}: {result['task']}, setting {result['setting']}"
    if modes := result["modes"]:
        rows = [(name, *(_number(figures, *one) for one in columns.values())) for name, figures in modes.items()]
        output.table(("mode", *columns), rows, ("mode",), title)
    for told in (*result["warnings"], *result["remarks"]):
        output.say(f"note: {told}")
    output.tell(result, "run", "report")


def _number(figures: dict[str, Any], key: str, unit: str, scale: float) -> str:
    value = figures.get(key)
    return "" if value is None else f"{value * scale:.4g} {unit}"


@verb(app, "compensate", _show)
@takes(
    task=option(
        "--task",
        "TASK",
        "hand (a person guides the joint), track (a triangle under a weak PD).",
        complete=opt.one_of("hand", "track"),
    ),
    profile=option(
        "--profile -p",
        "PROFILE",
        "Profile, run folder, or id of the store. Default: the robot's active profile.",
        complete=opt.profiles,
    ),
    mode=option("--mode", "MODES", "nc, mo, mol, mop, mop-reference, joined by commas. Default: all of the task."),
    setting=option(
        "--setting", "SETTING", "ours, or paper (R = 0.9, K = 10000 N m/rad).", complete=opt.one_of("ours", "paper")
    ),
    ratio=option("--compensation-ratio", "R", "R, below 1."),
    stiffness_nm_per_rad=option("--stiffness", "K", "K, e.g. 8000Nm/rad.", parser=opt.quantity("stiffness")),
    viscous_nm_s_per_rad=option(
        "--viscosity", "B_C", "B_c of mol in N m s/rad, instead of the least-squares one.", min=0.0
    ),
    speed_rad_s=option("--speed", "SPEED", "Peak speed of the task.", parser=opt.quantity("angular velocity")),
    duration_s=option(
        "--duration", "TIME", "Of each mode, 10s unless told; 0 runs until interrupted.", parser=_duration
    ),
    centre_rad=option("--centre", "ANGLE", "Middle of the travel.", parser=opt.quantity("angle")),
    drive_mode=option(
        "--drive-mode",
        "MODE",
        "torque; position or velocity with the torque as offset (60B2).",
        complete=opt.one_of("torque", "position", "velocity"),
    ),
    force=typer.Option("--force", help="Use a profile that does not fit, under supervision."),
)
def compensate(
    output: Output,
    robot: str,
    joint: str,
    task: str,
    profile: str = "active",
    mode: str | None = None,
    setting: str = "ours",
    ratio: float | None = None,
    stiffness_nm_per_rad: float | None = None,
    viscous_nm_s_per_rad: float | None = None,
    speed_rad_s: float | None = None,
    duration_s: float | None = None,
    centre_rad: float | None = None,
    drive_mode: str = "torque",
    force: bool = False,
    dry_run: bool = False,
    bus: str | None = None,
    realtime: bool | None = None,
    seed: int = 0,
    live: bool = False,
    live_at: str | None = None,
    out: Path | None = None,
    store: Path | None = None,
    yes: bool = False,
) -> Result | Told:
    """Compensate a joint's friction with an identified profile, in one mode or several, and compare them."""
    from frictid_hil.cli.progress import shown_plan, watching
    from frictid_hil.jobs.compensate import CompensateOptions, plan_compensation
    from frictid_hil.jobs.compensate import compensate as job
    from frictid_hil.jobs.compensation.wanted import Wanted

    modes = tuple(part.strip() for part in mode.split(",")) if mode else ()
    wanted = output.options(Wanted, modes=modes, drive_mode=_drive_mode(drive_mode))
    options = output.options(CompensateOptions, wanted=wanted)
    if dry_run:
        planned = plan_compensation(options)
        return shown_plan(output, planned.plan, planned.setup)
    with watching(output, yes=yes, live=live, live_at=live_at) as watcher:
        return job(options, watcher, live=watcher.note)
