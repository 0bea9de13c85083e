"""What stands in a crontab comes true when the systemd timer would, and at no other time."""

from __future__ import annotations

import os
import shutil
import subprocess
from datetime import datetime, timedelta
from itertools import islice, product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.errors import UsageError
from frictid_hil.jobs.schedule import cron_fields, with_last_day

needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
BASE = datetime(2027, 12, 27, 0, 0)


def times_of_cron(fields: str, count: int) -> list[datetime]:
    """As ``man 5 crontab`` says it: a day of the month or a weekday is enough where both are restricted."""
    limits = ((0, 59), (0, 23), (1, 31), (1, 12), (0, 6))
    minutes, hours, days, months, weekdays = (
        set(range(low, high + 1)) if text == "*" else {int(one) for one in text.split(",")}
        for text, (low, high) in zip(fields.split(), limits, strict=True)
    )
    either = "*" not in fields.split()[2] and "*" not in fields.split()[4]

    def found():
        for later in range(366 * 9):
            day = BASE + timedelta(days=later)
            right = (day.day in days, day.isoweekday() % 7 in weekdays)
            if day.month in months and (any(right) if either else all(right)):
                for hour, minute in product(sorted(hours), sorted(minutes)):
                    if (now := day.replace(hour=hour, minute=minute)) > BASE:
                        yield now

    return list(islice(found(), count))


def times_of_systemd(expression: str, count: int) -> list[datetime] | None:
    """None where systemd refuses the expression."""
    answer = subprocess.run(
        ["systemd-analyze", "calendar", f"--iterations={count}", f"--base-time={BASE}", expression],
        env={**os.environ, "TZ": "UTC", "LC_ALL": "C"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if answer.returncode:
        return None
    lines = [line.split(":", 1) for line in answer.stdout.splitlines()]
    told = [text.split() for name, text in lines if name.strip() == "Next elapse" or "Iter." in name]
    return [datetime.fromisoformat(f"{words[1]} {words[2]}") for words in told if words != ["never"]]


def part(low: int, high: int) -> st.SearchStrategy[str]:
    number = st.integers(low, high)
    step = st.one_of(st.just(""), st.integers(1, 9).map("/{}".format))
    ranged = st.tuples(number, number, step).map(lambda one: f"{min(one[:2])}..{max(one[:2])}{one[2]}")
    return st.one_of(number.map("{:02d}".format), st.tuples(number, step).map(lambda one: f"{one[0]}{one[1]}"), ranged)


def component(low: int, high: int) -> st.SearchStrategy[str]:
    return st.one_of(st.just("*"), st.lists(part(low, high), min_size=1, max_size=3).map(",".join))


WEEKDAYS = st.one_of(
    st.just(""), st.sampled_from(["Mon..Fri ", "sat,Sun ", "Wednesday ", "Sat..Sun,Tue ", "Sun ", "Sun..Mon "])
)
DATES = st.one_of(
    st.just(""),
    st.tuples(st.sampled_from(["*-", ""]), component(1, 12), component(1, 28)).map("{0[0]}{0[1]}-{0[2]} ".format),
)
TIMES = st.tuples(component(0, 23), component(0, 59), st.sampled_from(["", ":00", ":0"])).map(
    "{0[0]}:{0[1]}{0[2]}".format
)
SHORT = st.sampled_from(["daily", "weekly", "monthly", "hourly", "yearly", "quarterly", "minutely", "semi-annually"])


@needs_systemd
def test_a_timer_leaves_out_no_day_at_the_turn_of_the_year() -> None:
    days = [when.date().isoformat() for when in times_of_systemd(with_last_day("*-*-1/4 02:00"), 3) or ()]
    assert days == ["2027-12-29", "2028-01-01", "2028-01-05"]


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ("Mon..Fri 02:30", "Mon..Fri 02:30"),
        ("*-*-1/4 *:00", "*-*-1..31/4 *:00"),
        ("*-2/3-05,7/9 1/2:00", "*-2/3-05,7..31/9 1/2:00"),
        ("2027-01-1..9/2", "2027-01-1..9/2"),
        ("*-02~03/1", "*-02~03/1"),
        ("semi-annually", "semi-annually"),
    ],
)
def test_steps_through_a_month_are_said_to_its_last_day(given: str, written: str) -> None:
    assert with_last_day(given) == written


@pytest.mark.slow
@needs_systemd
@settings(max_examples=100, deadline=None)
@given(st.one_of(SHORT, st.tuples(WEEKDAYS, DATES, TIMES).map("".join)))
def test_a_cron_line_says_exactly_what_systemd_does(expression: str) -> None:
    meant = times_of_systemd(with_last_day(expression), 40)
    try:
        fields = cron_fields(expression)
    except UsageError:
        return
    if meant is not None:
        told = times_of_cron(fields, 40)
        assert len(told) >= 8 and told == meant[: len(told)]


@pytest.mark.parametrize(
    ("expression", "fields"),
    [
        ("daily", "0 0 * * *"),
        ("03:05", "5 3 * * *"),
        ("Mon..Fri 02:30", "30 2 * * 1,2,3,4,5"),
        ("Sat,Sun 04:00:00", "0 4 * * 0,6"),
        ("Tue,Thu..Fri 23:59", "59 23 * * 2,4,5"),
        ("*-*-01 02:00", "0 2 1 * *"),
        ("*-*-01", "0 0 1 * *"),
        ("*-01,07-1/14 1..3:0/20", "0,20,40 1,2,3 1,15,29 1,7 *"),
        ("Mon", "0 0 * * 1"),
    ],
)
def test_what_cron_can_say(expression: str, fields: str) -> None:
    assert cron_fields(expression) == fields


@pytest.mark.parametrize(
    "expression",
    [
        "Fri *-*-13 02:00", "2026-12-24 02:00", "*-*~01 02:00", "02:30 UTC", "02:30:15", "*:*:0/10", "@1395716396",
        "Mo 02:30", "*-*-01T02:30", "1-2-3-4 2:30", "25:00", "02:60", "*-13-01 02:00", "2:0/0", "", "Sun..Mon",
        "weekly 02:30", "02:30 Mon", "*-1-", "5..3:00",
    ],
)  # fmt: skip
def test_what_cron_cannot_say_is_refused(expression: str) -> None:
    with pytest.raises(UsageError, match="cron cannot say"):
        cron_fields(expression)
