"""How figures and dates read on a page: as many digits as the interval bears, dates without the letters between."""

from __future__ import annotations

import math

from frictid_hil.config.profile import Estimate

_SYMMETRIC = 0.05  # ends of an interval that are this much alike are written as +-


def when(utc: str) -> str:
    """``2026-11-21T05:15:00Z`` as people read it: ``2026-11-21 05:15 UTC``; anything else as it is."""
    date, between, time = utc.partition("T")
    return f"{date} {time[:5]} UTC" if between and utc.endswith("Z") else utc


def sentence(words: str) -> str:
    """The same text with a capital first letter and a full stop at its end."""
    words = words.strip()
    return words and words[0].upper() + words[1:] + ("" if words.endswith((".", "!", "?")) else ".")


def with_interval(value: float, low: float | None, high: float | None, unit: str) -> str:
    """``4.657 +- 0.035 N m``, or both ends where they do not lie alike; four digits where nothing is known of it."""
    if low is None or high is None or not math.isfinite(high - low):
        return f"{plain(value)} {unit}"
    half = (high - low) / 2
    if half == 0.0:
        return f"{plain(value)} {unit}"
    decimals = max(0, 1 - math.floor(math.log10(half)))
    if abs((high + low) / 2 - value) <= _SYMMETRIC * half:
        return f"{value:,.{decimals}f} \u00b1 {half:,.{decimals}f} {unit}"
    return f"{value:,.{decimals}f} ({low:,.{decimals}f} .. {high:,.{decimals}f}) {unit}"


def estimate(figure: Estimate, unit: str) -> str:
    """A figure of a profile with its interval; where there is none, why."""
    if figure.value is None:
        return f"none: {figure.reason}"
    return with_interval(figure.value, figure.low, figure.high, unit)


def change(percent: float | None) -> str:
    """A signed change, one digit after the point; nothing where it is not known."""
    return "" if percent is None else f"{percent + 0.0:+.1f}".replace("-0.0", "0.0").replace("+0.0", "0.0")


def plain(value: float, digits: int = 4) -> str:
    """So many digits, without an exponent where a person would write none."""
    if value == 0.0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{decimals}f}"
