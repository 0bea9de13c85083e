"""The blind check at full size: every figure with its count and interval, time per joint, and the page that docs show.

Run: python benchmarks/gap_check.py [--cases 200] [--seed 1] [--jobs 2] [--leave-one-out] [--write-docs] [--out FOLDER]

Answers are kept in the folder as they come. An interrupted run goes on where it stopped when it is started again with
the same arguments and unchanged code; a run over other cases or other code starts anew.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from frictid_hil.blind.check import run_check
from frictid_hil.blind.generator import Assignment, draw_case
from frictid_hil.blind.page import AIMS, CLOSED_AIMS, LEFT_OUT_AIM, SECONDS_AIM, headline, page

DOCS_PAGE = Path(__file__).parents[1] / "docs" / "evidence" / "gap-check.md"
BEGIN, END = "<!-- the last full run: written by benchmarks/gap_check.py -->", "<!-- end of the last full run -->"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", "--processes", type=int, default=1, help="processes that draw and diagnose at once")
    parser.add_argument("--leave-one-out", action="store_true", help="also take each joint's own effect away")
    parser.add_argument("--write-docs", action="store_true", help="replace the last full run on its page")
    parser.add_argument("--out", type=Path, help="folder to keep everything in (default: in the temporary folder)")
    arguments = parser.parse_args()
    name = f"frictid-gap-check-{arguments.cases}-{arguments.seed}"
    out: Path = arguments.out or Path(tempfile.gettempdir()) / name
    print(f"answers are kept in {out}", flush=True)

    draw_case(0, 0, Assignment("none", ()))  # compile
    begin = time.process_time()
    draw_case(1, 0, Assignment("single", ("stribeck",)))
    print(f"drawing one joint: {time.process_time() - begin:.2f} s of processor time", flush=True)
    try:
        result = run_check(
            arguments.cases,
            arguments.seed,
            out=out,
            processes=arguments.jobs,
            leave_one_out=arguments.leave_one_out,
            progress=_told,
        )
    except KeyboardInterrupt:
        raise SystemExit(f"interrupted; the same command goes on with the answers in {out}") from None
    for line in summary(result):
        print(line)
    answers = json.loads((out / "answers.json").read_text()) + json.loads((out / "answers_left_out.json").read_text())
    print(f"processor time of all diagnoses: {sum(a.get('seconds', 0.0) for a in answers):.0f} s")
    if arguments.write_docs:
        write_docs(page(result))
        print(f"written: {DOCS_PAGE}")


def summary(result: Mapping[str, Any]) -> list[str]:
    """One line per figure, with count, interval and aim."""
    scores = result["scores"]
    lines = [f"truth sealed as SHA-256 {result['truth_sha256']}, seed {result['seed']}"]
    for name, rate in headline(scores).items():
        aim = f"; aim at least {AIMS[name]:.2f}" if name in AIMS else ""
        lines.append(f"{name}: {_rate(rate)}{aim}")
    lines.append(
        f"false_alarms: {_rate(scores['none']['false_alarms'])}; aim at most {1 - AIMS['none_answered_none']:.2f}"
    )
    for size, rates in scores["singles"]["by_size"].items():
        lines.append(f"singles_top_1, {size}: {_rate(rates['top_1'])}")
    closed = scores["closed"]["forward_torque_nm"]
    lines.append(
        f"closed share of {closed['joints']} correct singles: median {_number(closed['median'])}, p10 "
        f"{_number(closed['p10'])}, worst {_number(closed['worst'])}; aims {CLOSED_AIMS['median']} and "
        f"{CLOSED_AIMS['p10']} ({closed['without_figure']} joints without a torque gap on the validation logs; "
        f"with {closed['ambiguous']} ambiguous as nothing closed p10 {_number(closed['p10_ambiguous_as_nothing'])})"
    )
    seconds = scores["seconds"]
    lines.append(
        f"processor seconds per joint: median {_number(seconds['median'])}, p90 {_number(seconds['p90'])}, worst "
        f"{_number(seconds['worst'])}; aim median {SECONDS_AIM:.0f}"
    )
    lines.append(f"unknown that enlarges the gap: {len(scores['unknown_enlarges_gap'])}; aim 0")
    lines.append(f"errors: {len(scores['errors'])}")
    for row in scores["calibration"]:
        lines.append(f"confidence {row['from']:.2f} to {row['to']:.2f}: right {_rate(row)}")
    if result["leave_one_out"]:
        left_out = result["leave_one_out"]
        lines.append(
            f"own effect left out, confident wrong: {_rate(left_out['confident_wrong'])}; aim at most {LEFT_OUT_AIM}"
        )
        lines.append(f"own effect left out, confident partner: {_rate(left_out['confident_partner'])}")
        lines.append(f"own effect left out, answered unknown: {_rate(left_out['answered_unknown'])}")
    return lines


def write_docs(text: str) -> None:
    """Put the rates between the page's two marks, and the whole run into the text beside it."""
    (DOCS_PAGE.parent / "data" / "gap-check-run.txt").write_text(text)
    rates = text.split("### Rates")[1].split("\n###")[0]
    source = next(line for line in text.splitlines() if " joints, seed " in line)
    whole = DOCS_PAGE.read_text()
    before, rest = whole.split(BEGIN, 1)
    _, after = rest.split(END, 1)
    DOCS_PAGE.write_text(f"{before}{BEGIN}\n\n{source}\n\n{rates.strip()}\n\n{END}{after}")


def _told(phase: str, done: int, of: int) -> None:
    if done == of or done % 10 == 0:
        print(f"{phase}: {done} of {of}", flush=True)


def _rate(rate: Mapping[str, Any]) -> str:
    if not rate["of"]:
        return "none of 0"
    return f"{rate['rate']:.3f} [{rate['low']:.3f}, {rate['high']:.3f}] ({rate['right']} of {rate['of']})"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
