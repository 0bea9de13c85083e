"""A systemd calendar expression as the five fields of a crontab line, exactly or not at all.

cron knows minutes, hours, days, months and weekdays of the local clock. It knows no years, seconds or time zones, and
no days counted from the end of a month (``~``). Where both a day and a weekday are given, systemd wants both and cron
takes either (``man 5 crontab``); such an expression is not translated.
"""

from __future__ import annotations

import re

from frictid_hil.errors import UsageError

_DAYS = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
_SHORTHANDS = {
    "minutely": "*-*-* *:*:00",
    "hourly": "*-*-* *:00:00",
    "daily": "*-*-* 00:00:00",
    "weekly": "Mon *-*-* 00:00:00",
    "monthly": "*-*-01 00:00:00",
    "quarterly": "*-01,04,07,10-01 00:00:00",
    "semiannually": "*-01,07-01 00:00:00",
    "yearly": "*-01-01 00:00:00",
}
_SHORTHANDS |= {"annually": _SHORTHANDS["yearly"], "biannually": _SHORTHANDS["semiannually"]}
_SHORTHANDS |= {"bi-annually": _SHORTHANDS["semiannually"], "semi-annually": _SHORTHANDS["semiannually"]}
_VALUES = {"minute": range(60), "hour": range(24), "day": range(1, 32), "month": range(1, 13)}
_PART = re.compile(r"(\d+)(?:\.\.(\d+))?(?:/(\d+))?", re.ASCII)


def cron_fields(on_calendar: str) -> str:
    """Minute, hour, day, month and weekday of a crontab line that comes true exactly when the expression does.

    The expression is valid for ``systemd-analyze calendar``.

    Raises:
        UsageError: cron cannot say it; why.
    """
    words = _SHORTHANDS.get(on_calendar.strip().lower(), on_calendar).split()
    weekdays = "*"
    if words and words[0][0].isalpha():
        weekdays = _weekdays(words.pop(0))
    date = words.pop(0) if words and ":" not in words[0] else "*-*-*"
    time = words.pop(0) if words and ":" in words[0] else "00:00:00"
    if words or not on_calendar.strip():
        raise _no(f"{' '.join(words)!r} (cron follows the local clock)")
    dated = re.fullmatch(r"(?:\*-)?([^-]+)-([^-]+)", date)
    timed = re.fullmatch(r"([^:]+):([^:]+)(?::0?0)?", time)
    if dated is None or timed is None:
        raise _no(f"{date!r} (years)" if dated is None else f"{time!r} (seconds)")
    (month, day), (hour, minute) = dated.groups(), timed.groups()
    days, months = _field("day", day), _field("month", month)
    if days != "*" and weekdays != "*":
        raise _no("a day of the month together with a weekday: it takes either, not both")
    return f"{_field('minute', minute)} {_field('hour', hour)} {days} {months} {weekdays}"


def _field(name: str, text: str) -> str:
    values, found = _VALUES[name], set[int]()
    if text == "*":
        return "*"
    for part in text.split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise _no(f"{part!r} as {name}")
        first, last, step = match.groups()
        low = int(first)
        high = int(last) if last else values[-1] if step else low
        if low not in values or high not in values or low > high or (step and not int(step)):
            raise _no(f"{part!r} as {name}")
        found |= set(range(low, high + 1, int(step or 1)))
    return ",".join(map(str, sorted(found)))


def _weekdays(text: str) -> str:
    """The week of systemd begins on Monday, that of cron on Sunday with 0."""
    found = set[int]()
    for part in filter(None, text.lower().split(",")):
        first, _, last = part.partition("..")
        at = range(_weekday(first), _weekday(last or first) + 1)
        if not at:
            raise _no(f"{part!r} as weekdays")
        found |= {(one + 1) % 7 for one in at}
    return ",".join(map(str, sorted(found)))


def _weekday(text: str) -> int:
    found = [at for at, name in enumerate(_DAYS) if text in (name, name[:3])]
    if not found:
        raise _no(f"{text!r} as weekday")
    return found[0]


def _no(what: str) -> UsageError:
    return UsageError(f"cron cannot say {what}")
