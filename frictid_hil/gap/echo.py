"""What a coarse encoder alone leaves in the plant channel: the nominal joint simulated with it, and nothing else wrong.

Steps of the position far beyond the travel of the slip spring reach the plant channel through everything that is
computed from position: bursts of velocity, a spring that jumps from one side to the other, a stuck joint that seems
to slide. No formula of noise describes that, but the simulator does it as the recording did. Its jumps come at other
times, so not the residual itself is used but its local size, as noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.forward import Effects, Replay
from frictid_hil.gap.residuals import LowPass, recordings

WINDOW_S = 0.5
"""Length over which the size is taken."""


def echoes_nm(experiments: ExperimentSet, replay: Replay, effects: Effects) -> dict[str, Array]:
    """Local RMS of the low-passed plant residual of the nominal joint with effects, per log, shape (n,).

    Args:
        experiments: the set, for its nominal joint and its commands.
        replay: simulates it.
        effects: parameters by effect.
    """
    simulated = replace(experiments, experiments=replay.simulated(effects))
    sizes = {}
    for recording in recordings(simulated):
        if recording.plant_nm is None:
            continue
        squares = LowPass.at(1.0 / recording.step_s)(recording.plant_nm) ** 2
        rows = min(max(1, round(WINDOW_S / recording.step_s)), squares.size)
        mean = np.convolve(squares, np.full(rows, 1.0 / rows), mode="same")
        sizes[recording.experiment.name] = np.sqrt(np.maximum(mean, 0.0))
    return sizes
