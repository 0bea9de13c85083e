"""Adds to the recording of a joint the joints that moved together with it, and the torque that they take from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.coupling import companions
from frictid_hil.friction.recording import CycleRecording
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.identification.declared import declared_skew
from frictid_hil.plan.plan import COUPLING
from frictid_hil.recording.samples import Samples


def with_companions(
    recording: CycleRecording, samples: Samples, company: Sequence[Samples], start_s: float
) -> CycleRecording:
    """The recording of one joint, knowing those that moved along.

    Samples are of whole runs; cycle 1 starts at run time ``start_s``.

    Raises:
        IdentificationError: the run has no coupling stretch, lacks a joint, or does not tell them apart.
    """
    marks = samples.marked(COUPLING)
    if not marks or any(other.torque_nm is None for other in company):
        raise IdentificationError("the run has no coupling stretch", where=recording.where)
    if not company:
        raise IdentificationError("the recording lacks the joints that moved along", where=recording.where)
    procedure, mark = recording.procedure, marks[0]
    stretches = {
        one.joint: _recording(one.during(mark), procedure, mark.start_ns * 1e-9) for one in (samples, *company)
    }
    first_ns, last_ns = (round((start_s + at) * 1e9) for at in (recording.time_s[0], recording.time_s[-1]))
    cycles = {
        one.joint: _recording(one.select((one.time_ns >= first_ns) & (one.time_ns <= last_ns)), procedure, start_s)
        for one in company
    }
    return replace(recording, companions=companions(stretches, cycles, samples.joint))


def _recording(samples: Samples, procedure: Procedure, start_s: float) -> CycleRecording:
    assert samples.torque_nm is not None  # by the caller
    gear_ratio = samples.meta.get("gear_ratio")
    return CycleRecording(
        time_s=samples.time_s - start_s,
        position_rad=samples.position_rad,
        torque_nm=samples.torque_nm,
        procedure=procedure,
        skew=declared_skew(samples),
        gear_ratio=float(gear_ratio) if gear_ratio else math.nan,
        prismatic=samples.prismatic,
        where=f"joint {samples.joint}",
    )
