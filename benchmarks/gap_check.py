"""The blind check at full size: rates with intervals, time per joint, and the page that docs show.

Run: python benchmarks/gap_check.py [--cases 200] [--seed 1] [--processes 1] [--leave-one-out] [--write-docs]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from frictid_hil.gap.blind.generator import Assignment, draw_case
from frictid_hil.jobs.gap_check import run_gap_check

DOCS_PAGE = Path(__file__).parents[1] / "docs" / "gap-check.md"
AIMS = {
    "singles_top_1": 0.95,
    "singles_top_2": 0.98,
    "none_answered_none": 0.96,
    "outside_answered_unknown": 0.93,
    "doubles_both_in_top_2": 0.80,
    "confident_right": 0.95,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--leave-one-out", action="store_true")
    parser.add_argument("--write-docs", action="store_true", help="replace docs/gap-check.md by this run")
    arguments = parser.parse_args()

    draw_case(0, 0, Assignment("none", ()))  # compile
    begin = time.perf_counter()
    draw_case(1, 0, Assignment("single", ("stribeck",)))
    print(f"drawing one joint: {time.perf_counter() - begin:.2f} s")

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "check"
        result = run_gap_check(
            arguments.cases,
            arguments.seed,
            out,
            arguments.processes,
            leave_one_out=arguments.leave_one_out,
            progress=print,
        )
        page = (out / "gap-check.md").read_text()
    for name, rate in result["rates"].items():
        if rate["of"]:
            aim = f", aim {AIMS[name]:.2f}" if name in AIMS else ""
            print(f"{name}: {rate['rate']:.3f} [{rate['low']:.3f}, {rate['high']:.3f}] of {rate['of']}{aim}")
    closed = result["scores"]["closed"]["forward_torque_nm"]
    print(f"closed share: median {closed['median']}, p10 {closed['p10']} of {closed['joints']} (aim 0.97, 0.85)")
    print(f"seconds per joint: {result['scores']['seconds']} (aim median 5)")
    print(f"unknown that enlarges the gap: {len(result['scores']['unknown_enlarges_gap'])} (aim 0)")
    if result["leave_one_out"]:
        wrong = result["leave_one_out"]["confident_wrong"]
        print(f"own effect left out, confident wrong causes: {wrong['rate']} of {wrong['of']} (aim 0.03)")
    if arguments.write_docs:
        DOCS_PAGE.write_text(page)


if __name__ == "__main__":
    main()
