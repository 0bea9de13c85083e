"""Every exchange of the pages for controller-side authors is what driver and emulator really exchange.

``python tests/motoman/test_controller_application_page.py`` writes the file of exchanges anew.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serial_bench import make_bench

from frictid_drivers.motoman import stream_frames as frames
from frictid_drivers.motoman.batch import BatchClient, JobOrder, friction_table
from frictid_drivers.motoman.controller_errors import ControllerError
from frictid_drivers.motoman.emulator.build import _DEFAULTS as EMULATOR_OPTIONS
from frictid_drivers.motoman.emulator.faults import OCCASIONS
from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_drivers.motoman.emulator.streaming import StreamApplication
from frictid_drivers.motoman.host_control import PROFILES, HostControl
from frictid_drivers.motoman.joint_units import axis_units
from frictid_drivers.motoman.settings import SerialOptions
from frictid_hil.friction.curve import FrictionCurve

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"
PAGES = [REFERENCE / f"motoman-{name}.md" for name in ("controller-application", "batch", "streaming")]
EXCHANGES = REFERENCE / "motoman-exchanges.txt"

ORDER = JobOrder(
    number=7,
    axis=0,
    start=11459,
    lowest=-57296,
    highest=57296,
    step=756,
    torque_micro=500_000,
    watchdog_ticks=1250,
    segments=("H:5", "C:2000:40:20", "L:10:11559", "M:10:11459", "H:5"),
)
CURVE = FrictionCurve.through(np.linspace(0.2, 2.0, 10), 5.0 + np.linspace(0.2, 2.0, 10))


def lines(portions: list[tuple[bytes, bool]]) -> str:
    """One line per utterance."""
    return "".join(f"{'H>C' if ours else 'C>H'} {data.hex(' ')}\n" for data, ours in portions)


class Wire:
    """A host on an emulated controller whose every utterance is written down."""

    def __init__(self) -> None:
        self.bench = make_bench()
        self.portions: list[tuple[bytes, bool]] = []
        self.host = HostControl(
            self.bench.port("loopback", *self.bench.emulator.line),
            PROFILES["nx"],
            sink=lambda data, ours: self.portions.append((data, ours)),
        )
        self.client = BatchClient(self.host)

    def written(self, action: Callable[[], object]) -> str:
        self.host.listen(0.05)
        self.portions.clear()
        action()
        self.host.listen(0.05)
        return lines(self.portions)


def batch_examples() -> dict[str, str]:
    wire = Wire()
    client, host, emulator = wire.client, wire.host, wire.bench.emulator

    def refused() -> None:
        with pytest.raises(ControllerError):
            host.order("FRUN 1,8")

    def asked(text: str) -> str:
        return wire.written(lambda: host.ask(text))

    made = {"FHELLO": asked("FHELLO 1"), "FREAD-known": wire.written(client._reads_while_running)}
    made |= {"FJOB": wire.written(lambda: client.send(ORDER))}
    host.order("SVON 1")
    made["FRUN"] = wire.written(lambda: client.start(7))
    emulator.advance(emulator.now_s + 2.0)
    made["FRUN-refused"] = wire.written(refused)
    made["FSTAT"] = wire.written(lambda: client.state(7))
    made["FREAD"] = asked("FREAD 1,7,40,2")
    made["FREAD-long"] = asked("FREAD 1,7,0,36")
    made["FREAD-2"] = asked("FREAD 2,7,40,2")
    made["FSTOP"] = wire.written(lambda: client.stop(7))
    units = axis_units(wire.bench.setup.joints)["0"]
    table = friction_table(units, CURVE, 0.9, 8000.0, 4.0, 0.0)
    made["FTABLE"] = wire.written(lambda: host.order(f"FTABLE 1,{table}"))
    made["FTABLE-raw"] = base64.b64decode(table).hex(" ") + "\n"
    made["FTREAD"] = asked("FTREAD 1,0")
    made["FCOMP"] = wire.written(lambda: client.compensate(1))
    made["FSTREAM"] = wire.written(lambda: host.order("FSTREAM 1,921600,4000,1"))
    for name in ("FREAD", "FREAD-2"):
        reply = re.search(r"C>H 01 39 30 2c 30 30 31 02 (.*?) 0d 03", made[name])
        assert reply
        made[f"{name}-raw"] = base64.b64decode(bytes.fromhex(reply[1])).hex(" ") + "\n"
    return made


def stream_examples() -> dict[str, str]:
    emulator: Emulator = make_bench(axes=2).emulator
    emulator.panel.power(True)
    said: list[bytes] = []
    app = StreamApplication(emulator.panel, 3, lambda kind, frame: said.append(frame), lambda: None)

    def exchanged(frame: bytes, *, ticks: int = 0) -> str:
        said.clear()
        if frame:
            app.hear(frame)
        for _ in range(ticks):
            app.tick(0)
        return lines([*([(frame, True)] if frame else []), *((data, False) for data in said)])

    # The published set-point: session 7, due at tick 100, 500 pulses.
    servo: Any = emulator.axes[0].servo
    servo.measured_position_rad = 480 / emulator.axes[0].plate.pulses_per_rad
    emulator.axes[0].issued = 480
    app.tick_number = 90
    made = {
        "HELLO": exchanged(frames.encode_hello(0, 7, 1)),
        "FEEDBACK": exchanged(b"", ticks=1),
        "SETPOINT": exchanged(frames.encode_set_point(1, 7, 1, 100, [500]), ticks=1),
        "SETPOINT-torque": exchanged(frames.encode_set_point(2, 7, 1, 101, [520], [-120])),
        "NACK-limit": exchanged(frames.encode_set_point(3, 7, 1, 102, [60000])),
        "NACK-late": exchanged(frames.encode_set_point(4, 7, 1, 93, [500])),
        "NACK-crc": exchanged(frames.encode_set_point(5, 7, 1, 102, [540])[:-1] + b"\x00"),
        "STOP": exchanged(frames.encode_stop(6, 7, leave=True)),
        "HELLO-two": exchanged(frames.encode_hello(0, 8, 3)),
    }
    made["SETPOINT-two"] = exchanged(frames.encode_set_point(1, 8, 3, 99, [480, 11459]), ticks=1)
    return made


def examples() -> dict[str, str]:
    """Every example by name."""
    return {**batch_examples(), **stream_examples()}


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    return examples()


@pytest.fixture(scope="module")
def text() -> str:
    """The three pages."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def test_the_file_of_exchanges_is_what_the_code_does(made: dict[str, str]) -> None:
    shown = dict(re.findall(r"^# (\S+)\n([^#]*)", EXCHANGES.read_text(encoding="utf-8"), re.MULTILINE))
    assert {name: lines.strip() for name, lines in shown.items()} == {
        name: lines.strip() for name, lines in made.items()
    }


def test_every_exchange_is_named_on_the_pages(made: dict[str, str], text: str) -> None:
    for name in made:
        assert f"`{name}`" in text, name


def test_every_command_and_frame_of_the_code_is_on_the_pages(text: str) -> None:
    emulator = make_bench().emulator
    for command in emulator.batch._commands:
        assert f"### {command}" in text
    for kind in frames.FrameType:
        assert f"### {kind.name.replace('_', '')} ({kind.value})" in text
    for refusal in frames.Refusal:
        assert re.search(rf"\| {refusal.value} \|", text)
    for flag in frames.Flag:
        assert re.search(rf"\| {flag.value} \|", text)


def test_every_option_and_fault_is_on_the_page_of_settings() -> None:
    text = (REFERENCE / "serial-settings.md").read_text(encoding="utf-8")
    for name in [*OCCASIONS, *EMULATOR_OPTIONS, *(entry.name for entry in fields(SerialOptions))]:
        assert f"`{name}`" in text, name


def test_the_pages_say_what_was_never_tested(text: str) -> None:
    assert "never been run on a controller" in text


if __name__ == "__main__":
    EXCHANGES.write_text("\n".join(f"# {name}\n{said}" for name, said in examples().items()), encoding="utf-8")
