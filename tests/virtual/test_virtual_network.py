"""NMT, heartbeat both ways, SYNC loss and EMCY: the drive's part in a network, and what it does when that breaks."""

import pytest

HOST = 0x77F
FAULT, QUICK, DISABLED, ENABLED = 0x08, 0x07, 0x40, 0x27


def test_boot_up_and_states_in_the_heartbeat(desk):
    assert desk.heard[0] == (0x705, "00")
    desk.write(0x1017, 0, 100, 2)
    assert desk.wait(99) == []
    assert desk.wait(1) == [(0x705, "7f")]
    desk.send(0x000, "0100")
    assert desk.wait(100) == [(0x705, "05")]
    desk.send(0x000, "0205")
    assert desk.wait(200) == [(0x705, "04")] * 2
    desk.send(0x000, "8005")
    assert desk.wait(100) == [(0x705, "7f")]


def test_commands_for_others_and_garbage_are_ignored(desk):
    for data in ("0106", "0304", "0505", "01", "", "ff05"):
        assert desk.send(0x000, data) == []
        assert desk.servo.nmt_state == 0x7F


def test_reset_communication_restores_1000_to_1fff_only(desk):
    desk.write(0x1017, 0, 100, 2)
    desk.write(0x6065, 0, 77, 4)
    assert desk.send(0x000, "8205") == [(0x705, "00")]
    assert desk.read(0x1017) == 0 and desk.read(0x6065) == 77
    desk.send(0x000, "8105")
    assert desk.read(0x6065) == 100_000


def watched(desk, reaction, timeout_ms=100):
    assert desk.write(0x6007, 0, reaction, 2) == 0
    assert desk.write(0x605A, 0, 6, 2) == 0
    assert desk.write(0x1016, 1, 0x7F << 16 | timeout_ms, 4) == 0
    desk.enable()
    desk.send(0x000, "0105")


@pytest.mark.parametrize(
    ("reaction", "state"), [(0, ENABLED), (1, FAULT), (2, DISABLED), (3, QUICK)], ids=["none", "fault", "off", "stop"]
)
def test_lost_heartbeat_does_what_6007_says(desk, reaction, state):
    watched(desk, reaction)
    assert desk.wait(500) == [], "armed only by the first heartbeat"
    for _ in range(5):
        desk.send(HOST, "05")
        assert desk.wait(90) == []
    assert desk.wait(9) == []
    assert desk.state() == ENABLED
    heard = desk.wait(2)
    assert desk.said(0x085, heard) == ["3081117f00000000"]
    desk.wait(1000)
    assert desk.state() == state
    assert desk.read(0x603F) == 0x8130 and desk.read(0x1001) == 0x11 and desk.read(0x1003, 1) == 0x007F8130
    assert desk.servo.nmt_state == 0x7F, "1029h: pre-operational"


def test_1029_keeps_or_stops_the_network_state(make_desk):
    for behaviour, state in ((0, 0x7F), (1, 0x05), (2, 0x04)):
        desk = make_desk()
        desk.write(0x1029, 1, behaviour, 1)
        watched(desk, 3)
        desk.send(HOST, "05")
        desk.wait(200)
        assert desk.servo.nmt_state == state


def test_a_fault_of_a_lost_heartbeat_needs_a_reset_of_communication_first(desk):
    watched(desk, 1)
    desk.send(HOST, "05")
    desk.wait(200)
    assert desk.state() == FAULT
    assert desk.control(0x80) == FAULT, "the connection comes first"
    desk.control(0)
    desk.send(0x000, "8205")
    assert desk.state() == FAULT
    assert desk.control(0x80) == DISABLED and desk.read(0x603F) == 0
    watched(desk, 1)


def test_no_power_while_a_watched_node_is_missing(desk):
    watched(desk, 2)
    desk.send(HOST, "05")
    desk.wait(200)
    assert desk.state() == DISABLED
    assert [desk.control(word) for word in (6, 7, 15)] == [0x21, 0x23, 0x23]
    assert not desk.plant.powered
    assert desk.read(0x6041) & 0x80, "warning"
    desk.send(HOST, "05")
    assert desk.control(0x07) == 0x23
    assert desk.control(0x0F) == ENABLED


def test_a_long_watchdog_does_not_keep_the_drive_s_own_heartbeat_waiting(desk):
    desk.write(0x1016, 1, 127 << 16 | 600, 4)
    desk.send(HOST, "05")
    desk.write(0x1017, 0, 100, 2)
    assert desk.wait(350) == [(0x705, "7f")] * 3


def test_heartbeat_that_returns_ends_the_error(desk):
    watched(desk, 2)
    desk.send(HOST, "05")
    desk.wait(200)
    assert desk.said(0x085, desk.send(HOST, "05")) == ["0000000000000000"]
    assert desk.read(0x603F) == 0


def test_consumer_entries(desk):
    assert desk.write(0x1016, 1, 0x7F0064, 4) == 0
    assert desk.write(0x1016, 2, 0x7F0064, 4) == 0x06040043, "the same node twice"
    assert desk.write(0x1016, 2, 0x7E0032, 4) == 0
    assert desk.write(0x1016, 2, 0x800032, 4) == 0x06090030, "no such node"
    assert desk.abort_of_read(0x1016, 3) == 0x06090011
    desk.send(0x77E, "05")
    assert desk.said(0x085, desk.wait(60)) == ["3081117e00000000"]


def test_drive_without_1016_has_no_watchdog(make_desk):
    desk = make_desk(missing=(0x1016,))
    assert desk.write(0x1016, 1, 0x7F0064, 4) == 0x06020000
    desk.enable()
    desk.send(HOST, "05")
    desk.wait(1000)
    assert desk.state() == ENABLED


class TestSyncLoss:
    def start(self, desk, reaction=2):
        desk.map_pdo(True, 1, [0x60400010, 0x607A0020], 1)
        desk.write(0x2010, 2, reaction, 1)
        desk.write(0x1006, 0, 1000, 4)
        desk.enable()
        desk.send(0x000, "0105")

    def test_twice_the_period_is_still_on_time(self, desk):
        self.start(desk)
        for _ in range(50):
            desk.cycle(b"\x0f\0\0\0\0\0", 2)
        assert desk.state() == ENABLED

    def test_longer_is_an_alarm_and_a_fault(self, desk):
        self.start(desk)
        desk.cycle(b"\x0f\0\0\0\0\0", 1)
        heard = desk.wait(1.1)
        assert desk.said(0x085, heard) == ["0087110000000000"]
        desk.wait(1000)
        assert desk.state() == FAULT and desk.read(0x603F) == 0x8700

    def test_or_only_a_warning(self, desk):
        self.start(desk, reaction=1)
        desk.sync()
        assert desk.said(0x085, desk.wait(50)) == ["0087110000000000"]
        assert desk.state() == ENABLED and desk.read(0x6041) & 0x80

    def test_warning_ends_when_sync_returns(self, desk):
        self.start(desk, reaction=1)
        desk.sync()
        desk.wait(50)
        assert desk.said(0x085, desk.sync()) == ["0000000000000000"]
        assert desk.said(0x085, desk.wait(50)) == ["0087110000000000"], "and is supervised again"

    def test_not_before_the_first_sync_nor_when_off(self, desk):
        self.start(desk)
        assert desk.wait(100) == []
        desk.sync()
        desk.control(0)
        assert desk.wait(100) == []


@pytest.mark.parametrize("command", ["0205", "8005", "8105", "8205"])
def test_leaving_operational_with_power_takes_it_away(desk, command):
    desk.write(0x6007, 0, 2, 2)
    desk.enable()
    desk.send(0x000, "0105")
    desk.send(0x000, command)
    desk.wait(100)
    assert not desk.plant.powered and desk.plant.braked


def test_history_holds_eight_newest_first_and_is_cleared(desk):
    for code in range(0x5001, 0x500B):
        desk.servo.warn(code, desk.rack.now_ns)
    assert desk.read(0x1003) == 8
    assert [desk.read(0x1003, sub) for sub in (1, 2, 8)] == [0x500A, 0x5009, 0x5003]
    desk.write(0x1003, 0, 0, 1)
    assert desk.read(0x1003) == 0 and desk.abort_of_read(0x1003, 1) == 0x06090011


def test_emcy_frames_come_and_go(desk):
    desk.heard.clear()
    desk.servo.warn(0x4210, desk.rack.now_ns)
    assert desk.heard == [(0x085, "1042090000000000")]
    assert desk.control(0x80) == DISABLED
    assert (0x085, "0000000000000000") in desk.heard or desk.read(0x1001) == 0
    desk.send(0x000, "0205")
    desk.heard.clear()
    desk.servo.warn(0x4210, desk.rack.now_ns)
    assert desk.heard == [], "stopped: no EMCY"


@pytest.mark.parametrize(
    ("code", "register"),
    [(0x2310, 0x03), (0x3210, 0x05), (0x4310, 0x09), (0x8130, 0x11), (0x8611, 0x21), (0x7305, 0x21), (0xFF01, 0x81)],
)
def test_error_register_bit_per_class(desk, code, register):
    desk.servo.warn(code, desk.rack.now_ns)
    assert desk.read(0x1001) == register
