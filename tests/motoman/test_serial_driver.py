"""The serial driver behind the driver protocol: options, layers, findings, cycling, stops."""

from __future__ import annotations

import inspect
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from serial_bench import START_RAD, Bench, joint, make_bench, stream_motion

from frictid_drivers.motoman import MotomanDriver
from frictid_hil.errors import ConfigError, HardwareError, InvalidFields, PlanRefused, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Driver, JointState, SetPoint, Severity, load_driver


def findings(bench: Bench) -> dict[str, tuple[Severity, str]]:
    driver = bench.driver()
    driver.open()
    found = {finding.subject: (finding.severity, finding.message) for finding in driver.check(None)}
    driver.close()
    return found


def test_it_is_a_driver_found_by_its_name() -> None:
    assert load_driver("motoman") is MotomanDriver
    assert isinstance(make_bench().driver(), Driver)


# -- the robot file --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"baut": 9600}, "is no option"),
        ({"parity": "even"}, "one of E, O, N"),
        ({"controller": "yrc"}, "one of erc"),
        ({"lead_ticks": 1}, "2..60"),
        ({"lead_ticks": 4.5}, "whole number"),
        ({"baud": True}, "whole number"),
        ({"timer_a_s": math.nan}, "must be a number"),
    ],
)
def test_impossible_options_are_named(options: dict[str, object], message: str) -> None:
    bench = make_bench()
    with pytest.raises(InvalidFields, match=message) as caught:
        MotomanDriver(replace(bench.setup, options=options))
    assert caught.value.problems[0].path == ("options", next(iter(options)))


@pytest.mark.parametrize("value", [None, 0, -3, "1000", True, math.inf])
def test_pulses_per_degree_have_no_default(value: object) -> None:
    bench = make_bench()
    bad = replace(joint(), options={} if value is None else {"pulses_per_degree": value})
    with pytest.raises(InvalidFields) as caught:
        MotomanDriver(replace(bench.setup, joints=(bad,)))
    assert caught.value.problems[0].path == ("joints", "0", "options", "pulses_per_degree")


@pytest.mark.parametrize(
    ("timing", "field"),
    [
        ({"torque_delay_s": 2.0}, "torque_delay_s"),
        ({"lag": 0.1}, "lag"),
        (3, None),
        ({"uncertainty_s": 0}, "uncertainty_s"),
    ],
)
def test_impossible_timing_is_named(timing: object, field: str | None) -> None:
    with pytest.raises(InvalidFields) as caught:
        MotomanDriver(replace(make_bench().setup, options={"timing": timing}))
    assert caught.value.problems[0].path == ("options", "timing", *([field] if field else []))


def test_declared_timing_travels_with_the_identity() -> None:
    driver = make_bench(timing={"torque_delay_s": 0.004}).driver()
    driver.open()
    timing = driver.identify()["0"].timing
    assert (timing.torque_delay_s, timing.uncertainty_s, timing.source) == (0.004, 0.0005, "robot file")
    driver.close()


def test_two_joints_on_one_axis_are_refused() -> None:
    bench = make_bench()
    with pytest.raises(InvalidFields, match="taken already"):
        MotomanDriver(replace(bench.setup, joints=(joint("a", 2), joint("b", 2))))


def test_the_bus_must_be_a_serial_port() -> None:
    with pytest.raises(ConfigError, match="serial:PORT"):
        MotomanDriver(replace(make_bench().setup, bus="socketcan:can0"))


# -- layers ----------------------------------------------------------------------------------------------------------


def test_on_a_real_port_time_is_not_virtual_so_that_the_loop_gets_a_process_of_its_own() -> None:
    bench = make_bench()
    assert bench.driver().clock.lock_step
    assert not MotomanDriver(bench.setup).clock.lock_step


def test_the_best_layer_is_found_and_says_what_it_can() -> None:
    driver = make_bench(axes=6).driver()
    driver.open()
    can = driver.capabilities()
    assert (can.max_cycle_hz, can.cycle_quantum_s, can.batch_only) == (250.0, 0.004, False)
    assert can.modes == {Mode.POSITION}
    assert can.torque_offset and can.drive_watchdog and can.table_download and can.lock_step
    assert can.command_delay_s == pytest.approx(0.02)
    driver.close()


def test_without_a_gateway_batch_is_used_and_the_reason_is_told() -> None:
    bench = make_bench(settings={"stream_bauds": ()})
    driver = bench.driver()
    driver.open()
    can = driver.capabilities()
    assert can.batch_only and can.table_download and can.cycle_quantum_s == 0.004
    severity, message = next((f.severity, f.message) for f in driver.check(None) if f.subject == "layer stream")
    assert severity is Severity.OK
    assert "1010" in message and "does not know this command" in message
    driver.close()


def test_a_stock_controller_can_be_looked_at_but_not_identified() -> None:
    bench = make_bench(settings={"stream_bauds": (), "batch": False})
    found = findings(bench)
    assert found["torque"][0] is Severity.ERROR
    assert "no torque" in found["torque"][1]
    driver = bench.driver()
    driver.open()
    assert driver.capabilities().modes == frozenset()
    with pytest.raises(PlanRefused, match="no torque"):
        driver.configure(250.0, ["0"])
    driver.close()


def test_a_layer_that_is_insisted_on_is_not_replaced_silently() -> None:
    driver = make_bench(settings={"stream_bauds": ()}, layer="stream").driver()
    with pytest.raises(HardwareError, match=r"insists on layer stream.*1010"):
        driver.open()


def test_another_interpolation_clock_is_noticed() -> None:
    found = findings(make_bench(settings={"tick_s": 0.002}))
    assert found["rate"][0] is Severity.ERROR
    assert "2000 us" in found["rate"][1]


# -- check -----------------------------------------------------------------------------------------------------------


def test_check_of_a_healthy_controller_has_no_error_and_says_that_it_is_untested() -> None:
    found = findings(make_bench(axes=6))
    assert all(severity is not Severity.ERROR for severity, _ in found.values())
    assert found["driver"][0] is Severity.WARNING
    assert "never run against a controller" in found["driver"][1]
    assert found["line load"][1].startswith("26% of every tick at 921600 baud, all joints")
    assert found["joint 0"][1] == "stands at 11.46 deg"


@pytest.mark.parametrize(
    ("press", "subject"),
    [
        (lambda panel: panel.press_hold("pendant"), "pendant hold"),
        (lambda panel: panel.press_hold("external"), "external hold"),
        (lambda panel: panel.raise_alarm(4107), "controller"),
        (lambda panel: setattr(panel, "teach", True), "mode"),
        (lambda panel: setattr(panel, "remote", False), "remote"),
        (lambda panel: setattr(panel, "position_known", False), "position"),
    ],
)
def test_check_finds_what_forbids_motion(press, subject: str) -> None:
    bench = make_bench()
    press(bench.emulator.panel)
    assert findings(bench)[subject][0] is Severity.ERROR


def test_check_warns_of_an_averaging_filter() -> None:
    found = findings(make_bench(settings={"averaging_ticks": 38}))
    assert found["averaging"] == (
        Severity.WARNING,
        "the controller averages the command over 148 ms: fast cycles will fall short of their peak",
    )


def test_check_moves_nothing_and_leaves_servo_power_off() -> None:
    bench = make_bench(axes=2)
    findings(bench)
    assert not bench.emulator.panel.servo_on
    assert bench.emulator.faults.counted["tick"] == 0


# -- cycling ---------------------------------------------------------------------------------------------------------


def cycling(bench: Bench) -> tuple[MotomanDriver, list[SetPoint]]:
    driver = bench.driver()
    driver.open()
    names = list(driver.identify())
    driver.configure(250.0, names[:1])
    driver.start_cycling()
    set_points = [SetPoint(position_rad=START_RAD) for _ in names]
    driver.exchange(set_points)
    for name in names:
        driver.enable(name, Mode.POSITION)
    turn(driver, set_points, 8)
    return driver, set_points


def turn(driver: MotomanDriver, set_points: list[SetPoint], cycles: int) -> list[JointState]:
    states: list[JointState] = []
    for _ in range(cycles):
        driver.clock.wait_until(driver.clock.now_ns() + 4_000_000)
        states = [report.state for report in driver.exchange(set_points)]
    return states


def test_run_time_is_that_of_the_controllers_ticks() -> None:
    bench = make_bench()
    driver = bench.driver()
    driver.open()
    streamed = stream_motion(driver, ticks=50, travel_rad=0.05)
    times = np.array([row[0] for row in streamed.rows])
    assert times[0] >= 0
    assert np.all(np.diff(times) == 4_000_000)
    peak = int(np.argmax([row[1] for row in streamed.rows]))
    # Rows before the motion: first exchange, 6 with the joint enabled; the lead of 4 ticks is not seen in run time.
    assert peak == pytest.approx(1 + 6 + 25 + 4, abs=1)
    driver.close()


def test_the_command_in_force_belongs_to_the_tick_of_the_report() -> None:
    bench = make_bench()
    driver, set_points = cycling(bench)
    commanded: dict[int, float] = {}
    seen = 0
    for k in range(60):
        driver.clock.wait_until(driver.clock.now_ns() + 4_000_000)
        set_points[0].position_rad = START_RAD + 0.0005 * k
        commanded[driver.clock.now_ns()] = set_points[0].position_rad
        (report,) = driver.exchange(set_points)
        if report.t_ns in commanded:
            seen += 1
            assert report.position_command_rad == pytest.approx(commanded[report.t_ns], abs=1e-5)
            assert report.position_rad == pytest.approx(report.position_command_rad, abs=2e-5)
    assert seen > 50
    driver.close()


def test_velocity_and_torque_come_in_joint_units_whatever_the_direction() -> None:
    for direction in (1, -1):
        driver = make_bench(direction=direction).driver()
        driver.open()
        streamed = stream_motion(driver, ticks=100, travel_rad=0.2)
        driver.close()
        rows = np.array(streamed.rows)
        fast = np.abs(rows[:, 2]) > 0.2
        assert rows[:, 2].max() == pytest.approx(math.pi * 0.2 / 0.4, rel=0.02)
        assert rows[fast, 3] == pytest.approx(10 * np.tanh(rows[fast, 2] / 0.01) + 3 * rows[fast, 2], abs=0.02)


def test_states_follow_enable_disable_and_quick_stop() -> None:
    bench = make_bench(axes=2)
    driver, set_points = cycling(bench)
    assert turn(driver, set_points, 1) == [JointState.ENABLED] * 2
    driver.disable("1")
    assert turn(driver, set_points, 1) == [JointState.ENABLED, JointState.DISABLED]
    driver.quick_stop()
    states = turn(driver, set_points, 10)
    assert states[0] is JointState.STOPPING
    driver.stop_cycling()
    driver.close()
    assert not bench.emulator.panel.servo_on
    assert not bench.still_moving()


def test_servo_power_goes_off_only_once_the_arm_stands() -> None:
    bench = make_bench()
    driver, set_points = cycling(bench)
    for k in range(30):
        set_points[0].position_rad = START_RAD + 0.004 * k
        turn(driver, set_points, 1)
    moving_when_cut: list[bool] = []
    power = bench.emulator.panel.power

    def cut(on: bool) -> None:
        assert bench.emulator.stream is not None
        moving_when_cut.append(bench.emulator.stream.moving)
        power(on)

    bench.emulator.panel.power = cut
    driver.close()
    assert moving_when_cut == [False]
    assert not bench.emulator.panel.servo_on


def test_a_stream_on_which_nothing_is_enabled_stays_alive() -> None:
    bench = make_bench()
    driver = bench.driver()
    driver.open()
    driver.configure(250.0, ["0"])
    driver.start_cycling()
    set_points = [SetPoint(position_rad=START_RAD)]
    turn(driver, set_points, 1200)
    assert driver.exchange(set_points)[0].valid
    driver.close()


def test_a_session_is_fed_until_it_is_stopped_also_once_no_joint_is_enabled() -> None:
    bench = make_bench()
    driver, set_points = cycling(bench)
    driver.disable("0")
    turn(driver, set_points, 30)
    driver.stop_cycling()
    # A controller that runs dry takes the host for dead, and leaves a command hold behind.
    assert "command" not in bench.emulator.panel.holds
    driver.close()


def test_a_queue_is_dry_when_little_time_is_left_not_when_few_targets_are() -> None:
    bench = make_bench(lead_ticks=20)
    driver = bench.driver()
    driver.open()
    driver.configure(250.0, ["0"])
    driver.start_cycling()
    set_points = [SetPoint(position_rad=START_RAD)]
    driver.exchange(set_points)
    driver.enable("0", Mode.POSITION)
    turn(driver, set_points, 2)
    stream = bench.emulator.stream
    assert stream is not None and stream.moving
    assert not stream.running_dry
    bench.emulator.advance(bench.emulator.now_s + 19 * 0.004)
    assert stream.running_dry
    driver.close()


def test_a_controller_whose_host_died_comes_back_to_host_control() -> None:
    bench = make_bench()
    cycling(bench)
    bench.emulator.advance(bench.emulator.now_s + 3.0)
    driver, _ = cycling(bench)  # another host: it finds host control, and releases the command hold
    driver.close()


@pytest.mark.parametrize("wish", ["lock", "unlock", "disable"])
def test_a_joint_that_there_is_not_is_refused(wish: str) -> None:
    driver, _ = cycling(make_bench())
    with pytest.raises(InvalidFields, match="no such joint"):
        getattr(driver, wish)("elbow")
    with pytest.raises(InvalidFields, match="no such joint"):
        driver.enable("elbow", Mode.POSITION)
    driver.close()


def test_a_locked_joint_ignores_its_set_point() -> None:
    bench = make_bench(axes=2)
    driver, set_points = cycling(bench)
    driver.lock("1")
    for _ in range(20):
        set_points[1].position_rad += 0.002
        turn(driver, set_points, 1)
    held = driver.exchange(set_points)[1].position_rad
    assert held == pytest.approx(START_RAD, abs=2e-5)
    driver.close()


def test_a_step_is_refused_before_it_is_sent() -> None:
    bench = make_bench()
    driver, set_points = cycling(bench)
    set_points[0].position_rad += 0.1
    with pytest.raises(SafetyAbort, match="too large a step"):
        turn(driver, set_points, 1)
    driver.quick_stop()
    driver.close()
    assert bench.emulator.axes[0].pulses == pytest.approx(START_RAD * math.degrees(1000.0), abs=1)


def test_a_set_point_outside_the_set_limits_is_refused() -> None:
    bench = make_bench()
    driver = bench.driver()
    driver.open()
    driver.set_limits("0", torque_nm=10.0, position_min_rad=0.0, position_max_rad=START_RAD + 0.01)
    with pytest.raises(SafetyAbort, match="leaves the joint's travel"):
        stream_motion(driver, ticks=50, travel_rad=0.05)
    driver.close()
    with pytest.raises(HardwareError, match="the controller allows"):
        driver.set_limits("0", torque_nm=10.0, position_min_rad=-2.0, position_max_rad=2.0)


def test_a_command_hold_left_behind_is_released_when_a_run_begins() -> None:
    bench = make_bench()
    bench.emulator.panel.holds.add("command")
    assert findings(bench)["command hold"][0] is Severity.WARNING
    driver, _ = cycling(bench)
    assert not bench.emulator.panel.holds
    driver.close()


def test_a_rate_other_than_the_ticks_is_refused() -> None:
    driver = make_bench().driver()
    driver.open()
    with pytest.raises(PlanRefused, match="not at 1000 Hz"):
        driver.configure(1000.0, ["0"])
    driver.close()


def test_every_byte_is_offered_to_the_bus_log_in_order() -> None:
    bench = make_bench()
    driver = bench.driver()
    logged: list[tuple[int, bytes, bool]] = []
    driver.open(lambda t_ns, can_id, data, sent: logged.append((t_ns, data, sent)))
    stream_motion(driver)
    driver.close()
    assert logged[0][1:] == (b"\x05", True)
    assert {len(data) for _, data, _ in logged} <= {*range(1, 9), 12, 16, 20, 24, 32, 48, 64}
    heard = b"".join(data for _, data, sent in logged if not sent)
    assert heard.count(b"\xa5\x5a\x12\x1c") > 60
    times = [t_ns for t_ns, _, _ in logged]
    assert max(times) > 200_000_000


# -- one joint at 115200 ---------------------------------------------------------------------------------------------


def narrow(**changes: object) -> Bench:
    return make_bench(axes=6, stream_baud=115200, **changes)


def test_115200_carries_one_joint_at_250_hz_and_keeps_an_eye_on_the_others() -> None:
    bench = narrow()
    assert "the moving joint alone" in findings(bench)["line load"][1]
    driver, set_points = cycling(bench)
    turn(driver, set_points, 20)
    assert bench.emulator.stream is not None
    reports = driver.exchange(set_points)
    assert reports[0].age_cycles <= 1
    assert [report.age_cycles for report in reports[1:]] == [1] * 5
    assert all(report.valid and report.position_rad == pytest.approx(START_RAD, abs=2e-5) for report in reports)
    bench.emulator.axes[3].servo.measured_position_rad += 0.05
    with pytest.raises(SafetyAbort, match="outside this session has moved"):
        turn(driver, set_points, 3)
    driver.close()


def test_57600_carries_none() -> None:
    bench = make_bench(axes=6, stream_baud=57600, settings={"stream_bauds": (57600,)})
    driver = bench.driver()
    driver.open()
    driver.configure(250.0, ["0"])
    with pytest.raises(PlanRefused, match="do not fit"):
        driver.start_cycling()
    driver.close()
    assert not bench.emulator.panel.servo_on


def test_the_pulses_that_a_speed_limiter_drops_are_told() -> None:
    bench = make_bench(faults=["drop@30:40"])
    driver = bench.driver()
    driver.open()
    flags = 0
    exchange = driver.exchange

    def remember(set_points):
        nonlocal flags
        reports = exchange(set_points)
        flags |= reports[0].status_raw >> 16
        return reports

    driver.exchange = remember
    stream_motion(driver)
    driver.close()
    assert flags & 4


def test_closing_twice_and_quick_stopping_a_closed_driver_is_harmless() -> None:
    driver = make_bench().driver()
    driver.quick_stop()
    driver.open()
    driver.close()
    driver.close()
    driver.quick_stop()
    with pytest.raises(HardwareError, match="not open"):
        driver.check(None)


def test_the_import_contracts_name_every_module_of_the_driver() -> None:
    """So that no codec can come to be shared by driver and emulator through a new file."""
    folder = Path(inspect.getfile(MotomanDriver)).parent
    modules = {f"frictid_drivers.motoman.{path.stem}" for path in folder.glob("[!_]*.py")}
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    by_name = {contract["name"]: contract for contract in project["tool"]["importlinter"]["contracts"]}
    shared = by_name["The emulated serial controller shares nothing with the serial driver"]
    assert set(shared["forbidden_modules"]) == modules
    assert set(by_name["The serial driver knows neither its emulator nor the simulation"]["source_modules"]) == modules
