"""All effects as a page with pictures; ``python -m frictid_hil.simulation.catalogue docs/reference`` writes it."""

from __future__ import annotations

import argparse
from html import escape
from pathlib import Path

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Effect, Illustration
from frictid_hil.simulation.effects import all_effects

PAGE = "effects.md"
PICTURES = "effects"

_COLOURS = ("#8a8f98", "#1565c0", "#c62828")
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 480, 250, 64, 16, 28, 44

_INTRODUCTION = """# The effects

A plain joint has inertia, gravity, and a friction curve behind a presliding spring. Everything beyond that is one of
the effects below. A robot file's simulated joint may carry any of them, and the diagnosis looks for each of them:

```yaml
simulated:
  effects:
    stribeck:
      share: 0.2
      stribeck_velocity_rad_s: 0.035
```

A parameter that is left out takes its typical value if it shapes the effect, and is off if it sizes it. F_0 is the
joint's Coulomb level, phi_0(v) the part of its friction curve that depends on speed, q the joint's position, v its
velocity; all on the joint side of the gear.

*Channel* is where an effect shows: P, reported torque against the equation of motion; A, reported torque against the
controller's demand; K, reported velocity against differenced position. *Region* is the part of the motion.

`python -m frictid_hil.simulation.catalogue docs/reference` generates this page from `frictid_hil/simulation/effects/`.
A file that you add there is known to simulated joints, robot files and diagnosis; so is an entry point of a package:

```toml
[project.entry-points."frictid_hil.effects"]
hose_pull = "my_package.hose_pull:EFFECT"
```
"""


def page() -> str:
    """The whole page in Markdown."""
    effects = all_effects().values()
    rows = [
        f"| [{e.name}](#{e.name}) | {', '.join(c.value for c in e.signature.channels)} "
        f"| {', '.join(r.value for r in e.signature.regions)} |"
        for e in effects
    ]
    index = "\n".join(["| effect | channel | region |", "|---|---|---|", *rows])
    return "\n".join([_INTRODUCTION, index, "", *(section(effect) for effect in effects)])


def section(effect: Effect) -> str:
    """One effect in Markdown."""
    rows = [
        f"- `{p.name}`: {p.description}; {p.lower:g} to {p.upper:g}, "
        f"{'' if p.off is None else f'off {p.off:g}, '}typical {p.typical:g}"
        for p in effect.parameters
    ]
    name, picture_of_it = effect.name, f"{PICTURES}/{effect.name}.svg"
    parts = [f"## {name}", effect.summary, f"![{name}]({picture_of_it})", effect.documentation, "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def picture(illustration: Illustration) -> str:
    """A small line plot as SVG, readable on light and dark pages."""
    xs = np.concatenate([x for _, x, _ in illustration.curves])
    ys = np.concatenate([y for _, _, y in illustration.curves])
    x_low, x_high = _span(xs)
    y_low, y_high = _span(ys)
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM

    def across(x: Array) -> Array:
        return _LEFT + (x - x_low) / (x_high - x_low) * (right - _LEFT)

    def down(y: Array) -> Array:
        return bottom - (y - y_low) / (y_high - y_low) * (bottom - _TOP)

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif" '
        'font-size="11">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="#ffffff"/>',
        f'<path d="M{_LEFT} {_TOP}V{bottom}H{right}" fill="none" stroke="#333333"/>',
    ]
    colours = _COLOURS[1:] if len(illustration.curves) == 1 else _COLOURS
    for k, (label, x, y) in enumerate(illustration.curves):
        colour = colours[k % len(colours)]
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across(x), down(y), strict=True))
        lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.8"/>')
        lines.append(f'<text x="{_LEFT + 4 + 130 * k}" y="18" fill="{colour}">{escape(label)}</text>')
    for value in (x_low, (x_low + x_high) / 2, x_high):
        at = f'x="{across(np.array(value)):.1f}" y="{bottom + 15}" text-anchor="middle"'
        lines.append(f"<text {at}>{_figure(value, x_high - x_low)}</text>")
    for value in (y_low, (y_low + y_high) / 2, y_high):
        at = f'x="{_LEFT - 5}" y="{down(np.array(value)) + 4:.1f}" text-anchor="end"'
        lines.append(f"<text {at}>{_figure(value, y_high - y_low)}</text>")
    middle = (_LEFT + right) / 2
    lines.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(illustration.x_label)}</text>')
    middle = (_TOP + bottom) / 2
    turned = f'transform="translate(12 {middle:.0f}) rotate(-90)" text-anchor="middle"'
    lines.append(f"<text {turned}>{escape(illustration.y_label)}</text>")
    return "\n".join([*lines, "</svg>", ""])


def write(folder: Path) -> None:
    """Write the page and its pictures."""
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    (folder / PAGE).write_text(page(), encoding="utf-8")
    for effect in all_effects().values():
        text = picture(effect.illustrate(effect.typical))
        (folder / PICTURES / f"{effect.name}.svg").write_text(text, encoding="utf-8")


def _span(values: Array) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-12:
        return low - 1.0, high + 1.0
    # A level that starts at zero shall be seen to do so.
    if 0.0 < low < 0.5 * high:
        low = 0.0
    return low, high


def _figure(value: float, span: float) -> str:
    return "0" if abs(value) < 2e-3 * span else f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description="Write the page of effects.")
    arguments.add_argument("folder", type=Path)
    write(arguments.parse_args().folder)
