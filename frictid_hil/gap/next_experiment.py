"""What to record next: the experiment in which two causes that a set cannot part behave differently."""

from __future__ import annotations

from frictid_hil.gap.diagnosis import NextExperiment

_PAIRS: tuple[tuple[frozenset[str], str, str, float], ...] = (
    (
        frozenset({"torque_bias", "direction_asymmetry"}),
        "sines_large",
        "sines over twice the travel and up to the top speed: a bias stays the same, an asymmetry grows with friction",
        26.0,
    ),
    (
        frozenset({"torque_bias", "encoder_offset"}),
        "second_posture",
        "the slow triangle around a second posture: a bias stays, an offset's torque follows sin(q)",
        26.0,
    ),
    (
        frozenset({"encoder_offset", "gravity_error"}),
        "second_posture",
        "the slow triangle around a second posture: gravity's error follows cos(q), an offset's sin(q)",
        26.0,
    ),
    (
        frozenset({"stribeck", "stiction_breakaway"}),
        "breakaway",
        "break-away after rests of 0.3 to 2.4 s at creep speed: only stiction depends on the rest",
        14.0,
    ),
    (
        frozenset({"torque_delay", "electrical_lag"}),
        "chirp",
        "a chirp up to 8 Hz: a lag damps high frequencies, a delay does not",
        11.0,
    ),
    (
        frozenset({"torque_delay", "presliding_hysteresis"}),
        "triangle_slow",
        "a slow triangle: presliding follows travel, a delay follows time",
        26.0,
    ),
    (
        frozenset({"gravity_error", "inertia_error"}),
        "sines_payload",
        "sines with the payload mounted: slow ones show gravity, fast ones inertia",
        13.0,
    ),
    (
        frozenset({"backlash", "joint_elasticity"}),
        "moves_payload",
        "moves through zero load torque: play shows there alone, elasticity everywhere under acceleration",
        12.0,
    ),
)
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
    for pair, name, text, duration_s in _PAIRS:
        if pair == {first, second}:
            return _planned(name, text, duration_s, (first, second))
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
