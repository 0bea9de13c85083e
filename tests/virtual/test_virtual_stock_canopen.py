"""The stock ``canopen`` library as the peer: a second implementation of CANopen that never saw this servo."""

import contextlib
import threading
import time

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from frictid_drivers.virtual.eds import EDS_FILE, eds_text
from frictid_drivers.virtual.lock_step import LockStepBus, LockStepClock
from frictid_drivers.virtual.objects import OBJECTS
from frictid_drivers.virtual.rack import Rack


def until(happened, timeout_s=2.0):
    """Wait for what the notifier's thread will see."""
    deadline_s = time.monotonic() + timeout_s
    while not happened():
        assert time.monotonic() < deadline_s, "never happened"
        time.sleep(0.0005)


@contextlib.contextmanager
def running(bus):
    """Run time passes meanwhile."""
    stop = threading.Event()

    def run():
        now_ns = bus.drives.now_ns
        while not stop.wait(0.001):
            now_ns += 1_000_000
            bus.advance(now_ns)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@pytest.fixture
def bench(make_robot):
    """Two drives and a canopen network on a lock-step bus."""
    rack = Rack()
    rack.install(make_robot())
    network = canopen.Network(bus=LockStepBus(rack, "stock-canopen"))
    network.NOTIFIER_CYCLE = 0.01
    nodes = [BaseNode402(node, str(EDS_FILE)) for node in (1, 2)]
    for node in nodes:
        network.add_node(node)
    network.connect()
    rack.power_on()
    for node in nodes:
        until(lambda node=node: node.nmt.state == "PRE-OPERATIONAL")
    yield rack, network, nodes
    network.disconnect()


def test_the_shipped_eds_is_the_object_dictionary():
    assert EDS_FILE.read_text(encoding="ascii") == eds_text()
    loaded = canopen.import_od(str(EDS_FILE), node_id=5)
    for record in OBJECTS:
        for entry in record.entries:
            found = loaded[record.index] if len(record.entries) == 1 else loaded[record.index][entry.key & 0xFF]
            assert found.data_type == entry.kind and found.access_type == entry.access
            assert found.default == (entry.default + 5 if entry.node_relative else entry.default)
            assert found.pdo_mappable == (entry.receive or entry.transmit)
            assert (found.min, found.max) == (entry.low, entry.high)
    assert set(loaded) - {record.index for record in OBJECTS} == set(range(2, 8)), "and the dummies"


def test_sdo_by_name_and_segmented(bench):
    _, _, (node, _) = bench
    assert node.sdo["Manufacturer device name"].raw == "frictid virtual servo"
    node.sdo["Note"].raw = "a text longer than one expedited frame"
    assert node.sdo["Note"].raw == "a text longer than one expedited frame"
    node.sdo["Software position limit"]["Min position limit"].raw = -123456
    assert node.sdo[0x607D][1].raw == -123456
    with pytest.raises(canopen.SdoAbortedError) as abort:
        node.sdo[0x6041].raw = 0
    assert abort.value.code == 0x06010002
    with pytest.raises(canopen.SdoAbortedError) as abort:
        node.sdo.download(0x60C2, 1, b"\1\2")
    assert abort.value.code == 0x06070012


def test_nmt_and_heartbeat(bench):
    rack, network, (node, _) = bench
    node.sdo[0x1017].raw = 100
    for state in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"):
        node.nmt.state = state
        rack.advance(rack.now_ns + 100_000_000)
        until(lambda: node.nmt.timestamp == pytest.approx(rack.now_ns * 1e-9))
        assert node.nmt.state == state
    node.nmt.state = "RESET"
    until(lambda: node.nmt.state == "PRE-OPERATIONAL")
    network.check()


def test_emcy_and_history(bench):
    rack, _, (node, other) = bench
    rack.servos["0"].fail(0x7305, rack.now_ns)
    until(lambda: node.emcy.active)
    assert (node.emcy.active[0].code, node.emcy.active[0].register) == (0x7305, 0x21)
    assert node.sdo[0x1003][1].raw == 0x7305
    assert not other.emcy.active
    node.sdo[0x6040].raw = 0x80
    until(lambda: node.emcy.active == [])


def test_pdo_configuration_by_canopen_is_what_the_drive_has(bench):
    _, network, (node, _) = bench
    node.tpdo[1].clear()
    for index in (0x6041, 0x6064, 0x6077):
        node.tpdo[1].add_variable(index)
    node.tpdo[1].cob_id, node.tpdo[1].trans_type, node.tpdo[1].enabled = 0x181, 1, True
    node.rpdo[1].clear()
    for index in (0x6040, 0x607A, 0x60B2):
        node.rpdo[1].add_variable(index)
    node.rpdo[1].cob_id, node.rpdo[1].trans_type, node.rpdo[1].enabled = 0x201, 1, True
    node.tpdo[1].save()
    node.rpdo[1].save()
    node.tpdo.read()
    node.rpdo.read()
    assert [variable.index for variable in node.tpdo[1].map] == [0x6041, 0x6064, 0x6077]
    assert [variable.index for variable in node.rpdo[1].map] == [0x6040, 0x607A, 0x60B2]
    node.nmt.state = "OPERATIONAL"
    node.rpdo[1]["Controlword"].raw = 0x06
    node.rpdo[1].transmit()
    network.sync.transmit()
    network.sync.transmit()
    until(lambda: node.tpdo[1]["Statusword"].raw & 0x6F == 0x21)
    assert node.tpdo[1]["Position actual value"].raw == node.sdo[0x6064].raw


def event_driven(node):
    """Controlword and statusword the way BaseNode402 wants them."""
    for pdo, index, cob_id in ((node.tpdo[1], 0x6041, 0x180), (node.rpdo[1], 0x6040, 0x200)):
        pdo.clear()
        pdo.add_variable(index)
        pdo.cob_id, pdo.trans_type, pdo.enabled = cob_id + node.id, 255, True
        pdo.save()
    node.setup_402_state_machine()
    node.nmt.state = "OPERATIONAL"


def test_state_changes_by_base_node_402(bench):
    _, _, nodes = bench
    for node in nodes:
        event_driven(node)
        for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED", "SWITCHED ON", "OPERATION ENABLED"):
            node.state = state
            assert node.state == state
        node.state = "SWITCH ON DISABLED"
        assert node.state == "SWITCH ON DISABLED"


def test_fault_and_quick_stop_by_base_node_402(bench):
    rack, network, (node, _) = bench
    node.sdo[0x1800][5].raw = 10
    event_driven(node)
    node.sdo[0x605A].raw = 6
    node.state = "OPERATION ENABLED"
    node.state = "QUICK STOP ACTIVE"
    assert node.state == "QUICK STOP ACTIVE"
    node.state = "OPERATION ENABLED"
    rack.servos["0"].fail(0x5000, rack.now_ns)
    rack.advance(rack.now_ns + 1_000_000_000)
    until(node.is_faulted)
    assert node.state == "FAULT"
    # The library waits for the next report of the timed PDO, so run time has to pass.
    with running(network.bus):
        node.reset_from_fault()
    assert node.state == "OPERATION ENABLED"


def test_modes_by_base_node_402(bench):
    _, _, (node, _) = bench
    event_driven(node)
    assert node.is_op_mode_supported("CYCLIC SYNCHRONOUS TORQUE")
    assert not node.is_op_mode_supported("HOMING")
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    assert node.op_mode == "CYCLIC SYNCHRONOUS TORQUE"


def test_two_networks_on_one_channel_hear_the_drives_alike(bench):
    """As on any bus, a second member hears what the drives and the host say."""
    rack, _, (node, _) = bench
    listener = canopen.Network()
    listener.NOTIFIER_CYCLE = 0.01
    other = canopen.RemoteNode(1, str(EDS_FILE))
    listener.add_node(other)
    listener.connect(interface="virtual", channel="stock-canopen")
    try:
        node.sdo[0x1017].raw = 50
        rack.advance(rack.now_ns + 50_000_000)
        until(lambda: other.nmt.state == "PRE-OPERATIONAL")
    finally:
        listener.disconnect()


def test_clock_stands_still_while_sdo_runs(bench):
    rack, _, (node, _) = bench
    clock = LockStepClock(rack)
    for _ in range(20):
        node.sdo[0x6064].raw  # noqa: B018 - an upload
    assert clock.now_ns() == 0
    clock.wait_until(5_000_000)
    assert clock.now_ns() == 5_000_000
    clock.wait_until(3_000_000)
    assert clock.now_ns() == 5_000_000
    clock.restart()
    assert clock.now_ns() == 0
