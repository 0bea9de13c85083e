"""The driver and the simulated HP3J together: 1 kHz, one joint moving, five locked, quick stop, replay."""

from __future__ import annotations

import math

import pytest
from cia402_bench import hp3j

from frictid_drivers.cia402 import FrameMap
from frictid_drivers.cia402.logs import LogDecoder
from frictid_drivers.virtual import VirtualDriver
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import JointState, SetPoint, Severity


class Session:
    """The virtual robot and a loop in lock-step."""

    def __init__(self, setup):
        self.setup = setup
        self.driver = VirtualDriver(setup)
        self.set_points = [SetPoint() for _ in setup.joints]
        self.log = []
        self.driver.open(lambda t_ns, can_id, data, sent: self.log.append((t_ns, can_id, data)))

    def start(self, *active):
        self.driver.configure(1000.0, list(active))
        for joint in self.setup.joints:
            self.driver.set_limits(
                joint.name,
                torque_nm=joint.max_torque_nm,
                position_min_rad=joint.position_min_rad,
                position_max_rad=joint.position_max_rad,
            )
        self.driver.start_cycling()
        self.deadline_ns = 0

    def cycle(self, count=1):
        for _ in range(count):
            self.deadline_ns += 1_000_000
            self.driver.clock.wait_until(self.deadline_ns)
            self.feedback = self.driver.exchange(self.set_points)
        return self.feedback

    def take_positions(self):
        for set_point, report in zip(self.set_points, self.feedback, strict=True):
            set_point.position_rad = report.position_rad

    def power(self, *modes):
        self.cycle(120)
        self.take_positions()
        for joint, mode in zip(self.setup.joints, modes or [Mode.POSITION] * 6, strict=True):
            self.driver.enable(joint.name, mode)
        for _ in range(300):
            if all(report.state is JointState.ENABLED for report in self.cycle()):
                break
        assert [report.state for report in self.feedback] == [JointState.ENABLED] * 6
        self.take_positions()


@pytest.fixture
def session():
    made = Session(hp3j())
    yield made
    made.driver.close()


def test_reads_only_and_nothing_to_complain_about(session):
    identities = session.driver.identify()
    findings = session.driver.check(None)
    assert {finding.severity for finding in findings} == {Severity.OK}, findings
    assert len({identity.serial for identity in identities.values()}) == 6
    for joint in session.setup.joints:
        identity = identities[joint.name]
        assert identity.rated_torque_nm == pytest.approx(joint.rated_torque_nm, rel=0.01)
        assert identity.position_resolution_rad == pytest.approx(2 * math.pi / (131072 * joint.gear_ratio))
        assert identity.timing.source == "drive"
    capabilities = session.driver.capabilities()
    assert capabilities.lock_step and capabilities.drive_watchdog and capabilities.torque_offset
    assert capabilities.max_cycle_hz >= 1000


@pytest.mark.slow
def test_one_joint_moves_by_a_cosine_and_five_stand(session):
    session.start("1")
    session.power()
    for joint in "02345":
        session.driver.lock(joint)
    session.cycle(100)
    held = [report.position_rad for report in session.feedback]
    start_rad = session.set_points[1].position_rad
    for cycle in range(1000):
        session.set_points[1].position_rad = start_rad + 0.1 * (1 - math.cos(2 * math.pi * cycle / 1000))
        feedback = session.cycle()
        assert feedback[1].age_cycles == 0 and feedback[1].t_ns == session.deadline_ns
        assert abs(feedback[1].position_rad - session.set_points[1].position_rad) < 0.01
        assert abs(feedback[1].velocity_rad_s) < 0.8
        for at, report in enumerate(feedback):
            assert report.age_cycles < 10 and report.error_code == 0
            if at != 1:
                assert abs(report.position_rad - held[at]) < math.radians(0.25)
    assert max(report.torque_nm for report in feedback) > 1.0


def test_quick_stop_in_full_motion(session):
    session.start("0")
    session.power()
    start_rad = session.set_points[0].position_rad
    for cycle in range(250):
        session.set_points[0].position_rad = start_rad + 0.2 * (1 - math.cos(2 * math.pi * cycle / 1000))
        session.cycle()
    assert session.feedback[0].velocity_rad_s > 1.0
    session.driver.quick_stop()
    session.cycle(200)
    assert all(report.state is JointState.STOPPING for report in session.feedback)
    assert all(abs(report.velocity_rad_s) < 0.02 for report in session.feedback)
    session.driver.stop_cycling()
    # All is well again: the next joint can have its turn.
    session.start("1")
    session.power()


def test_torque_mode_from_position_mode_without_a_fall(session):
    """Joint 1 carries gravity: the torque must be there in the cycle in which the mode changes."""
    session.start("1")
    session.power()
    session.cycle(200)
    hold_nm = sum(session.cycle()[1].torque_nm for _ in range(50)) / 50
    here_rad = session.feedback[1].position_rad
    assert abs(hold_nm) > 10
    session.set_points[1].torque_nm = hold_nm
    session.driver.enable("1", Mode.TORQUE)
    session.cycle(100)
    assert session.feedback[1].mode is Mode.TORQUE and session.feedback[1].state is JointState.ENABLED
    assert abs(session.feedback[1].position_rad - here_rad) < math.radians(0.5)
    session.set_points[1].position_rad = session.feedback[1].position_rad
    session.driver.enable("1", Mode.POSITION)
    session.cycle(100)
    assert session.feedback[1].mode is Mode.POSITION and session.feedback[1].state is JointState.ENABLED
    assert abs(session.feedback[1].position_rad - here_rad) < math.radians(0.5)


def test_force_sensor_and_temperature_where_the_robot_file_maps_them():
    session = Session(
        hp3j(
            options={
                "external_torque_object": "2030:00 i32",
                "external_torque_nm_per_unit": 0.001,
                "temperature_object": "2031:00 i16",
                "temperature_c_per_unit": 0.1,
            }
        )
    )
    try:
        assert session.driver.capabilities().external_torque and session.driver.capabilities().temperature
        session.start("1")
        session.cycle(20)
        assert math.isfinite(session.feedback[1].external_torque_nm)
        assert 0 < session.feedback[1].temperature_c < 60
    finally:
        session.driver.close()


@pytest.mark.slow
def test_two_runs_are_bit_identical_and_the_log_replays_to_the_same_rows():
    def run():
        session = Session(hp3j())
        live = []
        try:
            session.start("2")
            session.power()
            start_rad = session.set_points[2].position_rad
            for cycle in range(300):
                session.set_points[2].position_rad = start_rad + 0.05 * (1 - math.cos(2 * math.pi * cycle / 300))
                session.cycle()
                live.append([repr(report) for report in session.feedback])
            mapping = session.driver._host.frame_map().to_mapping()
            first_ns = session.deadline_ns - 299_000_000
        finally:
            session.driver.close()
        return live, session.log, mapping, first_ns

    (live, log, mapping, first_ns), (again, log_again, *_) = run(), run()
    assert live == again and log == log_again
    replayed = {
        row.t_ns: [repr(report) for report in row.feedback]
        for row in LogDecoder(FrameMap.from_mapping(mapping)).rows(log)
    }
    assert len(replayed) == sum(row.t_ns >= 0 for row in LogDecoder(FrameMap.from_mapping(mapping)).rows(log))
    assert [replayed[first_ns + 1_000_000 * cycle] for cycle in range(300)] == live
