"""``frictid-hil gap diagnose``: diagnose an experiment set, draw its page, write the improved joint as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.files import write_whole
from frictid_hil.gap.diagnose import diagnose as find_causes
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.jobs.improved_robot import improved_robot


def diagnose(
    folder: Path, *, write_model: Path | None = None, apply: bool = False, out: Path | None = None
) -> dict[str, Any]:
    """Diagnose a set.

    Args:
        folder: experiment set (``nominal.yaml`` and one CSV per log).
        write_model: robot file to write the improved joint to.
        apply: write it even where the verdict does not recommend it.
        out: folder for the report page; None writes none.

    Raises:
        InputFileError, ConfigError: the set is unusable.
        UsageError: a model was asked for and there is none to write.
    """
    experiments = ExperimentSet.load(folder)
    found = find_causes(experiments)
    result: dict[str, Any] = {"outcome": "ok", **found.to_json()}
    del result["schema"]  # the command line's own
    if write_model is not None:
        result["model"] = str(_write_model(write_model, experiments, found, apply).resolve())
    if out is not None:
        result["report"] = None
    return result


def _write_model(path: Path, experiments: ExperimentSet, found: Diagnosis, apply: bool) -> Path:
    if found.verdict in ("unknown", "ambiguous") and not apply:
        raise UsageError(
            f"the verdict is {found.verdict}: no cause is sure enough to change the simulator",
            where=str(experiments.folder),
            cause=found.summary,
            next_step="record the next experiment, or add --apply to write the best candidate all the same",
        )
    model = found.improved_model()
    if model is None:
        raise UsageError(
            "the closed loop of this joint cannot be simulated, so there is no joint to write",
            where=str(experiments.folder),
            cause="; ".join(f"{name}: {why}" for name, why in found.reasons.items()),
            next_step="add controller, drive and encoder to nominal.yaml",
        )
    write_whole(path, dump(improved_robot(experiments, model)))
    return path
