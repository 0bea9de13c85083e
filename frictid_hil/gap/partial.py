"""Diagnosis of sets that cannot be replayed in closed loop: inverse dynamics alone, or command and position alone."""

from __future__ import annotations

from collections.abc import Sequence

from frictid_hil.gap.diagnosis import Diagnosis, Figures
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.residuals import Recording


def diagnose_without_replay(
    experiments: ExperimentSet, logs: Sequence[Recording], allowed: tuple[str, ...], reason: str | None
) -> Diagnosis:
    """Placeholder shape; replaced below."""
    del logs, allowed
    return Diagnosis(
        experiments.name, "unknown", (), (), Figures(), Figures(), Figures(), reasons={"gap": reason or ""}
    )
