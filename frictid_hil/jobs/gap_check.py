"""``gap check``: the blind check of the diagnosis, scored."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from frictid_hil.blind.check import code_digest, run_check
from frictid_hil.blind.worlds import WORLDS
from frictid_hil.errors import UsageError
from frictid_hil.files import refuse_overwriting, write_whole


def run_gap_check(
    cases: int = 200,
    seed: int = 0,
    out: Path | None = None,
    processes: int | None = None,
    *,
    worlds: Sequence[str] = ("narrow",),
    leave_one_out: bool = False,
    force: bool = False,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Draw joints whose effect is sealed, diagnose them in processes of their own, open the seal, score.

    See ``gap check --help`` and the JSON of the verb. An interrupted check goes on with its answers. ``UsageError``: no
    case, no such world, or ``out`` holds a finished check or, without ``force``, answers of another one.
    """
    if cases < 1:
        raise UsageError(f"{cases} cases cannot be scored", next_step="ask for at least 20: `gap check --cases 20`")
    strange = [name for name in worlds if name not in WORLDS]
    if strange or not worlds:
        raise UsageError(f"no world is called {', '.join(strange)!r}", next_step=f"name of: {', '.join(WORLDS)}")
    folders = {name: out if out is None or len(worlds) == 1 else out / name for name in worlds}
    written = [folder / file for folder in folders.values() if folder for file in ("result.json", "gap-check.md")]
    refuse_overwriting(written, force=force)
    for name, folder in folders.items():
        if folder is not None:
            _claim(folder, (name, cases, seed), force=force)
    results = {}
    for name, folder in folders.items():
        result = run_check(
            cases,
            seed,
            out=folder,
            processes=processes or os.cpu_count() or 1,
            world=name,
            leave_one_out=leave_one_out and name == "narrow",
            progress=_told(name, progress) if progress else None,
        )
        if folder is not None:
            (folder / "gap-check.md").write_text(WORLDS[name].page(result))
        results[name] = {**result, "rates": WORLDS[name].headline(result["scores"])}
    kept = {"out": str(out.resolve()) if out is not None else None}
    if len(results) == 1:
        return {"outcome": "ok", **next(iter(results.values())), **kept}
    return {"outcome": "ok", "seed": seed, "cases": cases, "worlds": results, **kept}


def _claim(folder: Path, asked: tuple[str, int, int], *, force: bool) -> None:
    """Note in the folder which check it belongs to, as a digest: seed and world are not to be read beside the cases."""
    digest = hashlib.sha256(json.dumps([*asked, code_digest()]).encode()).hexdigest()
    note, answers = folder / "check.sha256", folder / "answers.jsonl"
    same = note.exists() and note.read_text() == digest
    if answers.exists() and answers.stat().st_size and not same and not force:
        raise UsageError(
            "holds answers of another unfinished check, which would be dropped",
            where=str(answers),
            cause="that check had another world, number of cases or seed, or was begun by another version",
            next_step="choose another place, or add --force to drop them",
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(note, digest)


def _told(world: str, tell: Callable[[str], None]) -> Callable[[str, int, int], None]:
    """Return a progress function that prints a line at every tenth of a phase."""

    def progress(phase: str, done: int, of: int) -> None:
        if done == of or 10 * done // of > 10 * (done - 1) // of:
            tell(f"{world}, {phase}: {done} of {of}")

    return progress
