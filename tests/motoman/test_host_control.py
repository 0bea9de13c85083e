"""Layer A against the emulated controller and against scripted bytes: commands, conditions, errors by name."""

from __future__ import annotations

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st
from serial_bench import START_RAD, make_bench

from frictid_drivers.motoman import controller_errors
from frictid_drivers.motoman.bsc import BscTiming, Message, encode_blocks
from frictid_drivers.motoman.controller_errors import (
    AlarmOrError,
    BadReply,
    ControllerError,
    CurrentValueNotMade,
    LinkError,
    NotCommandRemote,
    ServoCannotTurnOn,
    UnknownCommand,
    controller_error,
)
from frictid_drivers.motoman.host_control import PROFILES, HostControl, decode_status
from frictid_hil.errors import HardwareError


class ScriptedPort:
    """Answers what is written with what a transcript says, in virtual time."""

    def __init__(self, *exchanges: tuple[str, str], late: tuple[float, str] | None = None) -> None:
        self.script = [(bytes.fromhex(sent), bytes.fromhex(reply)) for sent, reply in exchanges]
        self.late = late
        self.time_s = 0.0
        self.written = b""
        self.waiting = b""

    def now_s(self) -> float:
        return self.time_s

    def write(self, data: bytes) -> None:
        self.written += data
        while self.script and self.written.startswith(self.script[0][0]):
            sent, reply = self.script.pop(0)
            self.written = self.written[len(sent) :]
            self.waiting += reply

    def read(self, timeout_s: float) -> bytes:
        if not self.waiting and self.late and self.time_s + timeout_s >= self.late[0]:
            self.time_s, self.waiting, self.late = max(self.time_s, self.late[0]), bytes.fromhex(self.late[1]), None
        if not self.waiting:
            self.time_s += timeout_s
        data, self.waiting = self.waiting, b""
        return data

    def set_line(self, baud: int, parity: str) -> None:
        raise AssertionError("host control changes no line settings")

    def reopen(self) -> None:
        raise AssertionError("host control loses no port here")

    def close(self) -> None:
        pass


def asked(text: str, header: str = "01,000") -> str:
    return b"".join(encode_blocks(Message(header, text))).hex()


def answered(text: str, header: str = "90,001") -> tuple[tuple[str, str], ...]:
    """The second half of an exchange: the controller bids, sends, ends."""
    return (("04", "05"), ("1030", asked(text, header)), ("1031", "04"))


def test_rstats_by_the_published_transcript() -> None:
    port = ScriptedPort(
        ("05", "10 30"),
        ("01 30 31 2c 30 30 30 02 52 53 54 41 54 53 0d 03 10 03", "10 31"),
        ("04", "05"),
        ("10 30", "01 39 30 2c 30 30 31 02 31 2c 30 0d 03 c5 01"),
        ("10 31", "04"),
    )
    status = HostControl(port, PROFILES["nx"]).status()
    assert (status.data_1, status.data_2, status.conditions) == (1, 0, frozenset({"step"}))
    assert not port.script


def test_a_refusal_is_an_exception_with_number_and_meaning() -> None:
    port = ScriptedPort(("05", "1030"), (asked("RPOSJ"), "1031"), *answered("3070", "90,000"))
    with pytest.raises(CurrentValueNotMade, match="3070: the current position value is not made") as caught:
        HostControl(port, PROFILES["nx"]).pulses()
    assert (caught.value.number, caught.value.where, caught.value.exit_code) == (3070, "RPOSJ", 3)


@pytest.mark.parametrize(
    "number",
    [1010, 1011, 1012, 1013, 2010, 2020, 2030, 2040, 2050, 2060, 2070, 2080, 2100, 3010, 3040, 3070, 3450, 4040, 5170],
)
def test_every_published_number_has_its_own_class(number: int) -> None:
    error = controller_error(number, where="X")
    assert type(error) is not ControllerError
    assert error.number == number
    assert f"{number}: {error.meaning}" in error.what
    assert error.next_step
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), again.number, str(again)) == (type(error), number, str(error))


def test_an_unpublished_number_is_still_named() -> None:
    error = controller_error(4567, where="X")
    assert type(error) is ControllerError
    assert error.number == 4567
    assert "4567" in error.what
    assert len({kind.number for kind in controller_errors.ControllerError.__subclasses__()}) == 19


def test_pulses_are_stripped_of_spaces() -> None:
    text = "  -1200,     340,0,0, 7,0,0,0,0,0,0,   0"
    port = ScriptedPort(("05", "1030"), (asked("RPOSJ"), "1031"), *answered(text))
    assert HostControl(port, PROFILES["nx"]).pulses()[:5] == [-1200, 340, 0, 0, 7]


@pytest.mark.parametrize("reply", ["1,0", "1,2,x,4,5,6,7,8,9,10,11,12", "", "1;2"])
def test_a_reply_of_another_shape_is_no_position(reply: str) -> None:
    port = ScriptedPort(("05", "1030"), (asked("RPOSJ"), "1031"), *answered(reply))
    with pytest.raises(BadReply, match="12 whole numbers"):
        HostControl(port, PROFILES["nx"]).pulses()


def test_a_late_reply_is_not_taken_for_the_next_command() -> None:
    host_timing = BscTiming()
    port = ScriptedPort(("05", "1030"), (asked("RSTATS"), "1031"), late=(11.0, "05"))
    host = HostControl(port, PROFILES["nx"], host_timing, reply_s=10.0)
    with pytest.raises(LinkError, match="no reply"):
        host.status()
    # The reply to RSTATS comes now, while RPOSJ is wanted: it is heard out and dropped before RPOSJ is sent.
    port.written = b""
    port.script = [
        (b"\x10\x30", bytes.fromhex(asked("1,0", "90,001"))),
        (b"\x10\x31", b"\x04"),
        (b"\x05", b"\x10\x30"),
        (bytes.fromhex(asked("RPOSJ")), b"\x10\x31"),
        *((bytes.fromhex(a), bytes.fromhex(b)) for a, b in answered(",".join(["5"] * 12))),
    ]
    assert host.pulses() == [5] * 12


def test_generations_differ_in_the_bits_of_rstats() -> None:
    nx, erc = decode_status(PROFILES["nx"], 0b11000100, 0b1000010), decode_status(PROFILES["erc"], 0b100, 0b1000010)
    assert nx.conditions == {"auto", "play", "command remote", "pendant hold", "servo on"}
    assert erc.conditions == {"auto", "teach box hold", "servo on"}
    assert nx.reports_mode and not erc.reports_mode
    assert nx.holds == ["pendant hold"] and nx.servo_on and not nx.faulty
    assert decode_status(PROFILES["erc"], 0, 1).holds == ["panel hold"]


def test_everyday_commands_against_the_emulated_controller() -> None:
    bench = make_bench()
    host = bench.host()
    assert not host.status().servo_on
    host.order("SVON 1")
    assert host.status().servo_on
    assert host.pulses()[0] == bench.emulator.axes[0].pulses == round(START_RAD * 57295.77951308232)
    host.order("HOLD 1")
    assert host.status().holds == ["command hold"]
    host.order("HOLD 0")
    bench.emulator.panel.raise_alarm(4107)
    assert host.ask("RALARM").startswith("4107")
    assert host.status().faulty
    with pytest.raises(AlarmOrError):
        host.order("SVON 1")
    host.order("RESET")
    host.order("SVON 1")
    with pytest.raises(UnknownCommand):
        host.order("JWAIT -1")


def test_conditions_of_the_pendant_refuse_by_name() -> None:
    bench = make_bench()
    host = bench.host()
    bench.emulator.panel.servo_blocked = True
    with pytest.raises(ServoCannotTurnOn, match="cannot be turned on"):
        host.order("SVON 1")
    bench.emulator.panel.remote = False
    with pytest.raises(NotCommandRemote):
        host.order("SVON 1")
    bench.emulator.panel.position_known = False
    with pytest.raises(CurrentValueNotMade):
        host.pulses()


def test_a_reading_takes_as_long_as_the_line_is_slow() -> None:
    durations = {}
    for baud in (9600, 19200):
        bench = make_bench(settings={"thinking_s": 0.0}, baud=baud)
        host = bench.host()
        host.pulses()
        durations[baud] = bench.emulator.now_s
    assert durations[9600] == pytest.approx(2 * durations[19200], rel=0.02)
    assert durations[19200] > 0.045


@given(st.binary(max_size=60))
def test_whatever_a_controller_says_ends_in_an_answer_or_in_an_error_of_ours(noise: bytes) -> None:
    port = ScriptedPort(("05", "1030"), (asked("RSTATS"), "1031" + noise.hex()))
    try:
        HostControl(port, PROFILES["nx"]).status()
    except HardwareError as error:
        assert error.what
    assert port.time_s < 200.0
