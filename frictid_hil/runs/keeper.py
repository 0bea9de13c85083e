"""Writes what is measured while it is measured: samples and frames of one part of a run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.recording.bus_log import BusLogWriter
from frictid_hil.recording.mcap import SampleWriter
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.ring import SAMPLE_ROW, Rows

_FLUSH_S = 0.25


class RowKeeper:
    """Writes rows as they come, remembers them, tells ``seen`` (``FrictidError``: cannot open; no file stays open)."""

    def __init__(
        self, samples: Path, frames: Path, joints: list[str], meta: Mapping[str, Any], seen: Callable[[Rows], None]
    ) -> None:
        with ExitStack() as opened:
            self._samples = SampleWriter(samples, joints, meta)
            opened.callback(self._samples.close)
            self._frames = BusLogWriter(frames)
            opened.callback(self._frames.close)
            self._files = opened.pop_all()
        self._joints = joints
        self._seen = seen
        self._kept: list[Rows] = []
        self._flushed_at = time.monotonic()

    def samples(self, rows: Rows) -> None:
        """Keep and write rows of ``ring.SAMPLE_ROW``."""
        self._kept.append(rows)
        for index in np.unique(rows["joint"]):
            self._samples.append(self._joints[int(index)], rows[rows["joint"] == index])
        self._seen(rows)
        self._flush()

    def frames(self, rows: Rows) -> None:
        """Write rows of ``ring.FRAME_ROW``."""
        self._frames.append(rows)
        self._flush()

    def mark(self, joint: str, mark: Mark) -> None:
        """Write a mark."""
        self._samples.mark(joint, mark)

    def identify(self, identities: Mapping[str, Mapping[str, Any]]) -> None:
        """Write what each drive says of itself into the recording."""
        for joint, identity in identities.items():
            self._samples.metadata(f"joint/{joint}", identity)

    def taken(self, joint: str, start_ns: int, end_ns: int) -> Rows:
        """One joint's rows in a stretch of run time; what is older is forgotten, others of the same stretch are not."""
        every = np.concatenate(self._kept) if self._kept else np.empty(0, SAMPLE_ROW)
        self._kept = [every[every["t_ns"] >= start_ns]]
        index = self._joints.index(joint)
        return np.asarray(every[(every["joint"] == index) & (every["t_ns"] >= start_ns) & (every["t_ns"] < end_ns)])

    def close(self) -> None:
        """Finish both files, the second one also where the first cannot be finished (``FrictidError``: disk full)."""
        self._files.close()

    def _flush(self) -> None:
        now = time.monotonic()
        if now - self._flushed_at >= _FLUSH_S:
            self._samples.flush()
            self._frames.flush()
            self._flushed_at = now
