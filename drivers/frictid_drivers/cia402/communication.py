"""What CANopen itself wants of a drive (other transports have others): SYNC, heartbeats, PDOs, as lists of writes."""

from __future__ import annotations

from dataclasses import replace

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.access import Drive, RefusedByDrive, Write
from frictid_drivers.cia402.frame_map import Frame
from frictid_drivers.cia402.layout import Layout, Pdo
from frictid_drivers.cia402.settings import BusSettings
from frictid_hil.errors import HardwareError

_NOT_VALID = 1 << 31
_NO_REMOTE = 1 << 30
_COB_ID_MASK = _NOT_VALID | 0x1FFFFFFF  # bit 30 (remote frames) is a drive's own business

_ALL = tuple((transmit, number) for transmit in (False, True) for number in (1, 2, 3, 4))


def sync_writes(drive: Drive, cycle_hz: float, sync_overflow: int) -> list[Write]:
    """SYNC: 1005, 1006, 1019."""
    writes = []
    if drive.has(od.SYNC_COB_ID):
        writes.append(Write(od.SYNC_COB_ID, 0x80, mask=0x7FF))
    if drive.has(od.SYNC_OVERFLOW) and drive.known(od.SYNC_OVERFLOW) != sync_overflow:
        # 1019 may only change while 1006 is zero.
        if drive.has(od.SYNC_PERIOD_US):
            writes.append(Write(od.SYNC_PERIOD_US, 0))
        writes.append(Write(od.SYNC_OVERFLOW, sync_overflow))
    if drive.has(od.SYNC_PERIOD_US):
        writes.append(Write(od.SYNC_PERIOD_US, round(1e6 / cycle_hz), "the drive does not know the period of SYNC"))
    return writes


def heartbeat_writes(drive: Drive, settings: BusSettings) -> list[Write]:
    """Watchdogs both ways: 1016, 1017."""
    writes = [Write(od.HEARTBEAT_PRODUCER_MS, settings.drive_heartbeat_ms)]
    if drive.has(od.HEARTBEAT_CONSUMER):
        consumer = _free_consumer(drive, settings.host_node)
        said = "the drive does not watch over the host; torque mode is refused"
        writes.append(Write(consumer, settings.host_node << 16 | settings.watchdog_ms, said))
    return writes


def _free_consumer(drive: Drive, host_node: int) -> od.Object:
    """The entry of 1016 that watches over us already, else the first free one, else the first."""
    entries = [od.HEARTBEAT_CONSUMER.at(sub) for sub in range(1, (drive.known(od.HEARTBEAT_CONSUMERS) or 1) + 1)]
    values = {entry: drive.known(entry) for entry in entries}
    for wanted in (lambda v: v >> 16 & 0x7F == host_node, lambda v: not v & 0xFFFF):
        for entry, value in values.items():
            if value is not None and wanted(value):
                return entry
    return entries[0]


def frame_format_writes(drive: Drive, switch: od.Object | None, *, fd: bool) -> list[Write]:
    """Classical or CAN FD frames, where an object decides it; ``HardwareError`` where CAN FD is wanted without one."""
    if switch is None:
        return []  # the vendor's tool has set it; what comes in other frames is told while cycling
    if drive.has(switch):
        return [Write(switch, int(fd))]
    if fd:
        raise HardwareError(
            f"the drive has no {switch.address}: it cannot be told to send its PDOs as CAN FD frames",
            where=drive.where(switch.address),
            cause="the drive or its firmware speaks classical CAN only",
            next_step="leave `fd` out of the robot file's options, or correct this joint's `fd_object`",
        )
    return []


def pdo_writes(drive: Drive, layout: Layout, joint: str) -> list[Write]:
    """Mapping and transmission of every PDO; those that are not used are made invalid first."""
    used = {(pdo.transmit, pdo.number) for pdo in layout.pdos[joint]}
    writes = []
    for cob_id in (od.pdo(*which, od.PDO_COB_ID) for which in _ALL if which not in used):
        present = drive.known(cob_id)
        if present is not None and not present & _NOT_VALID:
            writes.append(Write(cob_id, present | _NOT_VALID, mask=_COB_ID_MASK))
    for pdo in layout.pdos[joint]:
        writes += _one_pdo(drive, pdo)
    return writes


def _one_pdo(drive: Drive, pdo: Pdo) -> list[Write]:
    cob_id = od.pdo(pdo.transmit, pdo.number, od.PDO_COB_ID)
    valid = pdo.frame.cob_id | (_NO_REMOTE if pdo.transmit else 0)
    settings = [Write(od.pdo(pdo.transmit, pdo.number, od.PDO_TYPE), pdo.every)]
    if pdo.transmit and drive.has(od.pdo(True, pdo.number, od.PDO_SYNC_START)):
        settings.append(Write(od.pdo(True, pdo.number, od.PDO_SYNC_START), pdo.start))
    items = [od.Object(entry.index, entry.sub, entry.type, entry.meaning) for entry in pdo.frame.entries]
    mapped = mapping(drive, pdo) == [item.mapping for item in items]
    if mapped and drive.known(cob_id) == valid and all(drive.known(write.item) == write.value for write in settings):
        return []
    writes = [Write(cob_id, valid | _NOT_VALID, mask=_COB_ID_MASK), *settings]
    if not mapped:
        count = od.pdo_entry(pdo.transmit, pdo.number, 0)
        writes.append(Write(count, 0))
        for sub, item in enumerate(items, start=1):
            writes.append(Write(od.pdo_entry(pdo.transmit, pdo.number, sub), item.mapping, maps=item))
        writes.append(Write(count, len(items)))
    return [*writes, Write(cob_id, valid, mask=_COB_ID_MASK)]


def mapping(drive: Drive, pdo: Pdo) -> list[int]:
    """The mapping words of a PDO as the drive has them, in order."""
    count = drive.known(od.pdo_entry(pdo.transmit, pdo.number, 0)) or 0
    words = [drive.known(od.pdo_entry(pdo.transmit, pdo.number, sub)) for sub in range(1, count + 1)]
    return [word for word in words if word is not None]


def frame_of(drive: Drive, pdo: Pdo) -> Frame:
    """The frame as read back from the drive."""
    entries = {entry.index << 16 | entry.sub << 8 | entry.type.bits: entry for entry in pdo.frame.entries}
    return Frame(pdo.frame.cob_id, tuple(entries[word] for word in mapping(drive, pdo)))


def lesson(drive: Drive, refused: RefusedByDrive) -> bool:
    """Learn from this drive's refusal of a PDO's type or mapping: True where the layout can be planned without it."""
    item, quirks = refused.item, drive.quirks
    if item is None or refused.where != drive.where(item.address):
        return False
    if 0x1800 <= item.index < 0x1A00 and item.sub == 2 and quirks.sends_on(10):
        drive.quirks = replace(quirks, transmission_types=(1, 253, 255))
        return True
    mapped = (refused.value >> 16, refused.value >> 8 & 0xFF)
    is_entry = item.sub and item.index & 0xFA00 in (0x1600, 0x1A00)
    if is_entry and mapped in _OPTIONAL and mapped not in quirks.not_mappable:
        drive.quirks = replace(quirks, not_mappable=quirks.not_mappable | {mapped})
        return True
    return False


_OPTIONAL = {(item.index, item.sub) for item in (od.ERROR_CODE, od.TORQUE_OFFSET, od.TARGET_TORQUE, od.TARGET_VELOCITY)}
