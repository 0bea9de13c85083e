"""An index beside files that are written once: what was read of each, kept in SQLite, so that it is read only once.

The files are the truth: an index that is lost, spoilt, of another version, or in a place where it cannot be written
costs nothing but time; so does a process killed between a file and its row.

SQLite keeps its rollback journal and no write-ahead log: that one needs memory shared by all readers, which network
file systems do not give. Nor does anything depend on its locks: every row follows from one file that never changes.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

_VERSION = 1
_BUSY_S = 30.0

_AT_ONCE = 200  # files read between two commits: an interrupted reading of thousands goes on where it was


class Index:
    """JSON values by kind and name in a database that need not exist; ``told`` how many of how many files were read."""

    def __init__(self, path: Path, told: Callable[[int, int], None]) -> None:
        self._path = path
        self._told = told

    def values(self, kind: str, names: Sequence[str], read: Callable[[str], Any]) -> dict[str, Any]:
        """The value of every name, in their order; what is not kept is read, and kept. Raises as ``read`` does."""
        if not names:
            return {}
        try:
            return self._values(kind, names, read)
        except sqlite3.OperationalError:  # locked for long, no permission, disk full: do without
            return {name: read(name) for name in names}
        except (sqlite3.DatabaseError, json.JSONDecodeError):  # spoilt
            with suppress(OSError):
                self._path.unlink()
            return self._values(kind, names, read)

    def _values(self, kind: str, names: Sequence[str], read: Callable[[str], Any]) -> dict[str, Any]:
        with closing(self._open()) as database:
            rows = database.execute("SELECT name, value FROM kept WHERE kind = ? AND name >= ?", (kind, min(names)))
            found = dict(rows.fetchall())
            missing = [name for name in names if name not in found]
            for start in range(0, len(missing), _AT_ONCE):
                batch = []
                for name in missing[start : start + _AT_ONCE]:
                    found[name] = json.dumps(read(name))
                    batch.append((kind, name, found[name]))
                    self._told(start + len(batch), len(missing))
                # It only saves time: a store that may not be written stays as it is.
                with suppress(sqlite3.OperationalError), database:
                    database.executemany("INSERT OR REPLACE INTO kept VALUES (?, ?, ?)", batch)
        return {name: json.loads(found[name]) for name in names}

    def _open(self) -> sqlite3.Connection:
        try:
            database = sqlite3.connect(self._path, timeout=_BUSY_S)
            version = _version(database)
        except sqlite3.OperationalError:
            database, version = sqlite3.connect(":memory:"), 0
        if version != _VERSION:
            with database:
                database.execute("BEGIN IMMEDIATE")
                if _version(database) != _VERSION:  # else another process was faster
                    database.execute("DROP TABLE IF EXISTS kept")
                    database.execute("CREATE TABLE kept (kind TEXT, name TEXT, value TEXT, PRIMARY KEY (kind, name))")
                    database.execute(f"PRAGMA user_version = {_VERSION}")
        return database


def _version(database: sqlite3.Connection) -> int:
    return int(database.execute("PRAGMA user_version").fetchone()[0])
