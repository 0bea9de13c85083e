"""The electronic data sheet of the simulated drive (CiA 306), written from the table of objects.

``frictid_servo.eds`` next to this file is what ``eds_text`` returns; a test keeps them equal. To renew it::

    python -m frictid_drivers.virtual.eds
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from frictid_drivers.virtual.objects import OBJECTS, DataType, Entry, Key, Record, Value

EDS_FILE = Path(__file__).with_name("frictid_servo.eds")

_VARIABLE, _ARRAY, _RECORD = 7, 8, 9
_MANDATORY = (0x1000, 0x1001, 0x1018)
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)


def eds_text(records: Sequence[Record] = OBJECTS, absent: Collection[Key] = ()) -> str:
    """The whole file for a drive's objects, without the entries that it lacks."""
    records = [
        replace(record, entries=entries)
        for record in records
        if (entries := tuple(entry for entry in record.entries if entry.key not in absent))
    ]
    manufacturer = [record for record in records if 0x2000 <= record.index < 0x6000]
    mandatory = [record for record in records if record.index in _MANDATORY]
    optional = [record for record in records if record not in mandatory and record not in manufacturer]
    lines = [
        "[FileInfo]",
        "FileName=frictid_servo.eds",
        "FileVersion=1",
        "FileRevision=0",
        "EDSVersion=4.0",
        "Description=Simulated CiA 402 servo drive",
        "CreatedBy=frictid-hil",
        "",
        "[DeviceInfo]",
        "VendorName=frictid-hil",
        "VendorNumber=0",
        "ProductName=frictid virtual servo",
        "ProductNumber=0x46524943",
        "RevisionNumber=0x00010000",
        "OrderCode=simulated",
        *(f"BaudRate_{rate}=1" for rate in _BIT_RATES),
        "SimpleBootUpMaster=0",
        "SimpleBootUpSlave=1",
        "Granularity=8",
        "DynamicChannelsSupported=0",
        "GroupMessaging=0",
        "NrOfRXPDO=4",
        "NrOfTXPDO=4",
        "LSS_Supported=0",
        "",
        "[DummyUsage]",
        *(f"Dummy{number:04d}={int(number != 1)}" for number in range(1, 8)),
        "",
        *_index_list("MandatoryObjects", mandatory),
        *_index_list("OptionalObjects", optional),
        *_index_list("ManufacturerObjects", manufacturer),
    ]
    for record in records:
        lines += _record(record)
    return "\n".join(lines)


def _index_list(title: str, records: list[Record]) -> list[str]:
    rows = [f"{number}=0x{record.index:04X}" for number, record in enumerate(records, 1)]
    return [f"[{title}]", f"SupportedObjects={len(rows)}", *rows, ""]


def _record(record: Record) -> list[str]:
    if len(record.entries) == 1:
        return [f"[{record.index:04X}]", *_entry(record.entries[0])]
    lines = [
        f"[{record.index:04X}]",
        f"ParameterName={record.name}",
        f"ObjectType=0x{_ARRAY if record.array else _RECORD:X}",
        f"SubNumber={len(record.entries)}",
        "",
    ]
    for entry in record.entries:
        lines += [f"[{record.index:04X}sub{entry.key & 0xFF:X}]", *_entry(entry)]
    return lines


def _entry(entry: Entry) -> list[str]:
    lines = [
        f"ParameterName={entry.name}",
        f"ObjectType=0x{_VARIABLE:X}",
        f"DataType=0x{entry.kind:04X}",
        f"AccessType={entry.access}",
        f"DefaultValue={_value(entry, entry.default)}",
        f"PDOMapping={int(entry.receive or entry.transmit)}",
    ]
    limits = {"LowLimit": entry.low, "HighLimit": entry.high}
    lines += [f"{name}={limit}" for name, limit in limits.items() if limit is not None]
    return [*lines, ""]


def _value(entry: Entry, value: Value) -> str:
    if entry.node_relative and isinstance(value, int):
        return f"$NODEID+0x{value:X}"
    if entry.kind is DataType.U32 and isinstance(value, int) and value > 0xFFFF:
        return f"0x{value:08X}"
    return str(value)


if __name__ == "__main__":
    EDS_FILE.write_text(eds_text(), encoding="ascii")
    sys.stdout.write(f"{EDS_FILE}\n")
