"""What a drive says of itself, read once and without a single write; ``scale`` makes joint-side figures of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from frictid_drivers.cia402 import objects as od
from frictid_drivers.cia402.quirks import NO_QUIRKS, Quirks
from frictid_hil.plan.mode import Mode


@dataclass(frozen=True, slots=True)
class Facts:
    """As read; None where the drive does not have the object."""

    device_type: int
    vendor: int
    product: int
    revision: int
    serial: int
    name: str
    hardware: str
    software: str
    modes: int | None
    rated_torque_mnm: int | None
    encoder: tuple[int, int] | None
    gear: tuple[int, int] | None
    feed: tuple[int, int] | None
    position_unit: int | None
    velocity_unit: int | None
    polarity: int
    home_offset: int
    heartbeat_consumers: int | None
    sync_counter: bool
    torque_offset: bool
    target_torque: bool
    error_code: bool
    stops_alone: bool
    quirks: Quirks = NO_QUIRKS

    def supports(self, mode: int) -> bool:
        """6502 lists the mode; a drive without 6502 is taken at its word when the mode is set."""
        if mode == Mode.POSITION:
            return self._lists(mode) or self._lists(od.INTERPOLATED)
        return self._lists(mode) and (mode != Mode.TORQUE or self.target_torque)

    @property
    def position_mode(self) -> int:
        """6060 for positions: 8, or 7 where a drive has interpolated position mode only."""
        return od.INTERPOLATED if self._lists(od.INTERPOLATED) and not self._lists(Mode.POSITION) else Mode.POSITION

    @property
    def watchdog(self) -> bool:
        """The drive stops by itself when our heartbeat is missing: it listens for it, and can be told to act."""
        return bool(self.heartbeat_consumers) and self.stops_alone

    def _lists(self, mode: int) -> bool:
        return self.modes is None or bool(self.modes & od.MODE_BITS.get(mode, 0))


class Source(Protocol):
    """What can be asked for objects: a drive, or an EDS file."""

    def find(self, item: od.Object) -> int | None:
        """A value, None where there is none."""

    def find_text(self, index: int) -> str:
        """A text, "" where there is none."""


def read_facts(drive: Source, quirks_of: Callable[[int, int, int], Quirks] | None = None) -> Facts:
    """Ask the drive, and what is known of its kind; forty uploads, no download. ``HardwareError`` without an answer."""

    def pair(first: od.Object, second: od.Object) -> tuple[int, int] | None:
        a, b = drive.find(first), drive.find(second)
        return (a, b) if a and b else None

    def there(item: od.Object) -> bool:
        return drive.find(item) is not None

    device_type = drive.find(od.DEVICE_TYPE) or 0
    vendor, product, revision = (drive.find(item) or 0 for item in (od.VENDOR, od.PRODUCT, od.REVISION))
    return Facts(
        device_type=device_type,
        vendor=vendor,
        product=product,
        revision=revision,
        serial=drive.find(od.SERIAL) or 0,
        name=drive.find_text(od.DEVICE_NAME),
        hardware=drive.find_text(od.HARDWARE_VERSION),
        software=drive.find_text(od.SOFTWARE_VERSION),
        modes=drive.find(od.SUPPORTED_MODES),
        rated_torque_mnm=drive.find(od.RATED_TORQUE_MNM),
        encoder=pair(od.ENCODER_INCREMENTS, od.ENCODER_REVOLUTIONS),
        gear=pair(od.GEAR_MOTOR, od.GEAR_SHAFT),
        feed=pair(od.FEED, od.FEED_SHAFT),
        position_unit=drive.find(od.POSITION_UNIT),
        velocity_unit=drive.find(od.VELOCITY_UNIT),
        polarity=drive.find(od.POLARITY) or 0,
        home_offset=drive.find(od.HOME_OFFSET) or 0,
        heartbeat_consumers=drive.find(od.HEARTBEAT_CONSUMERS),
        sync_counter=there(od.SYNC_OVERFLOW) and there(od.pdo(True, 1, od.PDO_SYNC_START)),
        torque_offset=there(od.TORQUE_OFFSET),
        target_torque=there(od.TARGET_TORQUE),
        error_code=there(od.ERROR_CODE),
        stops_alone=there(od.ABORT_CONNECTION),
        quirks=quirks_of(vendor, product, revision) if quirks_of else NO_QUIRKS,
    )
