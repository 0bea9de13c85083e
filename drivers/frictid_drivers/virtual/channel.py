"""A virtual bus on the wall clock belongs to one process at a time, like a real one: locks, and where files live."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

import filelock

from frictid_hil.errors import HardwareBusy, HardwareError

_UNSAFE = re.compile(r"[^A-Za-z0-9._-]")


def runtime_folder() -> Path:
    """Where locks and sockets live: ``$FRICTID_RUNTIME_DIR``, ``$XDG_RUNTIME_DIR``, or a temporary folder per user.

    ``HardwareError`` where it cannot be created, or others may write to it.
    """
    own = os.environ.get("FRICTID_RUNTIME_DIR")
    session = os.environ.get("XDG_RUNTIME_DIR")
    if own:
        folder = Path(own)
    elif session and Path(session).is_dir():
        folder = Path(session) / "frictid-hil"
    else:
        folder = Path(tempfile.gettempdir()) / f"frictid-hil-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise HardwareError(
            f"cannot create the folder of the virtual bus: {error.strerror}",
            where=str(folder),
            next_step="set FRICTID_RUNTIME_DIR to a folder you may write to",
        ) from None
    # Everybody may put something under this name into a folder for all.
    if folder.parent == Path(tempfile.gettempdir()) and {folder.lstat().st_uid, folder.stat().st_uid} != {os.getuid()}:
        raise HardwareError(
            "is not a folder of yours: somebody else has put something there under this name",
            where=str(folder),
            next_step="set FRICTID_RUNTIME_DIR to a folder of your own",
        )
    return folder


def channel_name(bus: str) -> str:
    """``virtual:hp3j`` to ``hp3j``; the part after the colon, usable as a file name."""
    return _UNSAFE.sub("_", bus.partition(":")[2]) or "frictid"


def socket_path(channel: str) -> Path:
    """The Unix socket of a channel whose drives run in a process of their own."""
    return runtime_folder() / f"{_UNSAFE.sub('_', channel)}.sock"


def take(channel: str) -> filelock.BaseFileLock:
    """Take the channel for this process, and return its lock to release.

    ``HardwareBusy`` where another process, or another driver of this one, has it; ``HardwareError`` without its file.
    """
    path = runtime_folder() / f"{channel}.lock"
    lock = filelock.FileLock(path, timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise HardwareBusy(
            f"the virtual bus {channel!r} is in use",
            where=f"virtual:{channel}",
            cause="another run on the same robot is under way",
            next_step="wait for it to end, or give this one a bus of its own with --bus virtual:NAME",
        ) from None
    except OSError as error:
        raise HardwareError(
            f"cannot lock the virtual bus: {error.strerror}",
            where=str(path),
            next_step="set FRICTID_RUNTIME_DIR to a folder you may write to",
        ) from None
    return lock
