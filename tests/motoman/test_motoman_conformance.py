"""The serial driver, streaming, passes the suite that we give to others, but for the power of single joints."""

from __future__ import annotations

import pytest
import serial_bench

from frictid_drivers.motoman import MotomanDriver
from frictid_hil.protocol.driver import Driver
from frictid_hil.protocol.frames import LogDecoder
from frictid_hil.testing.driver_conformance import CHECKS, Truth, switches_on_without_a_jump


class Deaf(serial_bench.LoopbackPort):
    """A port whose way to the host can be cut."""

    silent = False

    def read(self, timeout_s: float) -> bytes:
        data = super().read(timeout_s)
        return b"" if self.silent else data


class StreamBench:
    def __init__(self) -> None:
        self.setup = self._made().setup

    @staticmethod
    def _made() -> serial_bench.Bench:
        return serial_bench.make_bench(axes=2)

    def driver(self) -> Driver:
        made = self._made()
        self.emulator = made.emulator

        def opened(path: str, baud: int, parity: str) -> Deaf:
            self.port = Deaf(made.emulator, baud, parity)
            return self.port

        return MotomanDriver(self.setup, port_factory=opened)

    def truth(self, joint: str) -> Truth:
        axis = self.emulator.axes[self.setup.joint(joint).address]
        servo = axis.servo
        return Truth(servo.measured_position_rad, servo.velocity_rad_s, servo.torque_nm, servo.powered)

    def silence(self, silent: bool) -> None:
        self.port.silent = silent

    def decoder(self, driver: Driver) -> LogDecoder | None:
        return None


ONE_POWER_FOR_ALL = "the controller has one servo power for all axes: it goes off when the stream ends"


@pytest.mark.parametrize("check", [check for check in CHECKS if check is not switches_on_without_a_jump])
def test_conforms(check):
    check(StreamBench())


@pytest.mark.xfail(strict=True, reason=ONE_POWER_FOR_ALL, raises=AssertionError)
def test_a_single_joint_cannot_be_switched_off():
    switches_on_without_a_jump(StreamBench())
