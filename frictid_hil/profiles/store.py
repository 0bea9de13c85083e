"""The profile store: every profile a robot ever had, which one is active, and how that came to be.

::

    <root>/<robot>/
        profiles/<UTC>-<hash>.yaml         named by content
        promotions/000001.yaml             a promotion, rollback or pinned baseline each; the last one rules
        recalibrations/<UTC>-<hash>.yaml   how a night ended
        index.sqlite                       what was read of all these; made anew where it is lost

Each file is written once, whole or not at all: a process killed at any moment leaves the old active profile or the new
one, and what is unfinished is passed over by readers and tidied by the next writer. Writers exclude each other by a
lock that dies with its process; readers need none.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import filelock

from frictid_hil.config.profile import FrictionProfile, load_profile
from frictid_hil.config.provenance import utc_now
from frictid_hil.config.schema import schema_version
from frictid_hil.config.search import user_data_dir
from frictid_hil.config.write import dump
from frictid_hil.config.yaml import read
from frictid_hil.errors import ConfigError, FrictidError, UsageError
from frictid_hil.files import could_not_write, write_whole
from frictid_hil.profiles import records
from frictid_hil.profiles.index import Index
from frictid_hil.profiles.records import Attempt, Promotion, Stored, TrendPoint

_LOCK_TIMEOUT_S = 30.0
_NAMES = {
    "profiles": re.compile(r"\d{8}T\d{6}Z-[0-9a-f]{12}"),
    "promotions": re.compile(r"\d{6}"),
    "recalibrations": re.compile(r"\d{8}T\d{6}Z-[0-9a-f]{12}"),
}
_NOTE = "frictid.store-note"

Note = TypeVar("Note", Promotion, Attempt)


class ProfileStore:
    """All robots' profiles below one folder, the user's data folder unless told. It is made when something is added.

    ``told`` is given how many of how many profiles were read so far, where all of them have to be.

    Raises:
        FrictidError: by all that writes: disk full, no permission, or another process holds the store for too long.
        UsageError: by all that takes an id: there is no profile of it, or more than one.
        ConfigError: by all that reads a profile: its file is not what was added.
    """

    def __init__(self, root: Path | None = None, told: Callable[[int, int], None] | None = None) -> None:
        self.root = user_data_dir() / "store" if root is None else root
        self._told = told or (lambda done, of: None)

    def robots(self) -> list[str]:
        """Names of the robots that have profiles here, sorted."""
        return sorted(path.name for path in self.root.glob("*") if (path / "profiles").is_dir())

    def add(self, profile: FrictionProfile) -> str:
        """Keep a profile, and give its id; adding the same bytes again changes nothing."""
        with self._locked(profile.robot) as folder:
            return _written(folder / "profiles", profile.provenance.created_utc, profile.to_yaml())

    def path(self, robot: str, identity: str) -> Path:
        """The file of a profile, by its id, or a beginning of one that fits no other."""
        folder = self._folder(robot)
        if _NAMES["profiles"].fullmatch(identity) and (whole := folder / "profiles" / f"{identity}.yaml").exists():
            return whole  # a store may hold ten thousand: look at the folder only for a beginning of an id
        found = [name for name in _names(folder, "profiles") if name.startswith(identity)]
        if len(found) != 1 or not identity:
            count = "no profile" if not found else f"{len(found)} profiles"
            raise UsageError(
                f"{count} of {robot} with id {identity!r} in the store",
                where=str(folder),
                next_step=f"see `frictid-hil profile history {robot}`",
            )
        return folder / "profiles" / f"{found[0]}.yaml"

    def load(self, robot: str, identity: str) -> FrictionProfile:
        """A profile by its id (or the beginning of it)."""
        path = self.path(robot, identity)
        if not path.stem.endswith(hashlib.sha256(path.read_bytes()).hexdigest()[:12]):
            raise ConfigError(
                "the file was changed after it was stored",
                where=str(path),
                next_step="restore it from a backup, or roll back to another profile",
            )
        return load_profile(path)

    def active(self, robot: str) -> Promotion | None:
        """What is active, and since when; None where nothing was ever promoted."""
        stack = records.active_stack(self.promotions(robot))
        return stack[-1] if stack else None

    def active_profile(self, robot: str) -> FrictionProfile | None:
        """The active profile itself; None where nothing was ever promoted."""
        active = self.active(robot)
        return None if active is None else self.load(robot, active.id)

    def baseline(self, robot: str) -> str | None:
        """Id of the profile that drift is measured from: the pinned one, else the first ever promoted."""
        return records.baseline_of(self.promotions(robot))

    def promote(self, robot: str, identity: str, *, by: str = "", reason: str = "") -> Promotion:
        """Make a stored profile the active one; promoting the active one again changes nothing."""
        with self._locked(robot) as folder:
            path = self.path(robot, identity)
            active = self.active(robot)
            if active is not None and active.id == path.stem:
                return active
            return self._noted(folder, "promote", path, by, reason)

    def pin_baseline(self, robot: str, identity: str, *, by: str = "", reason: str = "") -> Promotion:
        """Measure drift from this profile from now on; what is active stays, and must be there (``UsageError``)."""
        with self._locked(robot) as folder:
            if self.active(robot) is None:
                raise UsageError(f"no profile of {robot} was promoted yet", where=str(folder))
            return self._noted(folder, "baseline", self.path(robot, identity), by, reason)

    def rollback(self, robot: str, *, by: str = "", reason: str = "") -> Promotion:
        """Make the profile active again that was so before the present one; ``UsageError`` where there is none."""
        with self._locked(robot) as folder:
            stack = records.active_stack(self.promotions(robot))
            if len(stack) < 2:
                raise UsageError(
                    f"no profile of {robot} was active before the present one",
                    where=str(folder),
                    next_step=f"see `frictid-hil profile history {robot}` and promote one by its id",
                )
            return self._noted(folder, "rollback", self.path(robot, stack[-2].id), by, reason)

    def promotions(self, robot: str, last: int | None = None) -> list[Promotion]:
        """All of them, or the last few, oldest first."""
        return self._notes(Promotion, robot, "promotions", last)

    def note_attempt(self, robot: str, attempt: Attempt) -> None:
        """Keep how a recalibration ended."""
        with self._locked(robot) as folder:
            _written(folder / "recalibrations", attempt.utc, _note_text(attempt))

    def attempts(self, robot: str, last: int | None = None) -> list[Attempt]:
        """Recalibrations, all or the last few, oldest first."""
        return self._notes(Attempt, robot, "recalibrations", last)

    def count(self, robot: str) -> int:
        """How many profiles there are."""
        return len(_names(self._folder(robot), "profiles"))

    def history(self, robot: str, last: int | None = None) -> list[Stored]:
        """Profiles of a robot, all or the last few, oldest first; distances are from the baseline of today."""
        folder = self._folder(robot)
        names = _names(folder, "profiles")[-last if last else None :]
        baseline = self.baseline(robot)
        reference = None if baseline is None else self.load(robot, baseline)

        def read_anew(name: str) -> dict[str, Any]:
            return asdict(records.summary(name, self.load(robot, name), reference))

        # Distances are from the baseline: with another one, every profile is read anew, once.
        found = self._index(folder).values(f"profiles since {baseline}", names, read_anew)
        return [records.stored_of(values) for values in found.values()]

    def trends(self, robot: str) -> dict[str, list[TrendPoint]]:
        """F_0, curve distance and temperature of every joint over all profiles, oldest first."""
        trends: dict[str, list[TrendPoint]] = {}
        for stored in self.history(robot):
            for name, joint in stored.joints.items():
                trends.setdefault(name, []).append(TrendPoint(stored.id, stored.created_utc, joint))
        return trends

    def _folder(self, robot: str) -> Path:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", robot):
            raise UsageError(f"{robot!r} is no name of a robot")
        return self.root / robot

    def _noted(self, folder: Path, action: str, profile: Path, by: str, reason: str) -> Promotion:
        """Write a promotion; only under the lock."""
        self.load(folder.name, profile.stem)  # what is promoted must be readable
        sha256 = hashlib.sha256(profile.read_bytes()).hexdigest()
        note = Promotion(action, profile.stem, sha256, utc_now(), by, reason)
        number = int(max(_names(folder, "promotions"), default="0")) + 1
        _write_once(folder / "promotions" / f"{number:06d}.yaml", _note_text(note))
        return note

    def _notes(self, kind: type[Note], robot: str, where: str, last: int | None) -> list[Note]:
        folder = self._folder(robot)
        names = _names(folder, where)[-last if last else None :]
        kept = self._index(folder).values(where, names, lambda name: _note(folder / where, name, kind))
        return [kind(**values) for values in kept.values()]

    def _index(self, folder: Path) -> Index:
        return Index(folder / "index.sqlite", self._told)

    @contextmanager
    def _locked(self, robot: str) -> Iterator[Path]:
        folder = self._folder(robot)
        try:
            for name in _NAMES:
                (folder / name).mkdir(parents=True, exist_ok=True)
            with filelock.FileLock(folder / ".lock", timeout=_LOCK_TIMEOUT_S):
                for staged in folder.glob("*/.*.part"):  # left by killed writers
                    staged.unlink(missing_ok=True)
                yield folder
        except filelock.Timeout:
            raise FrictidError(
                f"another process has held the profile store for {_LOCK_TIMEOUT_S:.0f} s",
                where=str(folder),
                next_step="see who with `lsof`; the lock ends with that process",
            ) from None
        except OSError as error:
            raise could_not_write(folder, error) from error


def _names(folder: Path, kind: str) -> list[str]:
    """Names of the files of a kind, sorted: by time, or by number."""
    try:
        names = [path.name for path in (folder / kind).iterdir()]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise FrictidError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return sorted(name[:-5] for name in names if name.endswith(".yaml") and _NAMES[kind].fullmatch(name[:-5]))


def _written(folder: Path, utc: str, text: str) -> str:
    """Write a file named by its time and content, unless it is there; its name."""
    name = f"{re.sub(r'[-:]', '', utc)}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    path = folder / f"{name}.yaml"
    if not path.exists():
        _write_once(path, text)
    return name


def _write_once(path: Path, text: str) -> None:
    write_whole(path, text)
    path.chmod(0o444)


def _note_text(note: Promotion | Attempt) -> str:
    return dump({"schema": f"{_NOTE}/1", **asdict(note)})


def _note(folder: Path, name: str, kind: type[Note]) -> dict[str, Any]:
    document = read(folder / f"{name}.yaml")
    schema_version(document, _NOTE, 1)
    values = document.data
    del values["schema"]
    try:
        kind(**values)
    except TypeError as error:
        raise ConfigError(f"not what the store wrote: {error}", where=str(document.path)) from None
    return values
