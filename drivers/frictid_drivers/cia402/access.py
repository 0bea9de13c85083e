"""Objects of one drive, whatever carries them: typed, read back after every write, remembered, with telling errors."""

from __future__ import annotations

import contextlib
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace

from frictid_drivers.cia402.objects import IntegerType, Object
from frictid_drivers.cia402.quirks import NO_QUIRKS, Quirks
from frictid_hil.errors import HardwareError

_ABSENT = {0x06020000, 0x06090011, 0x08000024, 0x06010000, 0x06010001, 0x08000000}
"""Abort codes that say "there is no such object", "no such sub-index", "no data", "unsupported access", "write only" -
and "general error", by which some drives say any of these."""

_OTHER_LENGTH = {0x06070010, 0x06070012, 0x06070013}  # abort codes that say "another length of this object"

_COMMANDS = {0x6040, 0x6060, 0x6071, 0x607A, 0x60B2, 0x60C1, 0x60FF}  # what a run commands, and nobody wants back


class Aborted(Exception):
    """What a transport raises where the drive answers an access with an abort code."""

    def __init__(self, code: int, said: str) -> None:
        super().__init__(said)
        self.code = code


class RefusedByDrive(HardwareError):
    """A drive does not take a setting: ``value`` for ``item`` (which do not cross a process border)."""

    def __init__(self, what: str, item: Object | None = None, value: int = 0, **details: str) -> None:
        super().__init__(what, **details)
        self.item, self.value = item, value


@dataclass(frozen=True, slots=True)
class Write:
    """One setting as it shall be: what `check` foresees and what ``configure`` does."""

    item: Object
    value: int
    otherwise: str = ""  # what it means where the drive does not take it, the run goes on; "" where the run ends
    instead: tuple[int, ...] = ()  # values that would do as well, in this order
    mask: int = -1  # bits that must read back as written; drives keep some bits of a COB-ID to themselves
    maps: Object | None = None

    @property
    def values(self) -> tuple[int, ...]:
        """All that will do, best first."""
        return (self.value, *self.instead)


class Drive(ABC):
    """Objects of one node."""

    def __init__(self, node_id: int, joint: str) -> None:
        self.node_id = node_id
        self.joint = joint
        self._confirmed: dict[tuple[int, int], int | None] = {}
        self._before: list[tuple[Object, int]] = []
        self._told_bits: dict[tuple[int, int], int] = {}
        self.quirks = NO_QUIRKS

    @abstractmethod
    def upload(self, index: int, sub: int) -> bytes:
        """The bytes of an object; ``Aborted`` where the drive says no, ``HardwareError`` where it does not answer."""

    @abstractmethod
    def download(self, index: int, sub: int, data: bytes) -> None:
        """Give an object its bytes; raises as ``upload`` does."""

    @abstractmethod
    def answering_within(self, timeout_s: float) -> contextlib.AbstractContextManager[None]:
        """Wait for answers no longer than this meanwhile."""

    def learn(self, quirks: Quirks) -> None:
        """Take over what is known of this drive."""
        self.quirks = quirks

    def where(self, address: str) -> str:
        """How errors name an object of this drive."""
        return f"joint {self.joint} (node {self.node_id}), object {address}"

    def read(self, item: Object) -> int:
        """Value of an object that must be there; ``HardwareError`` where it is absent, or no answer comes."""
        value = self.find(item)
        if value is None:
            raise HardwareError(
                f"the drive has no {item.name}",
                where=self.where(item.address),
                cause="another drive than expected, or another firmware",
                next_step="compare the drive's EDS with docs/reference/canopen-settings.md",
            )
        return value

    def find(self, item: Object) -> int | None:
        """Value of an object, None where it is absent; ``HardwareError`` without an answer, or refused otherwise."""
        data = self._upload(item.index, item.sub, item.address)
        if data is None:
            return None
        bits = self._told_bits[item.index, item.sub] = 8 * len(data)
        # Four bytes may be a shorter object's, from a drive that leaves the length out of its answer.
        if bits < self.quirks.typed(item).type.bits and bits in (8, 16):
            self._learn_bits(item, bits)
        kind = self.quirks.typed(item).type
        try:
            return kind.unpack(data)
        except struct.error as error:
            raise HardwareError(
                f"answered with {len(data)} bytes, expected a {kind}",
                where=self.where(item.address),
                cause="the drive's object has another type than CiA 402 gives it",
            ) from error

    def find_text(self, index: int) -> str:
        """A string object, "" where the drive does not have it."""
        data = self._upload(index, 0, f"{index:04X}:00")
        return "" if data is None else data.rstrip(b"\0").decode("ascii", "replace").strip()

    def has(self, item: Object) -> bool:
        """The drive has this object; asked once."""
        return self.known(item) is not None

    def known(self, item: Object) -> int | None:
        """What was last written and read back, or read; asked once, None where the drive does not have it."""
        key = (item.index, item.sub)
        if key not in self._confirmed:
            self._confirmed[key] = self.find(item)
        return self._confirmed[key]

    def apply(self, writes: Iterable[Write]) -> list[str]:
        """Bring about what is not yet so, in order; what the run goes on without, in words, or ``RefusedByDrive``."""
        said = []
        for write in writes:
            refused: RefusedByDrive | None = None
            for value in write.values:
                if self.known(write.item) == value:
                    break
                if self._refusal(write.item, value):
                    continue
                try:
                    self.write(write.item, value, write.mask)
                    break
                except RefusedByDrive as error:
                    refused = refused or error
                    self._confirmed.pop((write.item.index, write.item.sub), None)
            else:
                why = refused.what if refused else self._why_not(write)
                if not write.otherwise:
                    raise refused or RefusedByDrive(why, write.item, write.value, where=self.where(write.item.address))
                said.append(f"{write.otherwise} ({why})")
        return said

    def foresee(self, writes: Iterable[Write]) -> tuple[list[str], list[str]]:
        """What ``apply`` would raise and return, by reading alone: quirks and EDS files tell what will be refused."""
        fatal: list[str] = []
        lost: list[str] = []
        for write in writes:
            found = self.known(write.item)
            refused = all(self._refusal(write.item, value) for value in write.values)
            cannot_map = write.maps is not None and not self._maps(write.maps)
            if found is not None and (found in write.values or not (refused or cannot_map)):
                continue
            why = self._why_not(write)
            if write.otherwise:
                lost.append(f"{write.otherwise} ({why})")
            else:
                fatal.append(why)
        return fatal, lost

    def _why_not(self, write: Write) -> str:
        if self.known(write.item) is None:
            return f"the drive has no {write.item}"
        if write.maps is not None:
            return f"{write.maps} cannot be mapped into a PDO"
        refusal = self._refusal(write.item, write.value)
        return f"the drive does not take {write.item} = {_shown(write.item, write.value)}: {refusal}"

    def _maps(self, item: Object) -> bool:
        return self.quirks.maps(item) and self.quirks.typed(item) == item

    def _refusal(self, item: Object, value: int) -> str:
        kind = self.quirks.typed(item).type
        fits = kind.low <= value <= kind.high
        return self.quirks.refusal(item, value) or ("" if fits else f"it is a {kind} ({kind.low}..{kind.high})")

    def _learn_bits(self, item: Object, bits: int) -> None:
        kind = IntegerType(item.type.signed, bits)
        self.quirks = replace(self.quirks, types={**self.quirks.types, (item.index, item.sub): kind})

    def restore(self) -> None:
        """Undo this run's writes, the last first; what is not taken back stays. ``HardwareError`` without an answer."""
        before, self._before = self._before, []
        for item, value in reversed(before):
            with contextlib.suppress(RefusedByDrive):
                self.write_blind(item, value)

    def write(self, item: Object, value: int, mask: int = -1) -> None:
        """Write and read back what is not confirmed yet; ``HardwareError`` where refused, or ``mask`` differs."""
        before = self.known(item)
        if before == value:
            return
        self.write_blind(item, value)
        if before is not None and item.index not in _COMMANDS:
            # Our own watch, left over from a run that was cut off, is not brought back.
            ours = item.index == 0x1016 and before >> 16 == value >> 16
            self._before.append((item, 0 if ours else before))
        found = self.read(item)
        if (found ^ value) & mask:
            what = f"{item.name}: wrote {_shown(item, value)}, read back {_shown(item, found)}"
            raise self._refused(item, value, what, "the drive limits, rounds or locks this setting")
        self._confirmed[item.index, item.sub] = value

    def write_blind(self, item: Object, value: int) -> None:
        """Write without reading back (objects that change by themselves); ``HardwareError`` where refused."""
        self._confirmed.pop((item.index, item.sub), None)
        item = self.quirks.typed(item)
        if not item.type.low <= value <= item.type.high:
            what = f"{item.name}: {value} does not fit a {item.type} ({item.type.low}..{item.type.high})"
            raise self._refused(item, value, what, "a setting of the robot file is beyond what the drive can hold")
        try:
            self.download(item.index, item.sub, item.type.pack(value))
        except Aborted as error:
            told_bits = self._told_bits.get((item.index, item.sub), 0)
            if error.code in _OTHER_LENGTH and told_bits in (16, 32) and told_bits > item.type.bits:
                self._learn_bits(item, told_bits)
                self.write_blind(item, value)
                return
            what = f"the drive refuses {item.name} = {_shown(item, value)}: {error}"
            cause = "an object the drive lacks, a value it does not support, or a state in which it cannot be set"
            raise self._refused(item, value, what, cause) from error

    def _refused(self, item: Object, value: int, what: str, cause: str) -> RefusedByDrive:
        next_step = "see the drive's manual on this object; nothing has moved"
        return RefusedByDrive(what, item, value, where=self.where(item.address), cause=cause, next_step=next_step)

    def forget(self, *items: Object) -> None:
        """These were changed by other means than SDO; with none given, all may have been (the drive was reset)."""
        if not items:
            self._confirmed.clear()
            self._before.clear()
        for item in items:
            self._confirmed.pop((item.index, item.sub), None)

    def _upload(self, index: int, sub: int, address: str) -> bytes | None:
        try:
            return self.upload(index, sub)
        except Aborted as error:
            if error.code in _ABSENT:
                return None
            raise HardwareError(f"the drive refuses to be read: {error}", where=self.where(address)) from error


def _shown(item: Object, value: int) -> str:
    return f"{value:#0{2 + item.type.bits // 4}x}" if item.type.bits == 32 and not item.type.signed else str(value)
