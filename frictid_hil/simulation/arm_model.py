"""An arm as a value: what a robot file's ``simulated_arm`` mapping says of the links, checked.

The frame of a link has its origin and z axis on the joint that carries it and turns with it; x is that of the row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from frictid_hil.kinematics import DhRow
from frictid_hil.simulation.fields import Fields

Triple = tuple[float, float, float]

STANDARD_GRAVITY: Triple = (0.0, 0.0, -9.81)


@dataclass(frozen=True, slots=True)
class Link:
    """What one joint carries up to the next; motors' rotors excluded, they belong to the joints."""

    mass_kg: float  # of the link
    centre_m: Triple  # of mass, in the link's frame
    inertia_kg_m2: Triple  # about the centre, principal, along the axes of the link's frame


@dataclass(frozen=True, slots=True)
class ArmModel:
    """A chain of links on a fixed base."""

    rows: tuple[DhRow, ...]  # where the joints are
    links: tuple[Link, ...]  # one per joint
    gravity_m_s2: Triple = STANDARD_GRAVITY  # in the base frame

    @staticmethod
    def from_mapping(mapping: Mapping[str, Any], rows: Mapping[str, Mapping[str, float]]) -> ArmModel:
        """The arm of ``simulated_arm`` and its joints' ``dh``, by name in the order of the chain; empty for none.

        Every unknown key, missing or impossible value is told by an ``InvalidFields``, with its path.
        """
        top = Fields(mapping)
        gravity = _triple(top, "gravity_m_s2", STANDARD_GRAVITY)
        parts = top.part("links")
        links = []
        for name, row in rows.items():
            if not row:
                top.problem("", f"needs the Denavit-Hartenberg row (`dh`) of joint {name}")
            links.append(_link(parts.part(name), present=name in parts, top=parts, name=name))
        parts.no_others()
        top.no_others()
        top.finish()
        return ArmModel(tuple(DhRow(**row) for row in rows.values()), tuple(links), gravity)


def _link(fields: Fields, *, present: bool, top: Fields, name: str) -> Link:
    if not present:
        top.problem(name, "is required: mass_kg, centre_m, inertia_kg_m2")
        return Link(1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    link = Link(
        mass_kg=fields.number("mass_kg", low=1e-6, high=1e6),
        centre_m=_triple(fields, "centre_m", None),
        inertia_kg_m2=_triple(fields, "inertia_kg_m2", None),
    )
    smallest, middle, largest = sorted(link.inertia_kg_m2)
    if smallest <= 0.0 or smallest + middle < largest:
        fields.problem("inertia_kg_m2", "no body has these: each must be above 0 and at most the sum of the other two")
    fields.no_others()
    return link


def _triple(fields: Fields, key: str, default: Sequence[float] | None) -> Triple:
    values = fields.numbers(key) if default is None or key in fields else list(default)
    if len(values) != 3:
        if values:
            fields.problem(key, f"expected three numbers, found {len(values)}")
        return (1.0, 1.0, 1.0)
    return values[0], values[1], values[2]
