"""Host time of one CiA-402 exchange in lock-step, simulated drives not counted, against canopen's own PDO variables.

Run: python benchmarks/cia402_exchange.py
"""

from __future__ import annotations

import math
import os
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any

import can
import canopen
from canopen.objectdictionary import ODVariable

from frictid_drivers.virtual import VirtualDriver
from frictid_hil.config.robot import load_robot
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint

CYCLES = 4000


def exchange_us(active: list[str], cycle_hz: float) -> tuple[float, float]:
    """Host and drive time per exchange, microseconds."""
    setup = load_robot("hp3j.yaml").to_setup(f"virtual:benchmark-{os.getpid()}")
    driver = VirtualDriver(setup)
    driver.open(lambda *frame: None)
    try:
        bus: Any = driver._host._bus  # the one place where the drives' own time can be told apart
        inner, spent = bus.send, [0]

        def send(message: can.Message, timeout: float | None = None) -> None:
            begin = time.perf_counter_ns()
            inner(message, timeout)
            spent[0] += time.perf_counter_ns() - begin

        bus.send = send
        driver.configure(cycle_hz, active)
        driver.start_cycling()
        set_points = [SetPoint() for _ in setup.joints]
        period_ns = round(1e9 / cycle_hz)
        deadline_ns = 0

        def cycle() -> Sequence[Feedback]:
            nonlocal deadline_ns
            deadline_ns += period_ns
            driver.clock.wait_until(deadline_ns)
            return driver.exchange(set_points)

        for _ in range(round(0.2 * cycle_hz)):
            feedback = cycle()
        for joint in setup.joints:
            driver.enable(joint.name, Mode.POSITION)
        while not all(report.state is JointState.ENABLED for report in feedback):
            feedback = cycle()
        starts = [report.position_rad for report in feedback]
        for joint in setup.joints:
            if joint.name not in active:
                driver.lock(joint.name)
        spent[0] = total = 0
        for step in range(CYCLES):
            for at, joint in enumerate(setup.joints):
                wave = 0.05 * (1 - math.cos(2 * math.pi * step / CYCLES)) if joint.name in active else 0.0
                set_points[at].position_rad = starts[at] + wave
            deadline_ns += period_ns
            driver.clock.wait_until(deadline_ns)
            begin = time.perf_counter_ns()
            driver.exchange(set_points)
            total += time.perf_counter_ns() - begin
        return (total - spent[0]) / CYCLES / 1e3, spent[0] / CYCLES / 1e3
    finally:
        driver.close()


def codec_ratio() -> float:
    """Time of writing three mapped values by canopen's variables, in units of one struct packing."""
    dictionary: Any = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]  # canopen is only partly typed
    for index, kind in ((0x6040, 6), (0x607A, 4), (0x60B2, 3)):
        variable = ODVariable(f"{index:04X}", index)
        variable.data_type = kind
        dictionary.add_object(variable)
    node = canopen.RemoteNode(1, dictionary)
    frame: Any = canopen.pdo.base.PdoMap(node.rpdo, None, None)  # type: ignore[no-untyped-call]  # the same
    variables = [frame.add_variable(index) for index in (0x6040, 0x607A, 0x60B2)]
    buffer, pack = bytearray(8), struct.Struct("<Hih").pack_into

    def timed(action: Callable[[], object]) -> float:
        begin = time.perf_counter_ns()
        for _ in range(20_000):
            action()
        return time.perf_counter_ns() - begin

    def by_variables() -> None:
        for variable in variables:
            variable.raw = 7

    return timed(by_variables) / timed(lambda: pack(buffer, 0, 7, 7, 7))


if __name__ == "__main__":
    for active, cycle_hz in ((["1"], 1000.0), (list("012345"), 250.0)):
        host, drives = exchange_us(active, cycle_hz)
        print(
            f"{len(active)} active at {cycle_hz:g} Hz: host {host:.1f} us, simulated drives {drives:.1f} us per "
            f"exchange; host share of the period {host * cycle_hz / 1e4:.2f} %"
        )
    print(f"canopen PDO variables take {codec_ratio():.0f} times as long as the struct codec")
