"""The profile store: every profile a robot ever had, which one is active, and how that came to be.

::

    <root>/<robot>/
        profiles/<UTC>-<hash>.yaml   named by content, written once, never changed
        index.jsonl                  a summary line per profile; can be rebuilt from the profiles
        promotions.jsonl             a line per promotion, rollback and pinned baseline; the last whole line rules

A profile is on the disk before a line names it, and a line counts once its last byte is there. A process killed at any
moment therefore leaves the old active profile or the new one, whole; what it left unfinished is passed over by readers
and tidied by the next writer. Writers exclude each other by a lock that dies with its process; readers need none.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Collection, Iterator, Sequence, Set
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import filelock

from frictid_hil.config.profile import FrictionProfile, load_profile
from frictid_hil.config.provenance import utc_now
from frictid_hil.config.search import user_data_dir
from frictid_hil.errors import ConfigError, FrictidError, UsageError
from frictid_hil.files import could_not_write, write_whole
from frictid_hil.profiles.journal import append_line, append_lines, journal_lines
from frictid_hil.profiles.promotions import Promotion, active_stack, baseline_of, promotions_in
from frictid_hil.profiles.summary import Reference, Stored, TrendPoint, line_of, stored_of, summary

_LOCK_TIMEOUT_S = 30.0
_ID = re.compile(r"\d{8}T\d{6}Z-[0-9a-f]{12}")


class ProfileStore:
    """All robots' profiles below one folder.

    Args:
        root: the folder; the user's data folder unless told. It is made when something is added.
        told: how many of how many profiles were read so far, where all of them have to be.
    """

    def __init__(self, root: Path | None = None, told: Callable[[int, int], None] | None = None) -> None:
        self.root = user_data_dir() / "store" if root is None else root
        self._told = told or (lambda done, of: None)

    def robots(self) -> list[str]:
        """Names of the robots that have profiles here, sorted."""
        return sorted(path.name for path in self.root.glob("*") if (path / "profiles").is_dir())

    def add(self, profile: FrictionProfile) -> str:
        """Keep a profile; adding the same bytes again changes nothing.

        Returns:
            Its id.

        Raises:
            FrictidError: disk full, no permission, or another process holds the store for too long.
        """
        text = profile.to_yaml().encode()
        sha256 = hashlib.sha256(text).hexdigest()
        utc = re.sub(r"[-:]", "", profile.provenance.created_utc)
        identity = f"{utc}-{sha256[:12]}"
        with self._locked(profile.robot) as folder:
            _tidy(folder)
            path = _profile_path(folder, identity)
            if path.exists():
                return identity
            write_whole(path, text)
            path.chmod(0o444)
            # A crash just here costs nothing: `history` finds the profile and writes its line.
            append_line(folder / "index.jsonl", line_of(summary(identity, profile, self._reference(profile.robot))))
        return identity

    def path(self, robot: str, identity: str) -> Path:
        """The file of a profile.

        Args:
            robot: name.
            identity: id, or a beginning of one that fits no other.

        Raises:
            UsageError: there is none, or more than one.
        """
        folder = self._folder(robot)
        if _ID.fullmatch(identity) and (whole := _profile_path(folder, identity)).exists():
            return whole  # a store may hold ten thousand: look at the folder only for a beginning of an id
        found = [name for name in _profile_ids(folder) if name.startswith(identity)]
        if len(found) != 1 or not identity:
            count = "no profile" if not found else f"{len(found)} profiles"
            raise UsageError(
                f"{count} of {robot} with id {identity!r} in the store",
                where=str(folder),
                next_step=f"see `frictid-hil profile history {robot}`",
            )
        return _profile_path(folder, found[0])

    def load(self, robot: str, identity: str) -> FrictionProfile:
        """A profile by its id (or the beginning of it).

        Raises:
            UsageError: there is none.
            ConfigError: its file is not what was added.
        """
        path = self.path(robot, identity)
        _unchanged_bytes(path)
        return load_profile(path)

    def active(self, robot: str) -> Promotion | None:
        """What is active, and since when; None where nothing was ever promoted."""
        stack = active_stack(self.promotions(robot))
        return stack[-1] if stack else None

    def active_profile(self, robot: str) -> FrictionProfile | None:
        """The active profile itself; None where nothing was ever promoted."""
        active = self.active(robot)
        return None if active is None else self.load(robot, active.id)

    def baseline(self, robot: str) -> str | None:
        """Id of the profile that drift is measured from: the pinned one, else the first ever promoted."""
        return baseline_of(self.promotions(robot))

    def promote(self, robot: str, identity: str, *, by: str = "", reason: str = "") -> Promotion:
        """Make a stored profile the active one; promoting the active one again changes nothing.

        Raises:
            UsageError: there is none of that id.
            FrictidError: as ``add``.
        """
        first = self.active(robot) is None
        promotion = self._write_promotion("promote", robot, identity, by, reason)
        if first:
            self.rebuild_index(robot)
        return promotion

    def pin_baseline(self, robot: str, identity: str, *, by: str = "", reason: str = "") -> Promotion:
        """Measure drift from this profile from now on; what is active stays.

        Raises:
            UsageError: there is none of that id, or nothing was promoted yet.
        """
        if self.active(robot) is None:
            raise UsageError(f"no profile of {robot} was promoted yet", where=str(self._folder(robot)))
        pinned = self._write_promotion("baseline", robot, identity, by, reason)
        self.rebuild_index(robot)
        return pinned

    def rollback(self, robot: str, *, by: str = "", reason: str = "") -> Promotion:
        """Make the profile active again that was so before the present one; again for the one before that.

        Raises:
            UsageError: there is none before.
        """
        with self._locked(robot) as folder:
            stack = active_stack(self.promotions(robot))
            if len(stack) < 2:
                raise UsageError(
                    f"no profile of {robot} was active before the present one",
                    where=str(folder),
                    next_step=f"see `frictid-hil profile history {robot}` and promote one by its id",
                )
            line = Promotion("rollback", stack[-2].id, stack[-2].sha256, utc_now(), by, reason)
            self.load(robot, line.id)
            append_line(folder / "promotions.jsonl", asdict(line))
        return line

    def promotions(self, robot: str) -> list[Promotion]:
        """The journal, oldest first."""
        return promotions_in(self._folder(robot) / "promotions.jsonl")

    def history(self, robot: str) -> list[Stored]:
        """Every profile of a robot, oldest first; those that the index lost are read anew, and noted for next time.

        Raises:
            ConfigError: the file of one that the index lost was changed.
        """
        folder = self._folder(robot)
        present = _profile_ids(folder)
        index = _index(folder, robot, present)
        if len(index) < len(present):
            found = self._measured(robot, present - index.keys())
            index |= {stored.id: stored for stored in found}
            self._note(robot, found)
        return [index[identity] for identity in sorted(index)]

    def rebuild_index(self, robot: str) -> None:
        """Write the index anew from the profiles; needed where it was lost, and when the baseline changes.

        Raises:
            ConfigError: a profile's file was changed.
        """
        with self._locked(robot) as folder:
            every = self._measured(robot, _profile_ids(folder))
            write_whole(folder / "index.jsonl", "".join(json.dumps(line_of(stored)) + "\n" for stored in every))

    def trends(self, robot: str) -> dict[str, list[TrendPoint]]:
        """F_0, curve distance and temperature of every joint over all profiles, oldest first."""
        baseline = self.baseline(robot)
        history = {stored.id: stored for stored in self.history(robot)}
        stale = {stored.id for stored in history.values() if stored.baseline != baseline}
        if stale:
            measured_anew = self._measured(robot, stale)
            history |= {stored.id: stored for stored in measured_anew}
            self._note(robot, measured_anew)
        trends: dict[str, list[TrendPoint]] = {}
        for stored in history.values():
            for name, joint in stored.joints.items():
                trends.setdefault(name, []).append(TrendPoint(stored.id, stored.created_utc, joint))
        return trends

    def _folder(self, robot: str) -> Path:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", robot):
            raise UsageError(f"{robot!r} is no name of a robot")
        return self.root / robot

    def _write_promotion(self, action: str, robot: str, identity: str, by: str, reason: str) -> Promotion:
        with self._locked(robot) as folder:
            path = self.path(robot, identity)
            active = self.active(robot)
            if action == "promote" and active is not None and active.id == path.stem:
                return active
            self.load(robot, path.stem)  # what is promoted must be readable
            sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
            line = Promotion(action, path.stem, sha256, utc_now(), by, reason)
            append_line(folder / "promotions.jsonl", asdict(line))
        return line

    def _reference(self, robot: str) -> Reference:
        baseline = self.baseline(robot)
        return Reference(baseline, None if baseline is None else self.load(robot, baseline))

    def _measured(self, robot: str, identities: Collection[str]) -> list[Stored]:
        """Summaries from the profiles themselves, against the baseline of today, oldest first."""
        reference, found = self._reference(robot), []
        for identity in sorted(identities):
            found.append(summary(identity, self.load(robot, identity), reference))
            self._told(len(found), len(identities))
        return found

    def _note(self, robot: str, found: Sequence[Stored]) -> None:
        """Add lines to the index; it only saves time, so a store that may not be written stays as it is."""
        with suppress(FrictidError), self._locked(robot) as folder:
            append_lines(folder / "index.jsonl", [line_of(stored) for stored in found])

    @contextmanager
    def _locked(self, robot: str) -> Iterator[Path]:
        folder = self._folder(robot)
        try:
            (folder / "profiles").mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(folder / ".lock", timeout=_LOCK_TIMEOUT_S)
            with lock:
                yield folder
        except filelock.Timeout:
            raise FrictidError(
                f"another process has held the profile store for {_LOCK_TIMEOUT_S:.0f} s",
                where=str(folder),
                next_step="see who with `lsof`; the lock ends with that process",
            ) from None
        except OSError as error:
            raise could_not_write(folder, error) from error


def _index(folder: Path, robot: str, present: Set[str]) -> dict[str, Stored]:
    """The summaries whose profiles are there, by id."""
    index = {}
    for line in journal_lines(folder / "index.jsonl"):
        stored = stored_of(line, robot)
        if stored is not None and stored.id in present:
            index[stored.id] = stored
    return index


def _unchanged_bytes(path: Path) -> bytes:
    """The bytes of a stored profile, seen to be those that were stored."""
    raw = path.read_bytes()
    if not path.stem.endswith(hashlib.sha256(raw).hexdigest()[:12]):
        raise ConfigError(
            "the file was changed after it was stored",
            where=str(path),
            next_step="restore it from a backup, or roll back to another profile",
        )
    return raw


def _profile_path(folder: Path, identity: str) -> Path:
    return folder / "profiles" / f"{identity}.yaml"


def _profile_ids(folder: Path) -> set[str]:
    """Ids of the profiles on disk."""
    try:
        names = [path.name for path in (folder / "profiles").iterdir()]
    except FileNotFoundError:
        return set()
    except OSError as error:
        raise FrictidError(f"cannot be read: {error.strerror}", where=str(folder)) from error
    return {name[:-5] for name in names if name.endswith(".yaml") and _ID.fullmatch(name[:-5])}


def _tidy(folder: Path) -> None:
    """Remove what killed writers had staged; only under the lock."""
    for staged in [*folder.glob(".*.part"), *(folder / "profiles").glob(".*.part")]:
        staged.unlink(missing_ok=True)
