"""Only changes that bring the user's model nearer to recordings that were not fitted; what does not is left out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from frictid_hil.jobs.gap.closed_loop import closed_loop_gap, fitted, gap_of
from frictid_hil.jobs.gap.from_model import ArmSet
from frictid_hil.jobs.gap.write_model import Export, export_of, natives

Effects = Mapping[str, Mapping[str, float]]


def nearer_only(arm: ArmSet, made: Mapping[str, Export]) -> tuple[dict[str, Export], dict[str, Any]]:
    """The changes after which each changed joint is nearer to the machine, in the user's own closed loop.

    A joint whose interval reaches the gap that it had gets a part of its causes instead, the one that comes nearest
    along the motions that were fitted; if that is no nearer either, the joint stays as the user had it.

    Returns:
        The changes that stand, and ``closed_loop_gap`` with them. Its ``left_out`` says by joint which ``effects`` were
        not written, ``left_percent`` of the gap with them, and ``instead``, what was written.
    """
    kept = dict(made)
    left_out: dict[str, Any] = {}
    while True:
        told = closed_loop_gap(arm, natives(kept))
        left = told.get("left_percent", {})
        farther = {n: one for n, one in left.items() if not one["interval_95"] or one["interval_95"][1] >= 100.0}
        if not farther:
            return kept, {**told, "left_out": left_out}
        # One by one: a joint that is far off pulls at its neighbours.
        name = max(farther, key=lambda joint: float(farther[joint]["value"]))
        other = None if name in left_out else _another(arm, kept, name)
        written = set(other.model.effects) if other is not None else set()
        first = left_out.get(name, {"left_percent": farther[name]})
        left_out[name] = {
            "effects": [e for e in made[name].model.effects if e not in written] or ["friction"],
            "left_percent": first["left_percent"],
            "instead": sorted(written),
        }
        if other is None:
            del kept[name]
        else:
            kept[name] = other


def left_out_words(told: Mapping[str, Any]) -> list[str]:
    """A sentence for each joint of which something was not written; ``told`` is what ``nearer_only`` told."""
    words = []
    for name, one in told.get("left_out", {}).items():
        left, ends = one["left_percent"]["value"], one["left_percent"]["interval_95"]
        reach = f" ({ends[0]:.0f} to {ends[1]:.0f} %)" if ends else ""
        instead = f"{' and '.join(one['instead'])} alone" if one["instead"] else "nothing"
        words.append(
            f"{name}: {' and '.join(one['effects'])} would leave {left:.0f} %{reach} of its gap on recordings that "
            f"were not fitted, so {instead} is written"
        )
    return words


def _another(arm: ArmSet, made: Mapping[str, Export], name: str) -> Export | None:
    """A part of a joint's causes that comes nearest along the fitted motions; None where the joint as it was does."""
    if not made[name].form:
        return None  # chosen by the fitted positions already
    joint, others = arm.joints[name], {n: native for n, native in natives(made).items() if n != name}
    column = arm.recorded.index(name)

    def off(export: Export | None) -> float:
        changes = others if export is None else {**others, name: export.native}
        torque, position = gap_of(arm, changes, fitted(arm))
        return float(torque[column] if torque[column] >= 0.0 else position[column])

    tried = [
        export_of(arm, joint, effects, made[name].model.presliding_stiffness_nm_per_rad)
        for effects in _parts(made[name].model.effects)
    ]
    return min([None, *tried], key=off)


def _parts(effects: Effects) -> Iterator[Effects]:
    """Each effect alone, and all but each."""
    if len(effects) < 2:
        return
    for name, values in effects.items():
        yield {name: values}
    if len(effects) > 2:
        for name in effects:
            yield {other: values for other, values in effects.items() if other != name}
