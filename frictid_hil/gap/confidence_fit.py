"""Weights of the confidence's logistic map; ``benchmarks/gap_confidence.py --write`` fits and writes them.

None have been fitted yet, so the map set by hand in ``confidence.py`` holds.
"""

from __future__ import annotations

WEIGHTS: dict[str, float] = {}
