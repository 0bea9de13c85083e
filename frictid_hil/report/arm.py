"""The page of an arm: joints as rows, where and which at a glance, then measured beside the user's model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from frictid_hil.friction.metrics import paired_ratio_interval, plain_rms, rms_by_part
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.where import by_region
from frictid_hil.report.figures import IDENTIFIED, MEASURED, PUBLISHED, Figure, line, rows_of_bars
from frictid_hil.report.pages import Link, Page, Section, Table
from frictid_hil.simulation.effect import Region

PART_S = 2.0  # parts of a motion whose differences count as independent of one another
_SHOWN = 0.03  # share of an arm's largest gap below which a region has no colour of its own


@dataclass(frozen=True, slots=True)
class JointRun:
    """One joint along a log that was not fitted: measured, and the user's model in closed loop; arrays (n,)."""

    joint: str
    log: str
    quantity: str  # what is drawn, with its unit
    time_s: Array
    measured: Array
    nominal: Array
    improved: Array | None  # of the model with the causes; None where nothing was added


def arm_page(
    name: str,
    summary: str,  # the one sentence
    found: Mapping[str, Diagnosis],  # by joint
    pages: Mapping[str, str],  # address of each joint's own page, relative to this one
    notes: Sequence[str] = (),  # of the arm as a whole
    runs: Sequence[JointRun] = (),  # of the joints, in closed loop
    why_no_runs: str = "",  # why there are none
    exports: Sequence[Sequence[str]] = (),  # target, where it ran, torque error before and after, and what is lost
) -> Page:
    """The page of an arm."""
    rows = tuple(_row(joint, d, pages.get(joint)) for joint, d in found.items())
    headings = ("joint", "verdict", "causes (confidence)", "gap lies", "gap before", "after", "noise floor")
    glance = Section(
        "Joints",
        words=tuple(notes),
        tables=(Table(headings, rows, caption="RMS of torque on recordings that nothing was fitted to, N m (N)."),),
        figures=tuple(_where(found)),
    )
    words = () if runs else (why_no_runs or "No log was run again.",)
    tables = (_before_and_after(runs),) if runs else ()
    figures = tuple(_beside(run) for run in runs)
    beside = Section("Measured, your model, improved", words=words, tables=tables, figures=figures)
    written: tuple[Section, ...] = ()
    if exports:
        titles = ("export", "where it ran", "torque error before", "after", "what is lost")
        caption = "RMS over the changed joints' measured torque, on motion that was not fitted."
        written = (Section("What was written", tables=(Table(titles, tuple(map(tuple, exports)), caption=caption),)),)
    return Page(f"Sim-to-real gap of {name}", summary, (glance, beside, *written))


def _row(joint: str, d: Diagnosis, page: str | None) -> tuple[str | Link, ...]:
    causes = ", ".join(f"{cause.effect} ({cause.confidence:.2f})" for cause in d.causes)
    shares = sorted(by_region(d.where).items(), key=lambda item: -item[1])[:2] if d.verdict != "none" else []
    lies = ", ".join(f"{region.value} {100 * share:.0f} %" for region, share in shares)
    figures = (d.before.inverse_nm, d.after.inverse_nm, d.noise_floor.inverse_nm)
    told = tuple("-" if value is None else f"{value:.3g}" for value in figures)
    return (Link(joint, page) if page else joint, d.verdict, causes or "-", lies or "-", *told)


def _where(found: Mapping[str, Diagnosis]) -> list[Figure]:
    """Each joint's gap over its noise floor, parted by region."""
    sizes = {
        joint: d.before.inverse_nm / d.noise_floor.inverse_nm
        for joint, d in found.items()
        if d.before.inverse_nm is not None and d.noise_floor.inverse_nm
    }
    if not sizes:
        return []
    parts = {joint: by_region(found[joint].where) for joint in sizes}
    least = _SHOWN * max(sizes.values())
    shown = [r for r in Region if max(sizes[j] * parts[j].get(r, 0.0) for j in sizes) > least]
    traces = [
        rows_of_bars(r.value, list(sizes), [sizes[j] * parts[j].get(r, 0.0) for j in sizes], number)
        for number, r in enumerate(shown)
    ]
    caption = "The length of a row is the gap over the noise floor before anything is added; 1 is noise alone."
    title = "Where each joint's gap lies"
    return [Figure(title, tuple(traces), "gap / noise floor [1]", "joint", caption, stacked=True)]


def _before_and_after(runs: Sequence[JointRun]) -> Table:
    rows = []
    for run in runs:
        parts = max(2, int((run.time_s[-1] - run.time_s[0]) / PART_S))
        before = rms_by_part(run.measured - run.nominal, parts)
        told = [run.joint, run.quantity, f"{plain_rms(before):.3g}", "-", "-"]
        if run.improved is not None:
            after = rms_by_part(run.measured - run.improved, parts)
            left = paired_ratio_interval(before, after)
            told[3] = f"{plain_rms(after):.3g}"
            if left is not None:
                share = 100 * plain_rms(after) / plain_rms(before)
                told[4] = f"{share:.0f} % ({100 * left[0]:.0f} to {100 * left[1]:.0f} %)"
        rows.append(tuple(told))
    headings = ("joint", "difference to the machine", "your model", "improved", "left, noise included")
    caption = f"RMS along the motion below; in brackets the 95 % interval, from parts of {PART_S:g} s."
    return Table(headings, tuple(rows), caption=caption)


def _beside(run: JointRun) -> Figure:
    traces = [
        line("measured", run.time_s, run.measured, MEASURED, width=1),
        line("your model", run.time_s, run.nominal, PUBLISHED, width=1),
    ]
    if run.improved is not None:
        traces.append(line("improved", run.time_s, run.improved, IDENTIFIED, width=1))
    return Figure(f"{run.joint}, {run.log}", tuple(traces), "time [s]", run.quantity)
