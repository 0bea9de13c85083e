"""``compensate``: friction compensation live on the bus."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from frictid_hil.cli.options import (
    BusOption,
    DryRunOption,
    LiveAtOption,
    LiveOption,
    OneJointOption,
    OutOption,
    RealtimeOption,
    RobotOption,
    SeedOption,
    StoreOption,
    YesOption,
    one_of,
    profiles,
    quantity,
)
from frictid_hil.cli.output import Output, Result, Told, verb
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
    return 0.0 if text.strip() == "0" else quantity("duration")(text)


TaskOption = Annotated[
    str,
    typer.Option(
        "--task",
        metavar="TASK",
        autocompletion=one_of("hand", "track"),
        help="hand (a person guides the joint), track (a triangle under a weak PD).",
    ),
]
ProfileOption = Annotated[
    str,
    typer.Option(
        "--profile",
        "-p",
        metavar="PROFILE",
        autocompletion=profiles,
        help="Profile, run folder, or id of the store. Default: the robot's active profile.",
    ),
]
ModeOption = Annotated[
    str | None,
    typer.Option(
        "--mode",
        metavar="MODES",
        help="nc, mo, mol, mop, mop-reference, joined by commas. Default: all of the task.",
    ),
]
SettingOption = Annotated[
    str,
    typer.Option(
        "--setting",
        metavar="SETTING",
        autocompletion=one_of("ours", "paper"),
        help="ours, or paper (R = 0.9, K = 10000 N m/rad).",
    ),
]
StiffnessOption = Annotated[
    float | None, typer.Option("--stiffness", metavar="K", parser=quantity("stiffness"), help="K, e.g. 8000Nm/rad.")
]
ViscosityOption = Annotated[
    float | None,
    typer.Option(
        "--viscosity", metavar="B_C", help="B_c of mol in N m s/rad, instead of the least-squares one.", min=0.0
    ),
]
SpeedOption = Annotated[
    float | None,
    typer.Option("--speed", metavar="SPEED", parser=quantity("angular velocity"), help="Peak speed of the task."),
]
DurationOption = Annotated[
    float | None,
    typer.Option(
        "--duration",
        metavar="TIME",
        parser=_duration,
        help="Of each mode, 10s unless told; 0 runs until interrupted.",
    ),
]
CentreOption = Annotated[
    float | None, typer.Option("--centre", metavar="ANGLE", parser=quantity("angle"), help="Middle of the travel.")
]
DriveModeOption = Annotated[
    str,
    typer.Option(
        "--drive-mode",
        metavar="MODE",
        autocompletion=one_of("torque", "position", "velocity"),
        help="torque; position or velocity with the torque as offset (60B2).",
    ),
]


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
def compensate(
    output: Output,
    robot: RobotOption,
    joint: OneJointOption,
    task: TaskOption,
    profile: ProfileOption = "active",
    mode: ModeOption = None,
    setting: SettingOption = "ours",
    ratio: Annotated[float | None, typer.Option("--compensation-ratio", metavar="R", help="R, below 1.")] = None,
    stiffness_nm_per_rad: StiffnessOption = None,
    viscous_nm_s_per_rad: ViscosityOption = None,
    speed_rad_s: SpeedOption = None,
    duration_s: DurationOption = None,
    centre_rad: CentreOption = None,
    drive_mode: DriveModeOption = "torque",
    force: Annotated[bool, typer.Option("--force", help="Use a profile that does not fit, under supervision.")] = False,
    dry_run: DryRunOption = False,
    bus: BusOption = None,
    realtime: RealtimeOption = None,
    seed: SeedOption = 0,
    live: LiveOption = False,
    live_at: LiveAtOption = None,
    out: OutOption = None,
    store: StoreOption = None,
    yes: YesOption = False,
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
        return shown_plan(output, plan_compensation(options))
    with watching(output, yes=yes, live=live, live_at=live_at) as watcher:
        return job(options, watcher, live=watcher.note)
