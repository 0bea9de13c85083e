"""All effects there are: every module of this folder that has an ``EFFECT``, and those that users add.

A user's own is an entry point of the group ``frictid_hil.effects``, named like the effect, that leads to it.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Iterator
from importlib.metadata import entry_points

from frictid_hil.errors import UsageError
from frictid_hil.simulation.effect import Effect

GROUP = "frictid_hil.effects"  # entry points of users' own effects


@functools.cache
def all_effects() -> dict[str, Effect]:
    """Every effect by name, sorted; ``UsageError`` for one that cannot be loaded, is none, or has a taken name."""
    effects: dict[str, Effect] = {}
    for module in sorted(pkgutil.iter_modules(__path__), key=lambda found: found.name):
        effect: Effect = importlib.import_module(f"{__name__}.{module.name}").EFFECT
        if effect.name != module.name:
            raise RuntimeError(f"effect {effect.name!r} lives in {module.name}.py; file and name must agree")
        effects[effect.name] = effect
    for effect in _added():
        if effect.name in effects:
            raise UsageError("there is an effect of this name already", where=f"entry point {GROUP}: {effect.name}")
        effects[effect.name] = effect
    return dict(sorted(effects.items()))


def _added() -> Iterator[Effect]:
    for point in entry_points(group=GROUP):
        where = f"entry point {GROUP}: {point.name} = {point.value}"
        try:
            effect = point.load()
        except Exception as error:  # whatever a foreign module does while it is imported
            raise UsageError(f"cannot be loaded: {error}", where=where) from error
        if not isinstance(effect, Effect) or effect.name != point.name:
            raise UsageError(f"this is no Effect named {point.name}", where=where)
        yield effect
