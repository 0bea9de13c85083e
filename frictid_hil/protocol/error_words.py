"""What a drive's error code says, in words: the classes of CiA 301 and CiA 402, the finer one first."""

from __future__ import annotations

_LATE = "the drive missed this program's heartbeat or SYNC: the computer was late, stopped, or the bus was cut"

_WORDS: dict[int, str] = {
    0x8100: _LATE,
    0x8110: "CAN overrun: frames were lost in the drive",
    0x8120: "the drive's CAN controller went error-passive: wiring, termination or bit rate",
    0x8130: _LATE,
    0x8140: "the drive came back from bus-off: wiring, termination or bit rate",
    0x8150: "two devices on the bus send the same identifier",
    0x8200: "the drive did not understand a frame",
    0x8210: "a PDO of ours was too short for the drive's mapping",
    0x8240: "SYNC had another length than the drive expects",
    0x8250: "the drive missed our set-points (RPDO timeout): the computer was late, or the bus was cut",
    0x8400: "overspeed",
    0x8500: "position control",
    0x8600: "positioning controller",
    0x8611: "following error: blocked, too weak, or too narrow a window (6065)",
    0x8612: "a limit switch or a software position limit (607D) was reached",
    0x8700: "the drive missed SYNC: the computer was late, or the bus was cut",
    0x2000: "current: a short circuit, or an overload",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3200: "DC link voltage: overvoltage when braking, or too weak a supply",
    0x4000: "temperature: let it cool, look at load and ventilation",
    0x5000: "the drive's hardware",
    0x6000: "the drive's software or its parameters",
    0x7000: "additional modules",
    0x7100: "power stage, or brake",
    0x7300: "sensor: encoder, resolver or their cable",
    0x9000: "an external error input",
    0xF000: "the vendor's own",
}


def error_words(code: int) -> str:
    """What an error code of 603F or EMCY means as far as the standards say, "" where they do not.

    Source: CiA 301, table of emergency error codes; CiA 402, object 603Fh.
    """
    for mask in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        words = _WORDS.get(code & mask)
        if words:
            return words
    return ""


def told_error(code: int) -> str:
    """The code with its words: ``0x8611 (following error ...)``."""
    words = error_words(code)
    return f"{code:#06x} ({words})" if words else f"{code:#06x}"
