"""The friction profile: what was identified, how well, by what and where it holds. ``schema: frictid.profile/1``.

A person can read the file; a program reads back the very same floats, so that the curve is the same to the last bit.
The same content gives the same bytes but for the ``provenance`` block.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from frictid_hil.config.provenance import Provenance
from frictid_hil.config.schema import Names, Numbers, Pair, Pairs, Strict, as_tuple, schema_version, validated
from frictid_hil.config.write import dump, plain, write_whole
from frictid_hil.config.yaml import Document, KeyPath, Node, read
from frictid_hil.errors import ConfigError, ProfileMismatch
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.linear_axis import linear_name, linear_names, rotary_name

KIND = "frictid.profile"
NEWEST = 1

MIGRATIONS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}
"""From a major version to the next, as pure functions of the values; the tests hold one golden file per version."""


class Estimate(Strict):
    """A figure with its 95 % interval, or the reason why there is none.

    Attributes:
        value: None where it could not be formed.
        low: lower end of the interval, None where unknown.
        high: upper end.
        reason: why ``value`` is None, or why the interval is.
    """

    value: float | None
    low: float | None = None
    high: float | None = None
    reason: str = ""

    @model_validator(mode="after")
    def _sound(self) -> Estimate:
        if self.value is None and not self.reason:
            raise ValueError("a missing value needs a reason")
        if (self.low is None) != (self.high is None):
            raise ValueError("an interval needs both `low` and `high`")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"low = {self.low} is above high = {self.high}")
        return self

    @staticmethod
    def none(reason: str) -> Estimate:
        """No figure, and why."""
        return Estimate(value=None, reason=reason)


def _not_identified() -> Estimate:
    return Estimate.none("not identified")


class PairList(Strict):
    """Velocities and torques, shape (N,) each; in the order of the cycles.

    Attributes:
        velocity_rad_s: with their sign.
        torque_nm: with their sign.
    """

    velocity_rad_s: Numbers
    torque_nm: Numbers

    @model_validator(mode="after")
    def _equal_lengths(self) -> PairList:
        _same_length(self.velocity_rad_s, self.torque_nm)
        return self


class Ripple(Strict):
    """Torque that depends on where the motor stands, repeating over ``period_rad`` of the joint.

    Attributes:
        period_rad: joint travel after which it repeats.
        torque_nm: at equal steps over one period, the first at position 0, shape (k,).
    """

    period_rad: float = Field(gt=0)
    torque_nm: Numbers = Field(min_length=2)


class ProcedureUsed(Strict):
    """V, A, N, c that the curve was measured with, and the shares of V of a short programme.

    None for recordings that followed no procedure. ``together`` names the joints that moved in phase with this one,
    itself among them; None where all others were locked.
    """

    amplitude_rad: float = Field(gt=0)
    velocity_rad_s: float = Field(gt=0)
    cycles: int = Field(ge=1)
    ratio: float = Field(ge=0, lt=1)
    shares: Numbers | None = None
    together: Names | None = None


class TimeSkew(Strict):
    """By how much torque lags position, where it was measured: each with one standard deviation.

    Attributes:
        declared_s: by the drive or its robot file.
        declared_deviation_s: of it.
        measured_s: by the shaking.
        measured_deviation_s: of it.
        used_s: of both, weighed by their precision; the measured one alone where they disagree.
        used_deviation_s: of it.
    """

    declared_s: float
    declared_deviation_s: float = Field(ge=0)
    measured_s: float
    measured_deviation_s: float = Field(ge=0)
    used_s: float
    used_deviation_s: float = Field(ge=0)


class DriveIdentity(Strict):
    """The drive the torque was read from: a curve is good only with the same one.

    Attributes:
        serial: serial number.
        firmware: version.
        product: vendor and product.
        rated_torque_nm: joint side, what the drive calls 1000 per mille.
        gear_ratio: motor revolutions per joint revolution.
        settings: friction compensation, feed-forward, filters as read.
    """

    serial: str = ""
    firmware: str = ""
    product: str = ""
    rated_torque_nm: float | None = None
    gear_ratio: float | None = None
    settings: dict[str, Any] = Field(default_factory=dict)


class Gate(Strict):
    """One question asked of a measurement, and its answer in plain words."""

    name: str
    passed: bool
    message: str


class JointProfile(Strict):
    """One joint; on a linear axis the file says m, m/s, N (see ``linear_axis``) and these names hold them.

    Attributes:
        method: estimator (``function-a``, ``aligned``, ``least-squares``).
        prismatic: a linear axis.
        velocity_rad_s: V_1..V_N, positive, increasing, shape (N,).
        torque_nm: F_1..F_N, shape (N,).
        torque_interval_nm: 95 % interval of each F_n, shape (N, 2), or None.
        coulomb_nm: F_0.
        presliding_stiffness_nm_per_rad: from a slow small reversal.
        presliding_level_nm: friction of creeping motion, from the same: where presliding yields.
        presliding_yields: how, from the same; ``at once`` also where it was not plain to see.
        inertia_kg_m2: of the whole joint.
        gravity_cos_nm: of ``gravity_cos * cos(q) + gravity_sin * sin(q)``.
        gravity_sin_nm: see there.
        bias_nm: constant torque.
        forward: pairs of positive motion as averaged, gravity and bias included.
        backward: of negative motion.
        published: what Function A gives untouched, beside the chosen method.
        ripple: by position, where identified.
        torque_source: what the torque is (``6077 actual torque``).
        time_skew_s: by which torque was taken to lag position.
        time_skew: where that was measured: declared, measured and used, with their uncertainty.
        temperature_c: during the cycles.
        procedure: V, A, N, c.
        drive: that measured.
        quality: figures of quality by name.
        gates: questions and answers.
    """

    method: str
    prismatic: bool = False
    velocity_rad_s: Numbers = Field(min_length=2)
    torque_nm: Numbers = Field(min_length=2)
    torque_interval_nm: Pairs | None = None
    measured_range_rad_s: Pair | None = None
    slopes_nm_s_per_rad: Numbers | None = None
    coulomb_nm: Estimate
    presliding_stiffness_nm_per_rad: Estimate = Field(default_factory=_not_identified)
    presliding_level_nm: Estimate = Field(default_factory=_not_identified)
    presliding_yields: Literal["at once", "gradually"] = "at once"
    inertia_kg_m2: Estimate = Field(default_factory=_not_identified)
    gravity_cos_nm: Estimate = Field(default_factory=_not_identified)
    gravity_sin_nm: Estimate = Field(default_factory=_not_identified)
    bias_nm: Estimate = Field(default_factory=_not_identified)
    forward: PairList | None = None
    backward: PairList | None = None
    published: PairList | None = None
    ripple: Ripple | None = None
    torque_source: str = ""
    time_skew_s: float = 0.0
    time_skew: TimeSkew | None = None
    temperature_c: float | None = None
    procedure: ProcedureUsed | None = None
    drive: DriveIdentity = DriveIdentity()
    quality: dict[str, Any] = Field(default_factory=dict)
    gates: Annotated[tuple[Gate, ...], BeforeValidator(as_tuple)] = ()

    @field_validator("velocity_rad_s")
    @classmethod
    def _rising(cls, velocities: tuple[float, ...]) -> tuple[float, ...]:
        for n, (before, velocity) in enumerate(pairwise((0.0, *velocities)), start=1):
            if velocity <= before:
                raise ValueError(f"V_{n} = {velocity} does not rise above {before}; V_n are positive and increasing")
        return velocities

    @model_validator(mode="after")
    def _sound(self) -> JointProfile:
        _same_length(self.velocity_rad_s, self.torque_nm)
        if self.torque_interval_nm is not None:
            _same_length(self.velocity_rad_s, self.torque_interval_nm)
        for name, stated in (("measured range", self.measured_range_rad_s), ("slopes", self.slopes_nm_s_per_rad)):
            derived = self.curve().measured_range_rad_s if name == "measured range" else self._slopes()
            if stated is not None and not _close(stated, derived):
                raise ValueError(f"the {name} do not follow from the pairs; delete them, or undo the edit of the pairs")
        return self

    def curve(self) -> FrictionCurve:
        """phi of (8) through the pairs."""
        return FrictionCurve(self.velocity_rad_s, self.torque_nm)

    def _slopes(self) -> tuple[float, ...]:
        return tuple(map(float, self.curve().slopes_nm_s_per_rad))

    def values(self) -> dict[str, Any]:
        """As the file holds it: plain, derived figures filled in, empty things left out."""
        filled = self.model_copy(
            update={"measured_range_rad_s": self.curve().measured_range_rad_s, "slopes_nm_s_per_rad": self._slopes()}
        )
        values: dict[str, Any] = plain(filled.model_dump())
        for name in _LEFT_OUT:
            if values[name] is None:
                del values[name]
        if self.procedure is not None:
            for name in ("shares", "together"):
                if values["procedure"][name] is None:
                    del values["procedure"][name]
        if self.presliding_level_nm.value is None:
            del values["presliding_level_nm"]  # the stiffness beside it says why
        if self.presliding_yields == "at once":
            del values["presliding_yields"]
        for value in values.values():
            if isinstance(value, dict) and "value" in value:
                _drop_nothings(value)
        if not self.prismatic:
            del values["prismatic"]
            return values
        renamed: dict[str, Any] = linear_names(values)
        return renamed


_LEFT_OUT = (
    "torque_interval_nm", "forward", "backward", "published", "ripple", "time_skew", "procedure", "temperature_c",
)  # fmt: skip
"""Not written where there is nothing of it."""


class FrictionProfile(Strict):
    """All joints of one robot, as identified by one run.

    Attributes:
        robot: name.
        joints: by name.
        provenance: where it comes from.
    """

    robot: str
    joints: dict[str, JointProfile] = Field(min_length=1)
    provenance: Provenance

    def joint(self, name: str) -> JointProfile:
        """The joint of that name.

        Raises:
            ProfileMismatch: the profile has none.
        """
        if name not in self.joints:
            raise ProfileMismatch(
                f"the profile of {self.robot} has no joint {name!r}; it has {', '.join(self.joints)}",
                next_step=f"calibrate it: `frictid-hil calibrate --joint {name}`",
            )
        return self.joints[name]

    def values(self) -> dict[str, Any]:
        """As the file holds it, in its order."""
        return {
            "schema": f"{KIND}/{NEWEST}",
            "robot": self.robot,
            "joints": {name: joint.values() for name, joint in self.joints.items()},
            "provenance": plain(self.provenance.model_dump()),
        }

    @property
    def content_sha256(self) -> str:
        """Of everything but provenance: equal for equal results, hexadecimal."""
        values = {key: value for key, value in self.values().items() if key != "provenance"}
        return hashlib.sha256(json.dumps(values, separators=(",", ":")).encode()).hexdigest()

    def to_yaml(self) -> str:
        """The file's text."""
        return dump(self.values())

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all.

        Raises:
            FrictidError: disk full, or no permission.
        """
        write_whole(path, self.to_yaml())


def profile_file(given: Path) -> Path:
    """The profile itself, or that of a run folder."""
    return given / "profile.yaml" if given.is_dir() else given


def load_profile(path: str | Path) -> FrictionProfile:
    """Read and check a profile.

    Raises:
        ConfigError: unreadable, wrong (every problem with file:line:column), of another schema or a newer version.
    """
    return profile_from(read(Path(path)))


def profile_from(document: Document) -> FrictionProfile:
    """A profile from a document already read; raises as ``load_profile``."""
    version = schema_version(document, KIND, NEWEST)
    document = with_rotary_names(document)
    values = document.data
    for major in range(version, NEWEST):
        values = MIGRATIONS[major](values)
    del values["schema"]
    return validated(document, FrictionProfile, values)


def with_rotary_names(document: Document) -> Document:
    """The same document with the joints of linear axes under rotary names, every value keeping its place."""
    joints = document.root.content.get("joints")
    if joints is None or not joints.is_mapping:
        return document
    linear = {name for name, joint in joints.content.items() if _is_linear(joint)}
    renamed = {name: _renamed(joint) if name in linear else joint for name, joint in joints.content.items()}

    def spelled(path: KeyPath) -> KeyPath:
        if len(path) < 2 or path[0] != "joints" or path[1] not in linear:
            return path
        return tuple(linear_name(key) if isinstance(key, str) else key for key in path)

    root = document.root._replace(content={**document.root.content, "joints": joints._replace(content=renamed)})
    return Document(document.path, root, spelled)


def _is_linear(joint: Node) -> bool:
    return joint.is_mapping and "prismatic" in joint.content and joint.content["prismatic"].content is True


def _renamed(node: Node) -> Node:
    if not isinstance(node.content, dict):
        return node
    for key, child in node.content.items():
        if isinstance(key, str) and linear_name(key) != key:
            raise ConfigError(f"{key}: a linear axis says {linear_name(key)}", where=str(child.key_place))
    return node._replace(
        content={rotary_name(k) if isinstance(k, str) else k: _renamed(v) for k, v in node.content.items()}
    )


def _same_length(first: tuple[Any, ...], second: tuple[Any, ...]) -> None:
    if len(first) != len(second):
        raise ValueError(f"lists of {len(first)} and {len(second)} values belong together and must be equally long")


def _close(stated: tuple[float, ...], derived: tuple[float, ...]) -> bool:
    scale = max(map(abs, derived))
    return len(stated) == len(derived) and all(abs(s - d) <= 1e-9 * scale for s, d in zip(stated, derived, strict=True))


def _drop_nothings(estimate: dict[str, Any]) -> None:
    for name in ("low", "high"):
        if estimate[name] is None:
            del estimate[name]
    if not estimate["reason"]:
        del estimate["reason"]
