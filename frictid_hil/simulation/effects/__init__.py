"""All effects there are: every module of this folder that has an ``EFFECT``. Adding an effect is adding its file."""

from __future__ import annotations

import functools
import importlib
import pkgutil

from frictid_hil.simulation.effect import Effect


@functools.cache
def all_effects() -> dict[str, Effect]:
    """Every effect by name, in alphabetical order."""
    effects: dict[str, Effect] = {}
    for module in sorted(pkgutil.iter_modules(__path__), key=lambda found: found.name):
        effect: Effect = importlib.import_module(f"{__name__}.{module.name}").EFFECT
        if effect.name != module.name:
            raise RuntimeError(f"effect {effect.name!r} lives in {module.name}.py; file and name must agree")
        effects[effect.name] = effect
    return effects
