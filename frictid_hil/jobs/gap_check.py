"""``gap check``: the blind check of the diagnosis, scored."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from frictid_hil.errors import UsageError
from frictid_hil.gap.blind.check import run_check
from frictid_hil.gap.blind.page import headline, page


def run_gap_check(
    cases: int = 200,
    seed: int = 0,
    out: Path | None = None,
    processes: int | None = None,
    *,
    leave_one_out: bool = False,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Draw joints whose effect is sealed, diagnose them in processes of their own, open the seal, score.

    Args:
        cases: how many joints; twenty bring every kind, 200 every effect five times.
        seed: of everything drawn.
        out: folder that keeps commitment, cases, answers, truth, ``result.json`` and ``gap-check.md``.
        processes: at once; one per processor core unless given.
        leave_one_out: also take each joint's own effect out of the library and diagnose again.
        progress: given a line now and then.

    Returns:
        What ``--json`` prints: ``outcome``, ``seed``, ``cases``, ``truth_sha256``, ``rates`` (each ``rate``, ``low``,
        ``high``, ``right``, ``of``), ``scores`` (everything), ``leave_one_out`` (or None), ``out``.

    Raises:
        UsageError: no case asked for, or ``out`` holds the result of a finished check. An interrupted one goes on.
    """
    if cases < 1:
        raise UsageError(f"{cases} cases cannot be scored", next_step="ask for at least 20: `gap check --cases 20`")
    if out is not None and (out / "result.json").exists():
        raise UsageError("this folder holds an earlier check", where=str(out), next_step="name a new folder")
    result = run_check(
        cases,
        seed,
        out=out,
        processes=processes or os.cpu_count() or 1,
        leave_one_out=leave_one_out,
        progress=_told(progress) if progress else None,
    )
    if out is not None:
        (out / "gap-check.md").write_text(page(result))
    return {
        "outcome": "ok",
        **result,
        "rates": headline(result["scores"]),
        "out": str(out.resolve()) if out is not None else None,
    }


def _told(tell: Callable[[str], None]) -> Callable[[str, int, int], None]:
    """A line at every tenth of a phase."""

    def progress(phase: str, done: int, of: int) -> None:
        if done == of or 10 * done // of > 10 * (done - 1) // of:
            tell(f"{phase}: {done} of {of}")

    return progress
