"""The table of bits per frame and loads per layout, and the rates that follow from it."""

from __future__ import annotations

import pytest

from frictid_drivers.cia402.bus_load import SyncFrame, bus_load, frame_bits, highest_rate_hz
from frictid_drivers.cia402.layout import NodeWish, plan_layout

SYNC = SyncFrame(0)
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
    load = bus_load(frames, 1000.0, 1_000_000)
    assert (load.least_bits, load.average_bits, load.peak_bits) == (least, worst, worst)


def test_decimated_reports_spread_or_not():
    active = [SYNC, RPDO8, TPDO8, TPDO4]
    spread = bus_load([*active, *[SyncFrame(6, 10, start) for start in range(1, 6)]], 1000.0, 1_000_000)
    bunched = bus_load([*active, *[SyncFrame(6, 10, 0)] * 5], 1000.0, 1_000_000)
    assert round(spread.least_bits) == 396 and round(spread.average_bits) == 478
    assert bunched.average_bits == spread.average_bits
    assert bunched.peak_bits == 995 and spread.peak_bits == 420 + 115
    assert 39 < spread.least_percent < spread.average_percent < 48.1


def test_timers_count_fully_on_average_and_once_in_the_peak():
    load = bus_load([SYNC], 1000.0, 1_000_000, timed=[(1, 0.1), (1, 0.05)], occasional=[8])
    assert load.average_bits == pytest.approx(55 + 65 / 100 + 65 / 50)
    assert load.peak_bits == 55 + 65 + 135


ROBOT = [NodeWish(str(joint), joint + 1) for joint in range(6)]


def layout(active, cycle_hz, *, sync_counter=True):
    return plan_layout(ROBOT, active, cycle_hz, sync_counter=sync_counter, host_heartbeat_s=0.05, drive_heartbeat_s=0.1)


def test_one_active_joint_at_1_khz_fits_1_mbit():
    load = layout(["1"], 1000.0).load(1_000_000)
    assert load.fits and load.average_percent < 60 and load.peak_percent < 90


def test_without_sync_counter_it_does_not():
    load = layout(["1"], 1000.0, sync_counter=False).load(1_000_000)
    assert load.average_percent < 60 and load.peak_percent > 200 and not load.fits


@pytest.mark.parametrize(("active", "cycle_hz", "fits"), [(1, 500, True), (6, 250, True), (6, 500, False)])
def test_rates_at_1_mbit(active, cycle_hz, fits):
    assert layout([str(joint) for joint in range(active)], cycle_hz).load(1_000_000).fits is fits


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 250_000, 125_000])
@pytest.mark.parametrize("active", [["1"], list("012345")])
def test_highest_rate_fits_and_the_next_does_not(active, bitrate):
    highest = highest_rate_hz(lambda hz: layout(active, hz).load(bitrate), 4000.0)
    assert layout(active, highest).load(bitrate).fits
    assert not layout(active, highest + 1).load(bitrate).fits or highest == 4000.0


def test_no_rate_at_all():
    assert highest_rate_hz(lambda hz: layout(list("012345"), hz).load(1000), 4000.0) == 0.0


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
