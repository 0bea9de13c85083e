"""The table of bits per frame and loads per layout, and the rates that follow from it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_drivers.cia402.layout import NodeWish, SyncFrame, bus_load, highest_rate_hz, plan_layout
from frictid_hil.protocol.can_load import FD_SIZES, BitRates, fd_frame_bits, fd_size, frame_bits

SYNC = SyncFrame(0)
CLASSICAL = BitRates(1_000_000)
RPDO8, TPDO8, TPDO6, TPDO4 = (SyncFrame(size) for size in (8, 8, 6, 4))


@pytest.mark.parametrize(("data_bytes", "least", "worst"), [(0, 47, 55), (4, 79, 95), (6, 95, 115), (8, 111, 135)])
def test_bits_per_frame(data_bytes, least, worst):
    bits = frame_bits(data_bytes)
    assert (bits.least, bits.worst) == (least, worst)


@pytest.mark.parametrize("data_bytes", [-1, 9, 64])
def test_no_classical_frame_carries_that(data_bytes):
    with pytest.raises(ValueError, match=r"0\.\.8"):
        frame_bits(data_bytes)


@pytest.mark.parametrize("data_bytes", range(9))
def test_worst_stuffing_is_reached_by_a_real_bit_pattern(data_bytes):
    """An independent count: stuff the worst pattern bit by bit (five equal bits, then one opposite counts on)."""
    stuffable = 34 + 8 * data_bytes
    bits = [0] * 5
    while len(bits) < stuffable:
        # After a stuff bit, which opens the next run of five, four more of its kind force another one.
        bits += [1 - bits[-1]] * 4
    bits = bits[:stuffable]
    stuffed = run = 0
    last = None
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed += 1
            last, run = 1 - bit, 1
    assert frame_bits(data_bytes).worst - frame_bits(data_bytes).least == stuffed


@pytest.mark.parametrize(
    ("frames", "least", "worst"),
    [
        ([SYNC, RPDO8, TPDO8, TPDO4], 348, 420),
        ([SYNC, RPDO8, TPDO8, TPDO4, *[TPDO6] * 5], 823, 995),
        ([SYNC, *[RPDO8, TPDO8] * 6], 1379, 1675),
        ([SYNC, *[RPDO8, TPDO8, TPDO4] * 6], 1853, 2245),
    ],
)
def test_layouts_of_the_field_note(frames, least, worst):
    load = bus_load(frames, 1000.0, CLASSICAL)
    assert (load.least_bits, load.average_bits, load.peak_bits) == (least, worst, worst)


def test_decimated_reports_spread_or_not():
    active = [SYNC, RPDO8, TPDO8, TPDO4]
    spread = bus_load([*active, *[SyncFrame(6, 10, start) for start in range(1, 6)]], 1000.0, CLASSICAL)
    bunched = bus_load([*active, *[SyncFrame(6, 10, 0)] * 5], 1000.0, CLASSICAL)
    assert round(spread.least_bits) == 396 and round(spread.average_bits) == 478
    assert bunched.average_bits == spread.average_bits
    assert bunched.peak_bits == 995 and spread.peak_bits == 420 + 115
    assert 0.39 * CLASSICAL.nominal < 1000.0 * spread.least_bits
    assert spread.least_bits < spread.average_bits and spread.average_percent < 48.1


def test_timers_count_fully_on_average_and_once_in_the_peak():
    load = bus_load([SYNC], 1000.0, CLASSICAL, timed=[(1, 0.1), (1, 0.05)], occasional=[SyncFrame(8)])
    assert load.average_bits == pytest.approx(55 + 65 / 100 + 65 / 50)
    assert load.peak_bits == 55 + 65 + 135


ROBOT = [NodeWish(str(joint), joint + 1) for joint in range(6)]


def layout(active, cycle_hz, rates=CLASSICAL, *, sync_counter=True, pdo_bytes=8):
    return plan_layout(
        ROBOT,
        active,
        cycle_hz,
        sync_counter=sync_counter,
        host_heartbeat_s=0.05,
        drive_heartbeat_s=0.1,
        rates=rates,
        pdo_bytes=pdo_bytes,
    )


def test_one_active_joint_at_1_khz_fits_1_mbit():
    load = layout(["1"], 1000.0).load()
    assert load.fits and load.average_percent < 60 and load.peak_percent < 90


def test_without_sync_counter_it_does_not():
    load = layout(["1"], 1000.0, sync_counter=False).load()
    assert load.average_percent < 60 and load.peak_percent > 200 and not load.fits


@pytest.mark.parametrize(("active", "cycle_hz", "fits"), [(1, 500, True), (6, 250, True), (6, 500, False)])
def test_rates_at_1_mbit(active, cycle_hz, fits):
    assert layout([str(joint) for joint in range(active)], cycle_hz).load().fits is fits


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 250_000, 125_000])
@pytest.mark.parametrize("active", [["1"], list("012345")])
def test_highest_rate_fits_and_the_next_does_not(active, bitrate):
    rates = BitRates(bitrate)
    highest = highest_rate_hz(lambda hz: layout(active, hz, rates).load(), 4000.0)
    assert layout(active, highest, rates).load().fits
    assert not layout(active, highest + 1, rates).load().fits or highest == 4000.0


def test_no_rate_at_all():
    assert highest_rate_hz(lambda hz: layout(list("012345"), hz, BitRates(1000)).load(), 4000.0) == 0.0


@pytest.mark.parametrize("cycle_hz", [50, 100, 125, 200, 250, 333, 500, 800, 1000])
def test_locked_joints_report_at_least_every_10_ms(cycle_hz):
    plan = layout(["1"], cycle_hz)
    for joint, pdos in plan.pdos.items():
        for pdo in pdos:
            if pdo.transmit and pdo.number < 3:
                assert pdo.every == 1 if joint == "1" else pdo.every / cycle_hz <= max(0.010, 1 / cycle_hz) + 1e-9
            assert 0 <= pdo.start <= pdo.every
            assert pdo.start <= max(1, plan.sync_overflow) <= 240
            assert not plan.sync_overflow or plan.sync_overflow % pdo.every == 0


def test_start_values_do_not_depend_on_who_is_active():
    first, second = layout(["0"], 1000.0), layout(["3"], 1000.0)
    for joint in "1245":
        assert first.pdos[joint] == second.pdos[joint]


def test_no_two_locked_joints_share_a_sync():
    starts = [pdos[2].start for joint, pdos in layout(["1"], 1000.0).pdos.items() if joint != "1"]
    assert len(set(starts)) == 5


@pytest.mark.parametrize(
    ("data_bytes", "rates", "least_us", "worst_us"),
    [
        # By hand, 8 bytes at 1 and 4 Mbit/s. Slow: 17 bits to BRS, 13 from the CRC delimiter on, 4 stuff bits at worst.
        # Fast: ESI 1, DLC 4, data 64, stuff count 4, CRC 17, fixed stuff 6 = 96; start of frame to data are 86 bits
        # with 21 stuff bits at worst, 17 of them fast: (96 + 17) / 4 = 28.25 us.
        (8, BitRates(1_000_000, 4_000_000), 30 + 24.0, 34 + 28.25),
        # 12 bytes: fast 5 + 96 + 27 = 128, 118 bits with 29 stuff bits, 25 of them fast.
        (12, BitRates(1_000_000, 4_000_000), 30 + 32.0, 34 + 38.25),
        # 20 bytes have the longer CRC: 5 + 160 + 4 + 21 + 7 = 197, 182 bits with 45 stuff bits, 41 of them fast.
        (20, BitRates(1_000_000, 2_000_000), 30 + 98.5, 34 + 119.0),
        # None at all, at half the rate of arbitration: twice as long; fast 5 + 27 = 32, 22 bits with 5 stuff bits.
        (0, BitRates(500_000, 2_000_000), 60 + 16.0, 68 + 16.5),
    ],
)
def test_length_of_a_fd_frame_by_hand(data_bytes, rates, least_us, worst_us):
    bits = fd_frame_bits(data_bytes, rates)
    assert bits.least * 1e6 / rates.nominal == pytest.approx(least_us)
    assert bits.worst * 1e6 / rates.nominal == pytest.approx(worst_us)


@pytest.mark.parametrize(("mapped", "sent"), [(9, 12), (13, 16), (17, 20), (33, 48), (49, 64)])
def test_a_fd_frame_is_as_long_as_the_next_length_that_there_is(mapped, sent):
    rates = BitRates(1_000_000, 4_000_000)
    assert fd_frame_bits(mapped, rates) == fd_frame_bits(sent, rates) != fd_frame_bits(mapped - 1, rates)


@pytest.mark.parametrize(("data_bytes", "rates"), [(65, BitRates(1_000_000, 2_000_000)), (8, BitRates(1_000_000))])
def test_no_fd_frame_carries_that(data_bytes, rates):
    with pytest.raises(ValueError, match="CAN FD"):
        fd_frame_bits(data_bytes, rates)


@given(data=st.binary(max_size=64), identifier=st.integers(0, (1 << 29) - 1), extended=st.booleans())
def test_no_fd_frame_is_longer_than_its_worst_case(data, identifier, extended):
    """Stuff real frames bit by bit, both rates apart; the bound must hold for every one of them."""
    size = fd_size(len(data))
    data = data.ljust(size, b"\0")
    dlc = FD_SIZES.index(size)
    long = [
        1,
        1,
        *(identifier >> k & 1 for k in range(17, -1, -1)),
        0,
        1,
        0,
        1,
    ]  # SRR, IDE, the rest; RRS, FDF, res, BRS
    bits = [0, *(identifier >> k & 1 for k in range(28, 17, -1)), *(long if extended else [0, 0, 1, 0, 1])]
    head = len(bits)
    bits += [0, *(dlc >> k & 1 for k in range(3, -1, -1)), *(byte >> k & 1 for byte in data for k in range(7, -1, -1))]
    slow = fast = run = 0
    last = None
    for place, bit in enumerate(bits):
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            slow, fast = (slow + 1, fast) if place < head else (slow, fast + 1)
            last, run = 1 - bit, 1
    rates = BitRates(1_000_000, 5_000_000)
    found = fd_frame_bits(len(data), rates, extended=extended)
    assert head == (36 if extended else 17)
    assert found.least + slow + fast / 5 <= found.worst + 1e-9


@pytest.mark.parametrize(
    ("data", "pdo_bytes", "highest_hz"),
    [(None, 8, 327), (2_000_000, 64, 588), (4_000_000, 64, 870), (5_000_000, 64, 965), (8_000_000, 64, 1143)],
)
def test_six_joints_with_can_fd(data, pdo_bytes, highest_hz):
    six, rates = list("012345"), BitRates(1_000_000, data)
    assert highest_rate_hz(lambda hz: layout(six, hz, rates, pdo_bytes=pdo_bytes).load(), 4000.0) == highest_hz


def test_velocity_goes_with_position_where_pdos_are_long_enough():
    rates = BitRates(1_000_000, 4_000_000)
    for pdo_bytes, sizes in ((8, [8, 4, 3]), (11, [8, 4, 3]), (12, [12, 3]), (64, [12, 3])):
        plan = layout(["0"], 500.0, rates, pdo_bytes=pdo_bytes)
        for pdos in plan.pdos.values():
            assert [pdo.frame.size for pdo in pdos if pdo.transmit] == sizes
            assert len({pdo.frame.cob_id for pdo in pdos}) == len(pdos)
    assert (
        layout(["0"], 500.0, rates, pdo_bytes=64).load().average_bits < layout(["0"], 500.0, rates).load().average_bits
    )
