"""Weights of the confidence's logistic map; written by ``benchmarks/gap_confidence.py --write``.

350 joints of seeds 5101, 5303, diagnosed at commits 43ab14c, 2f98714 (not those with a late torque).
Causes named in joints that did not fit the weights they are judged by (ten folds):

| confidence | whole library: right | own effect taken away: right |
|---|---|---|
| 0.00 to 0.50 | 6 of 17 | 0 of 30 |
| 0.50 to 0.70 | 3 of 3 | 0 of 2 |
| 0.70 to 0.80 | 2 of 3 | 0 of 1 |
| 0.80 to 0.90 | 8 of 8 | 0 of 2 |
| 0.90 to 0.95 | 6 of 6 | 0 of 1 |
| 0.95 to 1.00 | 186 of 186 | 0 of 1 |
"""

from __future__ import annotations

WEIGHTS: dict[str, float] = {
    "one": 11.742,
    "lead": 0.463,
    "rival_share": -3.621,
    "unexplained": 0.0,
    "misfit": -0.574,
    "left": -4.879,
    "own": 0.0,
    "company": -1.092,
    "edge": -1.366,
    "drive_left": 0.0,
    "hollow": -4.975,
    "generic": -1.099,
    "generic_share": -0.853,
    "worst_log": -1.469,
    "spread": 0.0,
    "unresolved": 0.0,
    "position": -3.944,
}
