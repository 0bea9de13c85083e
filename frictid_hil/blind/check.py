"""The blind check of the diagnosis: draw, seal, diagnose in other processes, then open the seal and score.

Order matters and is the point. All cases are drawn and written first; their truth stays in this process's memory and
only its SHA-256 is published. The diagnosing processes get the folder of cases as their working directory and nothing
else: no seed, no truth, no path to any. Truth is written out after the last answer.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import queue
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

from frictid_hil.blind.generator import truth_text
from frictid_hil.blind.score import Answer, score_left_out
from frictid_hil.blind.worlds import WORLDS

SCHEMA = "frictid.gap_check/1"

Progress = Callable[[str, int, int], None]  # phase (``draw``, ``diagnose``, ``leave one out``), done, of
DiagnoserCommand = tuple[str, ...]
DIAGNOSER: DiagnoserCommand = (sys.executable, "-m", "frictid_hil.blind.diagnoser")


@dataclass(frozen=True, slots=True)
class Sealed:
    """Drawn cases: sets on disk, truth in memory, its hash for the world."""

    folder: Path  # of the cases
    truths: dict[str, dict[str, Any]]  # by case name
    texts: dict[str, str]  # the truth files to be, by case name
    digest: str  # SHA-256 over all of them, hexadecimal


def run_check(
    cases: int,  # how many joints
    seed: int,  # of everything drawn; equal seeds give equal cases, whatever ``processes``
    *,
    # Folder to keep the commitment, the cases, the answers, the truth and the result in, and to go on in after an
    # interruption; kept nowhere if None.
    out: Path | None = None,
    processes: int = 1,  # how many diagnose (and draw) at once
    world: str = "narrow",  # name in ``WORLDS``
    leave_one_out: bool = False,  # also diagnose every visible joint with one effect by a library that lacks it
    progress: Progress | None = None,
    diagnoser: DiagnoserCommand = DIAGNOSER,  # see ``diagnoser.serve`` for what such a process is told and answers
) -> dict[str, Any]:
    """The scores, plain values, with ``schema``, ``world``, ``seed``, ``cases``, ``truth_sha256``."""
    report = progress or (lambda phase, done, of: None)
    with nullcontext(out) if out else tempfile.TemporaryDirectory(prefix="frictid-gap-check-") as name:
        folder = Path(name)
        sealed = draw_sealed(world, cases, seed, folder / "cases", processes, report)
        # The commitment stands before the first answer is asked for.
        commitment = {"schema": SCHEMA, "cases": cases, "truth_sha256": sealed.digest, "code_sha256": code_digest()}
        kept = _Kept.in_folder(folder, commitment)
        requests = [{"case": name, "left_out": None} for name in sealed.truths]
        lines = _diagnosed(diagnoser, sealed.folder, requests, processes, report, "diagnose", kept)
        result: dict[str, Any] = {
            **commitment,
            "world": world,
            "seed": seed,
            "scores": WORLDS[world].score(sealed.truths, {line["case"]: line for line in lines}),
            "leave_one_out": None,
        }
        left_out: list[dict[str, Any]] = []
        if leave_one_out:
            requests = [
                {"case": name, "left_out": truth["effects"][0]["name"]}
                for name, truth in sealed.truths.items()
                if truth["kind"] == "single" and truth.get("visible", True)
            ]
            left_out = _diagnosed(diagnoser, sealed.folder, requests, processes, report, "leave one out", kept)
            result["leave_one_out"] = score_left_out(
                [(sealed.truths[line["case"]], Answer.from_json(line)) for line in left_out]
            )
        _open_seal(folder, sealed, {"answers": lines, "answers_left_out": left_out, "result": result})
    return result


def code_digest() -> str:
    """SHA-256 over the source files that answer, hexadecimal."""
    room = Path(__file__).parents[1]
    files = [path for path in sorted(room.rglob("*.py")) if "blind" not in path.parts]
    text = b"".join(path.relative_to(room).as_posix().encode() + path.read_bytes() for path in files)
    return hashlib.sha256(text).hexdigest()


@dataclass(frozen=True, slots=True)
class _Kept:
    """Answers on disk, one a line, each with its phase."""

    path: Path

    @staticmethod
    def in_folder(folder: Path, commitment: dict[str, Any]) -> _Kept:
        """Those of an earlier start of the very same check; none where the folder's commitment is another one."""
        stated, answers = folder / "commitment.json", folder / "answers.jsonl"
        if not stated.exists() or json.loads(stated.read_text()) != commitment:
            answers.unlink(missing_ok=True)
            stated.write_text(json.dumps(commitment, indent=2) + "\n")
        answers.touch()
        return _Kept(answers)

    def add(self, phase: str, answer: dict[str, Any]) -> None:
        """One more."""
        with self.path.open("a") as file:
            file.write(json.dumps({"phase": phase, **answer}) + "\n")

    def of(self, phase: str) -> dict[str, dict[str, Any]]:
        """By case. A line cut short by the interruption counts for nothing."""
        found = {}
        for line in self.path.read_text().splitlines():
            try:
                answer = json.loads(line)
            except json.JSONDecodeError:
                continue
            if answer.pop("phase") == phase and "diagnosis" in answer:
                found[answer["case"]] = answer
        return found


def draw_sealed(world: str, cases: int, seed: int, folder: Path, processes: int, progress: Progress) -> Sealed:
    """Draw all cases and write their sets below ``folder``; truth comes back to the caller's memory alone."""
    folder.mkdir(parents=True, exist_ok=True)
    cards = WORLDS[world].cards(cases, seed)
    arguments = range(len(cards)), itertools.repeat(seed), cards, itertools.repeat(folder)
    truths: dict[str, dict[str, Any]] = {}
    for done, truth in enumerate(_mapped(WORLDS[world].draw, arguments, processes), start=1):
        truths[truth["case"]] = truth
        progress("draw", done, len(cards))
    texts = {name: truth_text(truth) for name, truth in truths.items()}
    digest = hashlib.sha256("".join(texts[name] for name in sorted(texts)).encode()).hexdigest()
    return Sealed(folder, truths, texts, digest)


def _mapped(draw: Callable[..., dict[str, Any]], arguments: tuple[Any, ...], processes: int) -> Iterator[Any]:
    if processes <= 1:
        yield from map(draw, *arguments)
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield from pool.map(draw, *arguments, chunksize=4)


def _diagnosed(
    command: DiagnoserCommand,
    folder: Path,
    requests: Sequence[dict[str, Any]],
    processes: int,
    progress: Progress,
    phase: str,
    kept: _Kept,
) -> list[dict[str, Any]]:
    """All answers, in the order of the requests; a process that dies answers its request with its exit code."""
    by_case = kept.of(phase)
    asked = [request for request in requests if request["case"] not in by_case]
    idle: queue.SimpleQueue[subprocess.Popen[str]] = queue.SimpleQueue()

    def answered(request: dict[str, Any]) -> dict[str, Any]:
        try:
            process = idle.get_nowait()
        except queue.Empty:
            process = subprocess.Popen(command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        answer = _asked(process, request)
        if answer is None:
            return {"case": request["case"], "error": f"the diagnosing process ended with code {process.wait()}"}
        idle.put(process)
        return answer

    with ThreadPool(max(1, min(processes, len(asked)))) as pool:
        for answer in pool.imap_unordered(answered, asked):
            kept.add(phase, answer)
            by_case[answer["case"]] = answer
            progress(phase, len(by_case), len(requests))
    while not idle.empty():
        with idle.get():  # closed, and waited for
            pass
    return [by_case[request["case"]] for request in requests]


def _asked(process: subprocess.Popen[str], request: dict[str, Any]) -> dict[str, Any] | None:
    """The answer to one request; None when the process is gone or says something that is no answer."""
    if process.stdin is None or process.stdout is None:
        return None
    try:
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        answer = json.loads(process.stdout.readline())
    except (BrokenPipeError, json.JSONDecodeError):
        process.kill()
        return None
    return answer if isinstance(answer, dict) and answer.get("case") == request["case"] else None


def _open_seal(folder: Path, sealed: Sealed, documents: dict[str, Any]) -> None:
    """Truth, answers and result beside the cases, once nothing is left to be answered."""
    (folder / "truth").mkdir(exist_ok=True)
    for name, text in sealed.texts.items():
        (folder / "truth" / f"{name}.yaml").write_text(text)
    for name, document in documents.items():
        (folder / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n")
