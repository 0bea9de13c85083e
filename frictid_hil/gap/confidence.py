"""Confidence: the chance that a named effect is really there, from how far its best rival stays behind.

The map is set by hand, not fitted: the blind check (docs/gap.md) holds it to its promise that causes named with
0.9 or more are right in 95 of 100 joints. Nothing here knows a joint.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from frictid_hil.gap.diagnose import Features

CONFUSABLE_MARGIN = 40.0
"""Margin in log-likelihood (per misfit ratio) below which a rival is named."""


def confidence(name: str, features: Features) -> tuple[float, tuple[str, ...]]:
    """(confidence 0..1, effects that can hardly be told from it)."""
    scale = max(1.0, features.misfit)
    if name in features.rivals:
        gain, rival = features.rivals[name]
        margin = (features.gain - gain) / scale
        share = gain / features.gain if features.gain > 0.0 else 1.0
    else:
        rivals = sorted(features.rival_drive.items(), key=lambda item: -item[1])
        share, rival = (rivals[0][1], rivals[0][0]) if rivals else (0.0, "")
        # Samples of the torque are not quite independent: a tenth of their likelihood is taken.
        margin = 0.1 * features.drive_gain.get(name, 1e5) * (1.0 - share)
    chance = 1.0 - 0.65 * math.exp(-max(0.0, margin) / 60.0)
    # What is left to explain could be the true cause.
    chance *= 1.0 - min(0.6, 1.5 * max(0.0, features.family_share - 0.06))
    if features.misfit > 2.0:
        chance *= 1.0 - min(0.5, 0.2 * max(0.0, features.after - 1.5))
    confusable = (rival,) if rival and (margin < CONFUSABLE_MARGIN or share > 0.97) else ()
    return round(max(0.05, min(0.99, chance)), 3), confusable
