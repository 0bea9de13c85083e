"""Our own drivers pass the suite that we give to others."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import pytest

from frictid_drivers.mit.driver import MitDriver
from frictid_drivers.mit.logs import decoder as mit_decoder
from frictid_drivers.mit.simulated import Rack
from frictid_drivers.servos.driver import ServoDriver
from frictid_drivers.servos.logs import decoder as servo_decoder
from frictid_drivers.servos.simulated import Chain
from frictid_drivers.virtual.driver import VirtualDriver
from frictid_hil.config.robot import load_robot
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Driver
from frictid_hil.protocol.frames import LogDecoder, frame_decoders
from frictid_hil.testing.driver_conformance import Bench, DriverConformance, Truth
from frictid_hil.testing.wire import FakeCanBus, ManualClock

_NUMBERS = count()


class MitBench:
    def __init__(self, setup: RobotSetup) -> None:
        self.setup = setup

    def driver(self) -> Driver:
        self.rack = rack = Rack(self.setup)
        clock = ManualClock(rack.advance)
        self.bus = bus = FakeCanBus(rack, clock)
        return MitDriver(self.setup, bus_factory=lambda: bus, clock=clock)

    def truth(self, joint: str) -> Truth:
        actuator = self.rack.actuators[joint]
        plant = actuator.plant
        torque_nm = plant.torque_nm if actuator.on else 0.0
        return Truth(plant.position_rad, plant.true_velocity_rad_s, torque_nm, actuator.on)

    def silence(self, silent: bool) -> None:
        self.bus.fault = (lambda frame, to_host: [] if to_host else [frame]) if silent else None

    def decoder(self, driver: Driver) -> LogDecoder | None:
        assert isinstance(driver, MitDriver)
        return mit_decoder(driver.frame_map_values())


class ServoBench:
    def __init__(self, setup: RobotSetup) -> None:
        self.setup = setup

    def driver(self) -> Driver:
        self.chain = chain = Chain(self.setup)
        chain.clock = clock = ManualClock(chain.advance)
        return ServoDriver(self.setup, port_factory=lambda: chain, clock=clock)

    def truth(self, joint: str) -> Truth:
        servo = self.chain.servos[joint]
        torque_nm = servo.plant.torque_nm if servo.on else 0.0
        return Truth(servo.plant.position_rad, servo.plant.true_velocity_rad_s, torque_nm, servo.on)

    def silence(self, silent: bool) -> None:
        self.chain.fault = (lambda data, to_host: b"" if to_host else data) if silent else None

    def decoder(self, driver: Driver) -> LogDecoder | None:
        assert isinstance(driver, ServoDriver)
        return servo_decoder(driver.frame_map_values())


class CanopenBench:
    """The ``virtual`` driver is the ``cia402`` one in front of simulated drives: both at once."""

    def __init__(self, setup: RobotSetup) -> None:
        self.setup = setup

    def driver(self) -> Driver:
        self.newest = VirtualDriver(replace(self.setup, bus=f"virtual:conformance{next(_NUMBERS)}"))
        return self.newest

    def truth(self, joint: str) -> Truth:
        servo = self.newest._rack.servos.get(joint)
        if servo is None:
            return Truth(0.0, 0.0, 0.0, False)
        plant: Any = servo._plant
        return Truth(plant.position_rad, plant.true_velocity_rad_s, plant.torque_nm, servo.axis.powered)

    def silence(self, silent: bool) -> None:
        self.newest._drives.transmit = (lambda can_id, data: None) if silent else self.newest._host._bus._deliver

    def decoder(self, driver: Driver) -> LogDecoder | None:
        assert isinstance(driver, VirtualDriver)
        values = driver.frame_map_values()
        return frame_decoders(str(values["schema"])).decoder(values)


def _mit(options: dict[str, object]) -> Bench:
    setup = load_robot("mit-bench.yaml").to_setup()
    first = replace(setup.joints[0], options={**setup.joints[0].options, **options})
    second = replace(first, name="1", address=2, direction=-1)
    return MitBench(replace(setup, cycle_hz=400.0, joints=(first, second)))


class TestDamiao(DriverConformance):
    @pytest.fixture
    def bench(self) -> Bench:
        return _mit({})


class TestRobStride(DriverConformance):
    @pytest.fixture
    def bench(self) -> Bench:
        return _mit({"model": "RS00"})


class TestCubeMars(DriverConformance):
    @pytest.fixture
    def bench(self) -> Bench:
        return _mit({"model": "AK80-9"})


def _servos(model: str, zero: int = 2048) -> Bench:
    setup = load_robot("so101.yaml").to_setup()
    options = {"model": model, "zero_counts": zero}
    joints = (replace(setup.joints[0], options=options), replace(setup.joints[4], options=options, direction=-1))
    return ServoBench(replace(setup, joints=joints))


class TestFeetech(DriverConformance):
    @pytest.fixture
    def bench(self) -> Bench:
        return _servos("STS3215")


class TestDynamixel(DriverConformance):
    @pytest.fixture
    def bench(self) -> Bench:
        return _servos("XM430-W350")


class TestCia402(DriverConformance):
    @pytest.fixture
    def bench(self) -> Bench:
        setup = load_robot("hp3j.yaml").to_setup()
        return CanopenBench(
            replace(setup, cycle_hz=500.0, joints=(setup.joints[3], replace(setup.joints[5], direction=-1)))
        )
