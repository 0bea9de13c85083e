"""What can be said of a serial controller without moving anything: identity, capabilities, findings."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from frictid_drivers.motoman.batch import TABLE_POINTS, BatchHello
from frictid_drivers.motoman.controller_errors import ControllerError
from frictid_drivers.motoman.host_control import HostControl, Status
from frictid_drivers.motoman.joint_units import AxisUnits
from frictid_drivers.motoman.layers import Reach, busy_share, streamed_mask
from frictid_drivers.motoman.segments import motion_segments
from frictid_drivers.motoman.settings import SerialOptions
from frictid_drivers.motoman.stream_frames import Welcome
from frictid_hil.errors import PlanRefused
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Capabilities, Finding, JointIdentity, Severity
from frictid_hil.units import degrees

_LONG_AVERAGING_MS = 20
_SERVO_LAG_S = 0.02

_ok, _warning, _error = (partial(Finding, severity) for severity in (Severity.OK, Severity.WARNING, Severity.ERROR))


def identity(joint: JointSetup, units: AxisUnits, options: SerialOptions, reach: Reach) -> JointIdentity:
    """One joint, as far as controller and robot file know it."""
    settings: dict[str, str | float | int | bool] = {
        "layer": reach.layer,
        "pulses_per_degree": abs(units.pulses_per_rad) / degrees(1.0),
    }
    source, application = "", reach.application
    if application is not None:
        what = "measured" if application.torque_measured else "commanded"
        source = f"controller application, {what} at the motor shaft"
        settings["tick_us"] = application.tick_us
        if application.averaging_ms is not None:
            settings["command_averaging_ms"] = application.averaging_ms
    return JointIdentity(
        joint=joint.name,
        firmware=reach.batch.name if reach.batch is not None else "",
        product=f"MOTOMAN-class controller, {options.controller.upper()} generation, axis {units.axis}",
        rated_torque_nm=joint.rated_torque_nm,
        gear_ratio=joint.gear_ratio,
        position_resolution_rad=abs(1.0 / units.pulses_per_rad),
        torque_resolution_nm=abs(units.torque_nm(1.0, reach.welcome.torque_unit if reach.welcome else 0)),
        torque_source=source,
        timing=options.timing,
        settings=settings,
    )


def capabilities(reach: Reach, options: SerialOptions, tick_us: int, *, lock_step: bool) -> Capabilities:
    """What the layer that was found can do on the tick that the robot file names; without torque, nothing."""
    application = reach.application
    if application is None:
        return Capabilities(max_cycle_hz=0.0, modes=frozenset())
    averaging_ms = options.command_delay_ms if application.averaging_ms is None else application.averaging_ms
    return Capabilities(
        max_cycle_hz=1e6 / tick_us,
        modes=frozenset({Mode.POSITION}),
        torque_offset=reach.welcome is not None and reach.welcome.feed_forward,
        drive_watchdog=True,
        batch_only=reach.welcome is None,
        lock_step=lock_step,
        cycle_quantum_s=tick_us * 1e-6,
        table_download=reach.batch is not None and reach.batch.table_points >= TABLE_POINTS,
        command_delay_s=averaging_ms * 1e-3 + _SERVO_LAG_S,
    )


def findings(
    setup: RobotSetup,
    units: Mapping[str, AxisUnits],
    options: SerialOptions,
    reach: Reach,
    host: HostControl,
    plan: Plan | None,
) -> list[Finding]:
    """One line per thing a person should know before motion."""
    parity = options.parity_on(setup.bus.partition(":")[2])
    assumed = "" if options.parity else " (not given: E on hardware, N on a pseudo terminal)"
    found = [
        _warning(
            "driver",
            "follows public documents and was never run against a controller",
            "watch the first run with a hand on the emergency stop",
        ),
        _ok("port", f"{options.baud} baud, parity {parity}{assumed}"),
        *_of_status(host.status()),
        _of_alarms(host),
        *_of_layers(setup, reach),
        *_of_positions(setup, units, host),
    ]
    if plan is not None and reach.application is not None and round(1e6 / plan.cycle_hz) != round(1e6 / setup.cycle_hz):
        found.append(_error("rate", f"the plan runs at {plan.cycle_hz:g} Hz, not at the tick's rate"))
    if reach.welcome is not None:
        moving = plan.joints[0].joint if plan is not None and plan.joints else setup.joints[0].name
        found.append(_of_load(units, options, reach.welcome, moving))
    elif reach.batch is not None and plan is not None:
        found += _of_jobs(plan, units, reach.batch)
    return found


def _of_jobs(plan: Plan, units: Mapping[str, AxisUnits], batch: BatchHello) -> list[Finding]:
    """Whether every motion of the plan can be a job, before the first one begins."""
    found: list[Finding] = []
    for entry in plan.joints:
        subject = f"joint {entry.joint}"
        try:
            motion = motion_segments(entry.motions, units[entry.joint], batch.tick_us * 1e-6)
        except PlanRefused as refused:
            found.append(_error(subject, refused.what, refused.next_step))
            continue
        ticks = len(motion.command)
        if ticks > batch.most_ticks:
            message = f"its motions take {ticks} ticks, the controller records at most {batch.most_ticks}"
            found.append(_error(subject, message, "plan fewer cycles, or a shorter warm-up"))
    return found


def _of_status(status: Status) -> list[Finding]:
    shown = ", ".join(sorted(status.conditions)) or "nothing set"
    found = [_ok("controller", f"RSTATS {status.data_1},{status.data_2}: {shown}")]
    for hold in status.holds:
        if hold == "command hold":
            message = "is on: something stopped the arm; it is released when the run begins"
            found.append(_warning(hold, message, "make sure that you know what stopped it"))
        else:
            found.append(_error(hold, "is on", "release it at the controller"))
    if status.faulty:
        found.append(_error("controller", "an alarm or error is pending", "clear it on the pendant"))
    if status.reports_mode and "play" not in status.conditions:
        found.append(_error("mode", "is not play", "turn the key to play"))
    if status.reports_mode and "command remote" not in status.conditions:
        found.append(_error("remote", "command remote is not set", "enable it on the pendant"))
    return found


def _of_alarms(host: HostControl) -> Finding:
    try:
        return _ok("alarms", f"RALARM {host.ask('RALARM')} (its layout is not public)")
    except ControllerError as refused:
        return _warning("alarms", f"cannot be read: {refused.what}")


def _of_layers(setup: RobotSetup, reach: Reach) -> list[Finding]:
    found = [_ok("layer", f"{reach.layer} is used")]
    found += [_ok(f"layer {name}", f"not used: {why}") for name, why in reach.reasons.items()]
    application = reach.application
    if application is None:
        found.append(
            _error(
                "torque",
                "stock host control reads no torque, so nothing can be identified through it",
                "install the controller application (docs/reference/motoman-controller-application.md)",
            )
        )
        return found
    ticks = {told.tick_us for told in (reach.welcome, reach.batch) if told is not None}
    wanted = round(1e6 / setup.cycle_hz)
    if ticks - {wanted}:
        message = f"the controller ticks every {max(ticks)} us, the robot file says every {wanted} us"
        found.append(_error("rate", message, f"set `cycle_hz` to {1e6 / max(ticks):g}"))
    if not application.torque_measured:
        message = "the controller application reports commanded torque, which the controller's own delays shift"
        found.append(_warning("torque", message, "measure it, or declare its delay"))
    averaging = application.averaging_ms
    if averaging is None:
        message = "whether the controller averages the command is not known"
        found.append(_warning("averaging", f"{message}; achieved over planned peak speed will tell"))
    elif averaging > _LONG_AVERAGING_MS:
        message = f"the controller averages the command over {averaging} ms: fast cycles will fall short of their peak"
        found.append(_warning("averaging", message, "shorten the filter, or lower the velocity"))
    if isinstance(application, BatchHello):
        when = (
            "a quarter of it while the job runs"
            if application.reads_while_running
            else "all of it once the job is over"
        )
        found.append(_ok("transfer", f"16 s of motion take half a minute at 19200 baud, {when}"))
    return found


def _of_positions(setup: RobotSetup, units: Mapping[str, AxisUnits], host: HostControl) -> list[Finding]:
    try:
        pulses = host.pulses()
    except ControllerError as refused:
        return [_error("position", refused.what, refused.next_step)]
    found = []
    for joint in setup.joints:
        here_rad = units[joint.name].position_rad(pulses[units[joint.name].axis])
        subject, message = f"joint {joint.name}", f"stands at {degrees(here_rad):.2f} deg"
        if joint.position_min_rad <= here_rad <= joint.position_max_rad:
            found.append(_ok(subject, message))
        else:
            found.append(_error(subject, f"{message}, outside its limits", "check `pulses_per_degree`, or jog it back"))
    return found


def _of_load(units: Mapping[str, AxisUnits], options: SerialOptions, welcome: Welcome, moving: str) -> Finding:
    everything = sum(1 << unit.axis for unit in units.values())
    try:
        mask = streamed_mask(everything, 1 << units[moving].axis, options.stream_baud, welcome.tick_us)
    except PlanRefused as refused:
        return _error("line load", refused.what, refused.next_step)
    share = busy_share(mask.bit_count(), options.stream_baud, welcome.tick_us)
    joints = "all joints" if mask == everything else "the moving joint alone"
    return _ok("line load", f"{share:.0%} of every tick at {options.stream_baud} baud, {joints}")
