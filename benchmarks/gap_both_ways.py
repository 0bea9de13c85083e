"""What half and double of each constant of ``gap/both_ways.py`` changes, on real recordings with something added.

    FRICTID_REAL_DATA=... FRICTID_REAL_MORE_DATA=... python benchmarks/gap_both_ways.py [--only WORD ...] [--every K]

Every variant of ``gap_variants`` that adds something is diagnosed once, and its rule of one cause that is half of the
gap is asked again with each constant changed; of a share or a chance, its odds. Counted are what the rule alone names:
what was added, something else, and answers of it that change.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from gap_sensitivity import changed, put
from gap_variants import answers, wanted

from frictid_hil.gap import both_ways, diagnose

FACTORS = (0.5, 2.0)
CONSTANTS = ("FAIR_SHARE", "TIE", "LIKELY", "MEMORY_S")
AS_IT_IS = "as it is"


class Asked:
    """The rule, asked as it is and with each constant changed."""

    def __init__(self) -> None:
        self.rule = diagnose._half_of_it
        self.told: dict[str, tuple[str, ...]] = {}  # names, by what was changed

    def __call__(self, *case: Any) -> Any:
        """Of one reading of a joint, as ``diagnose`` asks it."""
        self.told = {}
        for name in CONSTANTS:
            for factor in FACTORS:
                with changed(both_ways, name, factor, odds=name != "MEMORY_S"):
                    self.told[f"{name} x {factor:g}"] = _names(self.rule(*case))
        half = self.rule(*case)
        self.told[AS_IT_IS] = _names(half)
        return half


def _names(half: Any) -> tuple[str, ...]:
    return tuple(f.effect for f in half[0].named) if half else ()


def main() -> int:
    """Print one row for each constant and factor."""
    asked, rows, count = Asked(), dict[str, list[int]](), 0
    with put(diagnose, "_half_of_it", asked):
        for a in answers(*wanted(sys.argv[1:])):
            if a.variant.causes == () or not asked.told:
                continue
            count += 1
            for what, names in asked.told.items():
                row = rows.setdefault(what, [0, 0, 0])
                judged = (*_judged(names, a.accepted), names != asked.told[AS_IT_IS])
                rows[what] = [n + one for n, one in zip(row, judged, strict=True)]
            asked.told = {}
    print("| constant | what was added comes first | something else does | answers change |")
    print("|---|---|---|---|")
    for what, counted in rows.items():
        print(f"| {what} | {' | '.join(map(str, counted))} |")
    print(f"\n{count} answers.")
    return 0


def _judged(names: Sequence[str], right: Sequence[str]) -> tuple[bool, bool]:
    return bool(names) and names[0] in right, bool(names) and names[0] not in right


if __name__ == "__main__":
    sys.exit(main())
