"""What to record next: the experiment in which two causes that a set cannot part behave differently."""

from __future__ import annotations

from frictid_hil.gap.diagnosis import NextExperiment
from frictid_hil.simulation.effects import all_effects

_DEFAULT = (
    "chirp",
    "the full set with varied motion: two travels, a slow triangle, a chirp, break-away, and payload on and off",
    150.0,
)
_STANDARD = ("sines_small", "sines_large", "triangle_slow", "sines_payload", "chirp", "breakaway")


def next_experiment(first: str, second: str, recorded: tuple[str, ...]) -> NextExperiment:
    """The experiment that parts two effects, as text and as a plan for ``gap record --plan``.

    Args:
        first: an effect.
        second: its rival.
        recorded: names of the experiments that the set already has.
    """
    for one, other in ((first, second), (second, first)):
        effect = all_effects().get(one)
        for parting in effect.parted if effect is not None else ():
            if parting.rival == other:
                return _planned(parting.experiment, parting.why, parting.duration_s, (first, second))
    missing = [name for name in _STANDARD if name not in recorded]
    if len(missing) >= 4:
        return _planned("all", _DEFAULT[1], _DEFAULT[2], (first, second))
    name = missing[0] if missing else _DEFAULT[0]
    return _planned(
        name, f"{name} once more with twice the travel, to part them by varied motion", 30.0, (first, second)
    )


def _planned(name: str, text: str, duration_s: float, separates: tuple[str, str]) -> NextExperiment:
    experiments = list(_STANDARD) if name == "all" else [name]
    plan = {"schema": "frictid.gap_plan/1", "experiments": experiments, "repeats": 1}
    return NextExperiment(text, duration_s, separates, plan)
