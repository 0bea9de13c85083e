"""What can be said of a serial controller without moving anything: identity, capabilities, findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from frictid_drivers.motoman.batch_messages import TABLE_POINTS, BatchHello
from frictid_drivers.motoman.controller_errors import ControllerError
from frictid_drivers.motoman.host_control import HostControl, Status
from frictid_drivers.motoman.joint_units import AxisUnits
from frictid_drivers.motoman.layers import Layer, Reach, busy_share, streamed_mask
from frictid_drivers.motoman.segments import motion_segments
from frictid_drivers.motoman.settings import SerialOptions
from frictid_hil.errors import PlanRefused
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Capabilities, Finding, JointIdentity, Severity
from frictid_hil.units import degrees

_LONG_AVERAGING_MS = 20
_SERVO_LAG_S = 0.02


def identity(joint: JointSetup, units: AxisUnits, options: SerialOptions, reach: Reach) -> JointIdentity:
    """One joint, as far as controller and robot file know it."""
    settings: dict[str, str | float | int | bool] = {
        "layer": reach.layer.value,
        "pulses_per_degree": abs(units.pulses_per_rad) / degrees(1.0),
    }
    averaging, unit = None, 0
    if reach.batch is not None:
        averaging = reach.batch.averaging_ms
        settings["tick_us"] = reach.batch.tick_us
    if reach.welcome is not None:
        averaging, unit = reach.welcome.averaging_ms, reach.welcome.torque_unit
        settings["tick_us"] = reach.welcome.tick_us
    if averaging is not None:
        settings["command_averaging_ms"] = averaging
    source = ""
    if reach.layer is not Layer.HOST:
        what = "measured" if _measures_torque(reach) else "commanded"
        source = f"controller application, {what} at the motor shaft"
    return JointIdentity(
        joint=joint.name,
        firmware=reach.batch.name if reach.batch is not None else "",
        product=f"MOTOMAN-class controller, {options.controller.upper()} generation, axis {units.axis}",
        rated_torque_nm=joint.rated_torque_nm,
        gear_ratio=joint.gear_ratio,
        position_resolution_rad=abs(1.0 / units.pulses_per_rad),
        torque_resolution_nm=abs(units.torque_nm(1.0, unit)),
        torque_source=source,
        timing=options.timing,
        settings=settings,
    )


def capabilities(reach: Reach, options: SerialOptions, tick_us: int, *, lock_step: bool) -> Capabilities:
    """What the layer that was found can do; without torque, nothing.

    Args:
        reach: see there.
        options: of the robot file.
        tick_us: interpolation clock that the robot file names.
        lock_step: the controller is emulated on virtual time.
    """
    if reach.layer is Layer.HOST:
        return Capabilities(max_cycle_hz=0.0, modes=frozenset())
    streaming = reach.layer is Layer.STREAM
    return Capabilities(
        max_cycle_hz=1e6 / tick_us,
        modes=frozenset({Mode.POSITION}),
        torque_offset=streaming and reach.welcome is not None and reach.welcome.feed_forward,
        drive_watchdog=True,
        batch_only=not streaming,
        lock_step=lock_step,
        cycle_quantum_s=tick_us * 1e-6,
        table_download=reach.batch is not None and reach.batch.table_points >= TABLE_POINTS,
        command_delay_s=_command_delay_s(reach, options),
    )


def _command_delay_s(reach: Reach, options: SerialOptions) -> float:
    """Averaging and servo; where the controller does not know its averaging, what the robot file allows."""
    greeting = reach.welcome or reach.batch
    known_ms = greeting.averaging_ms if greeting is not None else None
    averaging_ms = options.command_delay_ms if known_ms is None else known_ms
    return averaging_ms * 1e-3 + _SERVO_LAG_S


def findings(
    setup: RobotSetup,
    units: Mapping[str, AxisUnits],
    options: SerialOptions,
    reach: Reach,
    host: HostControl,
    plan: Plan | None,
) -> list[Finding]:
    """One line per thing a person should know before motion."""
    found = [
        Finding(
            Severity.WARNING,
            "driver",
            "follows public documents and was never run against a controller",
            "watch the first run with a hand on the emergency stop",
        ),
        Finding(
            Severity.OK,
            "port",
            f"{options.baud} baud, parity {options.parity_on(setup.bus.partition(':')[2])}"
            + ("" if options.parity else " (not given: E on hardware, N on a pseudo terminal)"),
        ),
        *_of_status(host.status()),
        *_of_alarms(host),
        *_of_layers(setup, options, reach),
        *_of_positions(setup, units, reach, host),
    ]
    if plan is not None and reach.layer is not Layer.HOST and round(1e6 / plan.cycle_hz) != round(1e6 / setup.cycle_hz):
        found.append(Finding(Severity.ERROR, "rate", f"the plan runs at {plan.cycle_hz:g} Hz, not at the tick's rate"))
    if reach.layer is Layer.BATCH and reach.batch is not None and plan is not None:
        found += _of_jobs(plan, units, reach.batch)
    if reach.layer is Layer.STREAM and reach.welcome is not None:
        found.append(_of_load(setup, units, options, reach, [entry.joint for entry in plan.joints] if plan else []))
    return found


def _of_jobs(plan: Plan, units: Mapping[str, AxisUnits], batch: BatchHello) -> list[Finding]:
    """Whether every motion of the plan can be a job, before the first one begins."""
    found: list[Finding] = []
    for entry in plan.joints:
        subject = f"joint {entry.joint}"
        try:
            motion = motion_segments(entry.motions, units[entry.joint], batch.tick_us * 1e-6)
        except PlanRefused as refused:
            found.append(Finding(Severity.ERROR, subject, refused.what, refused.next_step))
            continue
        ticks = len(motion.command)
        if ticks > batch.most_ticks:
            message = f"its motions take {ticks} ticks, the controller records at most {batch.most_ticks}"
            found.append(Finding(Severity.ERROR, subject, message, "plan fewer cycles, or a shorter warm-up"))
    return found


def _of_status(status: Status) -> list[Finding]:
    shown = ", ".join(sorted(status.conditions)) or "nothing set"
    found = [Finding(Severity.OK, "controller", f"RSTATS {status.data_1},{status.data_2}: {shown}")]
    for hold in status.holds:
        if hold == "command hold":
            message = "is on: something stopped the arm; it is released when the run begins"
            found.append(Finding(Severity.WARNING, hold, message, "make sure that you know what stopped it"))
        else:
            found.append(Finding(Severity.ERROR, hold, "is on", "release it at the controller"))
    if status.faulty:
        found.append(Finding(Severity.ERROR, "controller", "an alarm or error is pending", "clear it on the pendant"))
    if status.reports_mode and "play" not in status.conditions:
        found.append(Finding(Severity.ERROR, "mode", "is not play", "turn the key to play"))
    if status.reports_mode and "command remote" not in status.conditions:
        found.append(Finding(Severity.ERROR, "remote", "command remote is not set", "enable it on the pendant"))
    return found


def _of_alarms(host: HostControl) -> list[Finding]:
    try:
        text = host.alarms()
    except ControllerError as refused:
        return [Finding(Severity.WARNING, "alarms", f"cannot be read: {refused.what}")]
    return [Finding(Severity.OK, "alarms", f"RALARM {text} (its layout is not public)")]


def _of_layers(setup: RobotSetup, options: SerialOptions, reach: Reach) -> list[Finding]:
    found = [Finding(Severity.OK, "layer", f"{reach.layer.value} is used")]
    found += [Finding(Severity.OK, f"layer {name}", f"not used: {why}") for name, why in reach.reasons.items()]
    if reach.layer is Layer.HOST:
        found.append(
            Finding(
                Severity.ERROR,
                "torque",
                "stock host control reads no torque, so nothing can be identified through it",
                "install the controller application (docs/reference/motoman-controller-application.md)",
            )
        )
    ticks = {found_in.tick_us for found_in in (reach.welcome, reach.batch) if found_in is not None}
    wanted = round(1e6 / setup.cycle_hz)
    if ticks - {wanted}:
        message = f"the controller ticks every {max(ticks)} us, the robot file says every {wanted} us"
        found.append(Finding(Severity.ERROR, "rate", message, f"set `cycle_hz` to {1e6 / max(ticks):g}"))
    if reach.layer is not Layer.HOST and not _measures_torque(reach):
        message = "the controller application reports commanded torque, which the controller's own delays shift"
        found.append(Finding(Severity.WARNING, "torque", message, "measure it, or declare its delay"))
    averaging = reach.welcome.averaging_ms if reach.welcome else reach.batch.averaging_ms if reach.batch else 0
    if averaging is None:
        found.append(
            Finding(
                Severity.WARNING,
                "averaging",
                "whether the controller averages the command is not known; achieved over planned peak speed will tell",
            )
        )
    elif averaging > _LONG_AVERAGING_MS:
        message = f"the controller averages the command over {averaging} ms: fast cycles will fall short of their peak"
        found.append(Finding(Severity.WARNING, "averaging", message, "shorten the filter, or lower the velocity"))
    if reach.layer is Layer.BATCH:
        found.append(
            Finding(Severity.OK, "transfer", _transfer(reach.batch is not None and reach.batch.reads_while_running))
        )
    return found


def _transfer(reads_while_running: bool) -> str:
    if reads_while_running:
        return "16 s of motion take half a minute at 19200 baud, a quarter of it while the job runs"
    return "16 s of motion take half a minute at 19200 baud, all of it once the job is over"


def _measures_torque(reach: Reach) -> bool:
    if reach.layer is Layer.STREAM:
        return reach.welcome is not None and reach.welcome.torque_measured
    return reach.batch is not None and reach.batch.torque_measured


def _of_positions(setup: RobotSetup, units: Mapping[str, AxisUnits], reach: Reach, host: HostControl) -> list[Finding]:
    try:
        pulses = host.pulses()
    except ControllerError as refused:
        return [Finding(Severity.ERROR, "position", refused.what, refused.next_step)]
    found = []
    for joint in setup.joints:
        here_rad = units[joint.name].position_rad(pulses[units[joint.name].axis])
        inside = joint.position_min_rad <= here_rad <= joint.position_max_rad
        found.append(
            Finding(
                Severity.OK if inside else Severity.ERROR,
                f"joint {joint.name}",
                f"stands at {degrees(here_rad):.2f} deg" + ("" if inside else ", outside its limits"),
                "" if inside else "check `pulses_per_degree`, or jog it back",
            )
        )
    return found


def _of_load(
    setup: RobotSetup, units: Mapping[str, AxisUnits], options: SerialOptions, reach: Reach, moving: Sequence[str]
) -> Finding:
    assert reach.welcome is not None
    everything = sum(1 << unit.axis for unit in units.values())
    one = 1 << units[moving[0] if moving else setup.joints[0].name].axis
    try:
        mask = streamed_mask(everything, one, options.stream_baud, reach.welcome.tick_us)
    except PlanRefused as refused:
        return Finding(Severity.ERROR, "line load", refused.what, refused.next_step)
    share = busy_share(mask.bit_count(), options.stream_baud, reach.welcome.tick_us)
    joints = "all joints" if mask == everything else "the moving joint alone"
    return Finding(Severity.OK, "line load", f"{share:.0%} of every tick at {options.stream_baud} baud, {joints}")
