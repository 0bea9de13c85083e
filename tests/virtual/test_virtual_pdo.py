"""PDOs at the wire: mapping protocol and aborts, every transmission type, SYNC counter, inhibit, event timer."""

import struct

import pytest

from frictid_hil.protocol.driver import FD_FRAME

CONTROL, MODE, TARGET, OFFSET = 0x60400010, 0x60600008, 0x607A0020, 0x60B20010
STATUS, POSITION, TORQUE, DISPLAY, ERROR = 0x60410010, 0x60640020, 0x60770010, 0x60610008, 0x603F0010


def operational(desk):
    return desk.send(0x000, "0105")


class TestCanFd:
    """2023h: PDOs of one kind only; everything else stays classical."""

    def test_only_with_it_more_than_8_bytes_are_mapped(self, desk):
        for sub in (1, 2, 3):
            desk.write(0x1A00, sub, POSITION, 4)
        assert desk.write(0x1A00, 0, 3, 1) == 0x06040042
        assert desk.write(0x2023, 0, 1, 1) == 0
        assert desk.write(0x1A00, 0, 3, 1) == 0
        assert desk.write(0x2023, 0, 2, 1) == 0x06090031

    def test_reports_are_padded_to_a_length_that_there_is(self, desk):
        desk.write(0x2023, 0, 1, 1)
        desk.map_pdo(False, 1, [POSITION, POSITION, STATUS], 1)
        desk.map_pdo(False, 2, [POSITION, POSITION, POSITION, POSITION, STATUS], 1)
        desk.map_pdo(False, 3, [STATUS], 1)
        operational(desk)
        said = {can_id: len(bytes.fromhex(data)) for can_id, data in desk.sync()}
        assert said == {0x185 | FD_FRAME: 12, 0x285 | FD_FRAME: 20, 0x385 | FD_FRAME: 2}

    def test_commands_of_the_other_kind_are_not_heard(self, desk):
        desk.map_pdo(True, 1, [CONTROL, MODE], 255)
        operational(desk)
        desk.send(0x205 | FD_FRAME, "0600 09")
        assert desk.read(0x6061) == 0
        desk.send(0x205, "0600 08")
        assert desk.read(0x6061) == 8
        desk.send(0x000, "8005")
        desk.write(0x2023, 0, 1, 1)
        operational(desk)
        desk.send(0x205, "0600 09")
        assert desk.read(0x6061) == 8
        desk.send(0x205 | FD_FRAME, "0600 09")
        assert desk.read(0x6061) == 9

    def test_long_pdos_fall_silent_without_it(self, desk):
        desk.write(0x2023, 0, 1, 1)
        desk.map_pdo(False, 1, [POSITION, POSITION, STATUS], 1)
        desk.write(0x2023, 0, 0, 1)
        operational(desk)
        assert desk.sync() == []


class TestMapping:
    def test_round_trip(self, desk):
        desk.map_pdo(False, 1, [STATUS, POSITION, TORQUE], 1, inhibit=25, timer=100, start=3)
        assert desk.read(0x1800, 1) == 0x185
        assert [desk.read(0x1800, sub) for sub in (2, 3, 5, 6)] == [1, 25, 100, 3]
        assert [desk.read(0x1A00, sub) for sub in range(4)] == [3, STATUS, POSITION, TORQUE]

    def test_nothing_changes_while_valid(self, desk):
        desk.map_pdo(False, 1, [STATUS], 1)
        assert desk.write(0x1A00, 0, 0, 1) == 0x08000022
        assert desk.write(0x1A00, 1, POSITION, 4) == 0x08000022
        assert desk.write(0x1800, 1, 0x186, 4) == 0x08000022
        assert desk.write(0x1800, 3, 10, 2) == 0x08000022
        assert desk.write(0x1800, 6, 10, 1) == 0x08000022
        assert desk.write(0x1800, 2, 10, 1) == 0, "the transmission type may"

    def test_entries_only_while_the_count_is_zero(self, desk):
        desk.map_pdo(False, 1, [STATUS], 1)
        desk.write(0x1800, 1, 0x80000185, 4)
        assert desk.write(0x1A00, 1, POSITION, 4) == 0x08000022
        assert desk.write(0x1A00, 0, 0, 1) == 0
        assert desk.write(0x1A00, 1, POSITION, 4) == 0

    @pytest.mark.parametrize(
        ("receive", "entry", "code"),
        [
            (False, 0x60400010, 0x06040041),  # controlword is for RPDOs
            (True, 0x60410010, 0x06040041),  # statusword for TPDOs
            (False, 0x60650020, 0x06040041),  # not mappable at all
            (False, 0x70000010, 0x06020000),  # no such object
            (False, 0x60410110, 0x06090011),  # no such subindex
            (False, 0x60410020, 0x06040043),  # wrong length
            (False, 0x00050008, 0x06040041),  # dummies are for RPDOs
        ],
    )
    def test_refused_entries(self, desk, receive, entry, code):
        index = 0x1600 if receive else 0x1A00
        assert desk.write(index, 1, entry, 4) == code

    def test_too_long_or_empty_entries_refuse_the_count(self, desk):
        for sub in (1, 2, 3):
            desk.write(0x1A00, sub, POSITION, 4)
        assert desk.write(0x1A00, 0, 3, 1) == 0x06040042
        assert desk.write(0x1A00, 0, 4, 1) == 0x06020000
        assert desk.write(0x1A00, 0, 9, 1) == 0x06090031
        assert desk.write(0x1A00, 0, 2, 1) == 0

    @pytest.mark.parametrize("cob_id", [0x000, 0x001, 0x080, 0x101, 0x585, 0x605, 0x701, 0x7FF, 0x20000185, 0x1ABCDE])
    def test_restricted_cob_ids(self, desk, cob_id):
        assert desk.write(0x1800, 1, 0x80000000 | cob_id, 4) == 0x06090030

    @pytest.mark.parametrize("kind", [241, 250, 252, 253])
    def test_refused_transmission_types(self, desk, kind):
        assert desk.write(0x1800, 2, kind, 1) == 0x06090030

    def test_dummy_entries_leave_gaps_in_an_rpdo(self, desk):
        desk.map_pdo(True, 1, [CONTROL, 0x00060010, MODE], 255)
        operational(desk)
        desk.send(0x205, "0600 ffff 09")
        assert desk.read(0x6040) == 6 and desk.read(0x6061) == 9


class TestSynchronous:
    def test_rpdo_counts_from_the_next_sync_and_tpdo_reports_before_it(self, desk):
        desk.map_pdo(True, 1, [CONTROL], 1)
        desk.map_pdo(False, 1, [STATUS], 1)
        operational(desk)
        assert desk.send(0x205, "0600") == []
        assert desk.read(0x6041) & 0x6F == 0x40
        assert desk.sync() == [(0x185, "5002")]
        assert desk.read(0x6041) & 0x6F == 0x21
        assert desk.sync() == [(0x185, "3102")]

    @pytest.mark.parametrize("every", [1, 2, 3, 10, 240])
    def test_every_nth_sync(self, desk, every):
        desk.map_pdo(False, 1, [STATUS], every)
        operational(desk)
        answers = [bool(desk.sync()) for _ in range(2 * every + 1)]
        assert [n for n, said in enumerate(answers, 1) if said] == [every, 2 * every][: len(answers)] or every == 1

    def test_start_value_counts_from_that_sync(self, desk):
        desk.write(0x1019, 0, 20, 1)
        desk.map_pdo(False, 1, [STATUS], 10, start=7)
        operational(desk)
        said = [counter for n in range(60) for counter in [n % 20 + 1] if desk.sync(counter)]
        assert said == [7, 17, 7, 17, 7, 17]

    def test_start_value_without_counter_is_ignored(self, desk):
        desk.map_pdo(False, 1, [STATUS], 2, start=7)
        operational(desk)
        assert [bool(desk.sync()) for _ in range(4)] == [False, True, False, True]

    def test_counter_may_only_change_without_a_period(self, desk):
        assert desk.write(0x1019, 0, 1, 1) == 0x06090030
        desk.write(0x1006, 0, 1000, 4)
        assert desk.write(0x1019, 0, 20, 1) == 0x08000022

    def test_sync_of_the_wrong_length_is_reported_once(self, desk):
        desk.write(0x1019, 0, 20, 1)
        operational(desk)
        assert desk.sync() == [(0x085, "4082110000000000")]
        assert desk.sync() == []

    def test_type_0_answers_the_next_sync_after_a_change(self, desk):
        desk.map_pdo(False, 1, [DISPLAY], 0)
        operational(desk)
        assert desk.sync() == [(0x185, "00")]
        assert desk.sync() == []
        desk.write(0x6060, 0, 8, 1)
        assert desk.sync() == [(0x185, "08")]
        assert desk.sync() == []

    def test_no_pdo_outside_operational(self, desk):
        desk.map_pdo(False, 1, [STATUS], 1)
        desk.map_pdo(True, 1, [CONTROL], 255)
        assert desk.sync() == []
        desk.send(0x205, "0600")
        assert desk.read(0x6040) == 0
        operational(desk)
        assert desk.sync()
        desk.send(0x000, "8005")
        assert desk.sync() == []

    def test_another_sync_cob_id(self, desk):
        desk.map_pdo(False, 1, [STATUS], 1)
        assert desk.write(0x1005, 0, 0x40000080, 4) == 0x06090030, "it is no SYNC producer"
        assert desk.write(0x1005, 0, 0x90, 4) == 0
        operational(desk)
        assert desk.sync() == []
        assert desk.send(0x090, "") == [(0x185, "5002")]


class TestEventDriven:
    def test_on_change_at_once_and_on_entering_operational(self, desk):
        desk.map_pdo(False, 4, [DISPLAY, ERROR], 254)
        assert (0x485, "000000") in operational(desk)
        assert (0x485, "080000") in desk.send(0x605, "2f60600008000000")
        assert desk.said(0x485, desk.send(0x605, "2f60600008000000")) == []
        desk.heard.clear()
        desk.servo.fail(0x7305, desk.rack.now_ns)
        assert (0x485, "080573") in desk.heard

    def test_inhibit_time_gathers_changes(self, desk):
        desk.map_pdo(False, 4, [DISPLAY], 255, inhibit=50)  # 5 ms
        operational(desk)
        for mode in (8, 9, 10):
            assert desk.said(0x485, desk.send(0x605, bytes([0x2F, 0x60, 0x60, 0, mode, 0, 0, 0]))) == []
        assert desk.wait(4.9) == []
        assert desk.wait(0.2) == [(0x485, "0a")]
        assert desk.wait(20) == []

    def test_event_timer(self, desk):
        desk.map_pdo(False, 4, [DISPLAY], 255, timer=50)
        operational(desk)
        assert [len(desk.wait(10)) for _ in range(15)] == [0, 0, 0, 0, 1] * 3

    def test_actual_values_on_change(self, desk):
        desk.map_pdo(False, 4, [POSITION], 255)
        operational(desk)
        desk.plant.measured_position_rad = 0.01
        assert desk.said(0x485, desk.sync()) == [(1592).to_bytes(4, "little").hex()]

    def test_rpdo_acts_at_once(self, desk):
        desk.map_pdo(True, 1, [CONTROL], 255)
        operational(desk)
        desk.send(0x205, "0600")
        assert desk.state() == 0x21


def test_remote_frames_are_answered_only_where_allowed(desk):
    desk.map_pdo(False, 1, [STATUS], 1)
    operational(desk)
    assert desk.send(0x185, "", remote=True) == [(0x185, "5002")]
    desk.write(0x1800, 1, 0x80000185, 4)
    desk.write(0x1800, 1, 0x40000185, 4)
    assert desk.send(0x185, "", remote=True) == []


def test_short_rpdo_is_refused_with_an_emcy_and_a_long_one_taken(desk):
    desk.map_pdo(True, 1, [CONTROL, TARGET], 255)
    operational(desk)
    assert desk.said(0x085, desk.send(0x205, "0600")) == ["1082110200000000"]
    assert desk.read(0x6040) == 0
    desk.send(0x205, "0600 01000000 aa")
    assert desk.read(0x6040) == 6 and desk.read(0x607A) == 1


def test_latest_rpdo_before_sync_wins(desk):
    desk.map_pdo(True, 1, [TARGET], 1)
    operational(desk)
    for value in (1, 2, 3):
        desk.send(0x205, struct.pack("<i", value))
    desk.sync()
    assert desk.read(0x607A) == 3


def test_four_pdos_each_way(desk):
    for number, entry in enumerate((CONTROL, TARGET, OFFSET, MODE), 1):
        desk.map_pdo(True, number, [entry], 255)
    for number, entry in enumerate((STATUS, POSITION, TORQUE, ERROR), 1):
        desk.map_pdo(False, number, [entry], 1)
    operational(desk)
    for number, value in enumerate(("0600", "05000000", "f6ff", "0a"), 1):
        desk.send(0x105 + 0x100 * number, value)
    assert [desk.read(0x6040), desk.read(0x607A), desk.read(0x60B2, signed=True), desk.read(0x6060)] == [6, 5, -10, 10]
    assert [can_id for can_id, _ in desk.sync()] == [0x185, 0x285, 0x385, 0x485]
