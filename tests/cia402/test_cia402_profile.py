"""The profile without CANopen: the same settings on a transport that is a table in memory."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import pytest
from cia402_bench import bench

from frictid_drivers.cia402 import configure
from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.access import Aborted, Drive, RefusedByDrive, Write
from frictid_drivers.cia402.facts import read_facts
from frictid_drivers.cia402.scale import scale_of
from frictid_drivers.cia402.settings import read_settings

NO_OBJECT, READ_ONLY = 0x06020000, 0x06010002


class InMemory(Drive):
    """A drive whose objects are bytes in a dictionary, as a mailbox of EtherCAT would bring them."""

    def __init__(self, objects):
        super().__init__(1, "0")
        self.objects = {(item.index, item.sub): item.type.pack(value) for item, value in objects.items()}
        self.fixed = set()

    def upload(self, index, sub):
        if (index, sub) not in self.objects:
            raise Aborted(NO_OBJECT, "no such object")
        return self.objects[index, sub]

    def download(self, index, sub, data):
        if (index, sub) in self.fixed:
            raise Aborted(READ_ONLY, "read-only")
        self.objects[index, sub] = data

    def answering_within(self, timeout_s):
        return contextlib.nullcontext()


@pytest.fixture
def drive():
    return InMemory({
        od.STATUSWORD: 0x40, od.POSITION_ACTUAL: 0, od.SUPPORTED_MODES: 0x3A0, od.RATED_TORQUE_MNM: 1000,
        od.ENCODER_INCREMENTS: 4096, od.ENCODER_REVOLUTIONS: 1, od.FOLLOWING_WINDOW: 0, od.FOLLOWING_TIMEOUT_MS: 0,
        od.INTERPOLATION_VALUE: 1, od.INTERPOLATION_INDEX: -3, od.ABORT_CONNECTION: 0, od.QUICK_STOP_OPTION: 2,
        od.MAX_TORQUE: 3000, od.POSITION_LIMIT_MIN: 0, od.POSITION_LIMIT_MAX: 0, od.MODE: 0, od.TARGET_TORQUE: 5,
    })  # fmt: skip


def test_settings_of_the_profile_need_no_canopen(drive):
    before = dict(drive.objects)
    setup = bench(1).setup
    joint = replace(setup.joints[0], rated_torque_nm=setup.joints[0].gear_ratio)
    bus, joints = read_settings(setup)
    facts = read_facts(drive)
    scale, findings = scale_of(facts, joint, None)
    assert not [one for one in findings if one.severity.value == "error"] and facts.watchdog is False
    limits, _ = configure.limit_writes(drive, joints[joint.name], scale, 10.0, -1.0, 1.0)
    writes = [
        *configure.interpolation_writes(drive, 500.0),
        *configure.reaction_writes(drive, bus),
        *configure.window_writes(drive, joints[joint.name], scale.position_rad, active=True),
        *configure.set_point_writes(drive, facts.position_mode),
        *limits,
    ]
    assert drive.foresee(writes) == ([], []) and drive.apply(writes) == []
    assert drive.read(od.INTERPOLATION_VALUE) == 2 and drive.read(od.TARGET_TORQUE) == 0 and drive.read(od.MODE) == 8
    drive.restore()
    commanded = {(od.MODE.index, 0), (od.TARGET_TORQUE.index, 0)}
    assert {at: data for at, data in drive.objects.items() if at not in commanded} == {
        at: data for at, data in before.items() if at not in commanded
    }


def test_refusals_read_alike_on_any_transport(drive):
    drive.fixed.add((od.MAX_TORQUE.index, 0))
    with pytest.raises(RefusedByDrive, match="the drive refuses max torque = 1000: read-only"):
        drive.apply([Write(od.MAX_TORQUE, 1000)])
    assert not drive.has(od.TORQUE_OFFSET)
