"""How a joint is commanded: by position, velocity or torque."""

from __future__ import annotations

from enum import IntEnum


class Mode(IntEnum):
    """How a joint is commanded; values are those of CiA-402 object 6060."""

    NONE = 0
    POSITION = 8  # cyclic synchronous position (CSP)
    VELOCITY = 9  # cyclic synchronous velocity (CSV)
    TORQUE = 10  # cyclic synchronous torque (CST)
