"""The loop channel: measured torque against that of the believed joint, simulated under its known controller.

A coarse encoder hides along the measured motion what its controller answers to all the same. Here nothing is read from
a measured position. Each way in which the joint may differ is a torque along the believed motion, and its column is
what the controller makes of that.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import Channel, Rows
from frictid_hil.gap.experiment_set import Nominal, with_gains
from frictid_hil.gap.forward import Effects, Replayed, Simulation
from frictid_hil.gap.linear_loop import answered
from frictid_hil.gap.plant_channel import heard, no_louder, terms_of, without_nuisances
from frictid_hil.gap.residuals import LowPass, Recording, reported, rms

STANDS_S = 0.5  # time for which a joint must not leave its place to stand
COUNTS = 2.0  # of its encoder that it may flicker by


def loop_channel(
    nominal: Nominal,  # the believed joint
    believed: Sequence[Recording],  # it, recorded as the set was, its encoder without steps
    simulation: Simulation,
    beside: Effects,  # causes that show between demand and torque, which are known to be there
    library: Collection[str],  # effects that may be used
    estimated: Collection[str],  # as for the plant channel
    raw: tuple[float, float],  # of the plant channel
) -> Channel | None:
    """The channel of a set whose closed loop can be simulated; None where it runs away with what is beside."""
    with np.errstate(over="ignore", invalid="ignore"):
        runs, smooth = simulation.replay(beside), simulation.replay.without_steps()(beside)
    if not all(np.all(np.isfinite(run.torque_nm)) for run in (*runs.values(), *smooth.values())):
        return None
    gaps = [runs[r.experiment.name] for r in believed]
    views = [r.view for r in believed if r.view is not None]
    # The shapes to try are chosen by what is left of the torque.
    left = [replace(v, torque_nm=v.torque_nm + gap.torque_nm) for v, gap in zip(views, gaps, strict=True)]
    scale = rms(np.concatenate([gap.torque_nm[gap.settled :] for gap in gaps]))
    builder, known, candidates = terms_of(nominal, views, left, believed, library, estimated, scale)
    low_pass = believed[0].low_pass
    report = nominal.torque_report_filter
    assert nominal.controller is not None
    shares = beside.get("controller_gain_error")
    controller = nominal.controller if shares is None else with_gains(nominal.controller, list(shares.values()))
    rows = []
    for r, view, gap, blocks in zip(believed, views, gaps, builder.parts, strict=True):
        columns = answered(np.concatenate(blocks, axis=1), view, nominal, controller)
        table = low_pass.thinned(reported(columns, report, r.step_s))
        steps_nm = gap.torque_nm - smooth[r.experiment.name].torque_nm
        reach_rad = max(COUNTS * (nominal.encoder_resolution_rad or 0.0), view.coulomb_nm / view.stiffness_nm_per_rad)
        noise_nm = steps_nm + drift_nm(gap.torque_nm, view.position_rad + gap.position_rad, reach_rad, r.step_s)
        rows.append(no_louder(_rows(r, gap, table, noise_nm, low_pass)))
    step_s = believed[0].step_s * low_pass.stride
    rows = heard(without_nuisances(rows, known, candidates), simulation.white_nm, views[0].coulomb_nm, step_s)
    return Channel(
        "loop",
        step_s,
        tuple(rows),
        tuple(known),
        tuple(candidates),
        scale,
        low_pass.cutoff_hz,
        raw,
        known_floor=simulation.noise_nm,
    )


def drift_nm(torque_nm: Array, position_rad: Array, reach_rad: float, step_s: float) -> Array:
    """What torque differs by since a joint has come to stand, (n,): wherever friction holds it, the integral runs on.

    A joint stands that has not travelled further than ``reach_rad`` for ``STANDS_S``.
    """
    window = round(STANDS_S / step_s) + 1
    past = (window - 1) // 2  # the window ends at its row
    highest = ndimage.maximum_filter1d(position_rad, window, mode="nearest", origin=past)
    lowest = ndimage.minimum_filter1d(position_rad, window, mode="nearest", origin=past)
    stands = highest - lowest <= reach_rad
    stands[:window] = False
    comes = stands & ~np.concatenate([[False], stands[:-1]])
    since = np.maximum.accumulate(np.where(comes, np.arange(stands.size), 0))
    return np.asarray(np.where(stands, torque_nm - torque_nm[since], 0.0))


def _rows(r: Recording, gap: Replayed, table: np.ndarray, noise_nm: np.ndarray, low_pass: LowPass) -> Rows:
    """One log from where it has settled; its difference has passed the low-pass already."""
    first, stride = gap.settled // low_pass.stride + 1, low_pass.stride
    x = table[first:-2]
    y, noise = (column[::stride][first : first + x.shape[0]] for column in (gap.torque_nm, noise_nm))
    told = np.ones(y.size, dtype=bool)
    return Rows(r.experiment.name, r.experiment.validation, first * stride * r.step_s, y, x, noise, told)
