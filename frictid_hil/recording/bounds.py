"""How much memory a file may ask for: small files that unpack to gigabytes are refused before they are unpacked.

Limits: 2 GB of unpacked data in one file, and above 64 MB no more than 100 times the size of the file; 10,000,000 rows.
"""

from __future__ import annotations

from frictid_hil.errors import InputFileError

MAX_BYTES = 2_000_000_000
FREE_BYTES = 64_000_000
MAX_RATIO = 100
MAX_ROWS = 10_000_000


def allowed_bytes(packed: int) -> int:
    """What a file of ``packed`` bytes may unpack to."""
    return min(MAX_BYTES, max(FREE_BYTES, MAX_RATIO * packed))


def check_expansion(packed: int, unpacked: int, where: str) -> None:
    """Refuse, by an ``InputFileError``, a file of which more came out, or is said to, than is allowed."""
    if unpacked > allowed_bytes(packed):
        raise InputFileError(
            f"{packed:,} bytes that unpack to {unpacked:,} or more; at most {allowed_bytes(packed):,} are read",
            where=where,
            cause=f"the limit is {MAX_BYTES / 1e9:g} GB, and {MAX_RATIO} times the file above {FREE_BYTES / 1e6:g} MB",
            next_step="if the file is sound, split it or write it uncompressed",
        )


def check_rows(rows: int, where: str) -> None:
    """Refuse a table of more than ``MAX_ROWS`` rows by an ``InputFileError``."""
    if rows > MAX_ROWS:
        raise InputFileError(f"more than {MAX_ROWS:,} rows", where=where, next_step="split the recording")
