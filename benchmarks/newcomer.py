"""A newcomer's way, timed: clone, the README's first command, its next steps, and the report open in headless Chromium.

    python benchmarks/newcomer.py [--keep FOLDER]

Every line of the README's ``sh`` blocks is typed into one shell of an account that has never seen the program: an empty
home folder and a bare environment. ``./check`` is left out. Python packages come from wherever pip gets them.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_TOLD = "newcomer:"


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--keep", type=Path, help="walk in this folder and leave it there")
    keep = options.parse_args().keep
    with tempfile.TemporaryDirectory(prefix="newcomer-") as temporary:
        place = keep or Path(temporary)
        (place / "home").mkdir(parents=True)
        walk(place)


def walk(place: Path) -> None:
    clone = place / "frictid-hil"
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout
    print(f"commit {commit.strip()}, Python {sys.version.split()[0]}, {os.cpu_count()} cores")
    began = time.monotonic()
    stage("git clone", began, ["git", "clone", "-q", str(ROOT), str(clone)], place)
    first, *others = readme_lines(clone / "README.md")
    stage(first, began, ["sh", "-e", "-c", first], clone)
    opened(clone / "first-run" / "report.html", began, place)
    # One shell for the rest, as a person has it: what is activated in one line holds in the next.
    script = "\n".join(f"echo {_TOLD}; {line}" for line in others)
    shell = ["sh", "-c", f"{script}\necho {_TOLD}"]
    with (place / "others.log").open("w") as log:
        walked = subprocess.Popen(
            shell, cwd=clone, env=environment(place), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        assert walked.stdout is not None
        at, since = -1, time.monotonic()
        for said in walked.stdout:
            if said.strip() == _TOLD:
                if at >= 0:
                    print(f"{time.monotonic() - began:6.0f} s  {time.monotonic() - since:5.1f} s  {others[at]}")
                at, since = at + 1, time.monotonic()
            log.write(said)
            if "not found" in said or "error:" in said.lower():
                print(f"          says: {said.strip()}")
        walked.wait()


def readme_lines(path: Path) -> list[str]:
    """What the README asks to be typed, in order."""
    blocks = re.findall(r"```sh\n(.*?)```", path.read_text(), flags=re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.splitlines() if line.strip()]
    return [line for line in lines if line != "./check"]


def environment(place: Path) -> dict[str, str]:
    """Of somebody who has just logged in for the first time."""
    return {"HOME": str(place / "home"), "PATH": f"{_python_folder()}:/usr/local/bin:{os.defpath}", "TERM": "dumb"}


def _python_folder() -> str:
    return str(Path(getattr(sys, "_base_executable", sys.executable)).resolve().parent)


def stage(name: str, began: float, command: list[str], cwd: Path) -> None:
    since, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    place = cwd if (cwd / "home").is_dir() else cwd.parent
    done = subprocess.run(command, cwd=cwd, env=environment(place), capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    now = time.monotonic()
    print(f"{now - began:6.0f} s  {now - since:5.1f} s, {used_s:.1f} s of a core  {name}")
    if done.returncode:
        sys.exit(f"ended with {done.returncode}:\n{done.stdout}\n{done.stderr}")


def opened(page: Path, began: float, place: Path) -> None:
    """The page in a browser, with what it wrote to the console."""
    if CHROMIUM is None:
        print(f"          {page} is there; no Chromium to open it in")
        return
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--enable-logging=stderr",
        f"--user-data-dir={place / 'browser'}", "--virtual-time-budget=8000", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    errors = [line for line in shown.stderr.splitlines() if ":CONSOLE" in line]
    drawn = len(re.findall(r'class="main-svg"', shown.stdout))
    print(f"{time.monotonic() - began:6.0f} s         report open: {drawn} drawings, {len(errors)} console messages")


if __name__ == "__main__":
    main()
