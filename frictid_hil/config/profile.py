"""The friction profile: what was identified, how well, by what and where it holds. ``schema: frictid.profile/1``.

Every figure has six significant digits, fewer where its interval is wide, from the moment it is identified: what is
written, kept and used is the same to the last bit. What all joints share is written once, under ``all_joints``.
The same content gives the same bytes but for the ``provenance`` block.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from frictid_hil.config.provenance import Provenance
from frictid_hil.config.schema import Names, Strict, as_tuple, schema_version, validated
from frictid_hil.config.write import Row, dump, plain
from frictid_hil.config.yaml import Document, KeyPath, Node, merge, read
from frictid_hil.errors import ConfigError, ProfileMismatch
from frictid_hil.files import write_whole
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.linear_axis import linear_name, linear_names, rotary_name

KIND = "frictid.profile"
NEWEST = 1

_DIGITS = 6
_SECONDARY = 4  # digits of what is not the curve itself: half widths, both directions, figures of quality
_SAME_SPEED = 1e-3
_DERIVED = 1e-3  # how well the slopes in a file must follow from its pairs, as a share of the torque


def rounded(value: Any, digits: int = _DIGITS) -> Any:
    """Every float in it, at any depth, with so many significant digits."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, Mapping):
        return {key: rounded(item, digits) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(rounded(item, digits) for item in value)
    return value


Number = Annotated[float, AfterValidator(rounded)]
Pair = Annotated[tuple[Number, Number], BeforeValidator(as_tuple)]
Numbers = Annotated[tuple[Number, ...], BeforeValidator(as_tuple)]
Shortened = Annotated[
    tuple[float, ...], BeforeValidator(as_tuple), AfterValidator(lambda given: rounded(given, _SECONDARY))
]
Pairs = Annotated[tuple[Pair, ...], BeforeValidator(as_tuple)]
Figures = Annotated[dict[str, Any], AfterValidator(lambda given: rounded(given, _SECONDARY))]

MIGRATIONS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}
"""From a major version to the next, as pure functions of the values; the tests hold one golden file per version."""


class Estimate(Strict):
    """A figure with its 95 % interval, or the reason why there is none."""

    value: Number | None  # None where it could not be formed
    low: Number | None = None  # lower end of the interval, None where unknown
    high: Number | None = None  # upper end
    reason: str = ""  # why ``value`` is None, or why the interval is

    @model_validator(mode="before")
    @classmethod
    def _no_finer_than_wide(cls, given: Any) -> Any:
        """Ends to a hundredth of the width. The value keeps its digits: gravity and bias are better known together."""
        ends: list[Any] = [given.get("low"), given.get("high")] if isinstance(given, dict) else []
        before: list[Any] = []
        while (
            ends != before and all(isinstance(end, float) and abs(end) < math.inf for end in ends) and ends[0] < ends[1]
        ):
            places = 2 - math.floor(math.log10(ends[1] - ends[0]))
            before, ends = ends, [round(end, places) for end in rounded(ends)]
        return given | {"low": ends[0], "high": ends[1]} if before else given

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
    """Velocities and torques, shape (N,) each; in the order of the cycles."""

    velocity_rad_s: Numbers  # with their sign
    torque_nm: Numbers  # with their sign

    @model_validator(mode="after")
    def _equal_lengths(self) -> PairList:
        _same_length(self.velocity_rad_s, self.torque_nm)
        return self


class Ripple(Strict):
    """Torque that depends on where the motor stands, repeating over ``period_rad`` of the joint."""

    period_rad: Number = Field(gt=0)  # joint travel after which it repeats
    orders: Annotated[tuple[int, ...], BeforeValidator(as_tuple)] = ()  # waves per period, shape (k,)
    cos_nm: Shortened = ()  # amplitude of each wave's cosine of the position, shape (k,)
    sin_nm: Shortened = ()  # of its sine
    torque_nm: Numbers = ()  # instead of waves, at equal steps over one period, the first at position 0

    @model_validator(mode="after")
    def _sound(self) -> Ripple:
        if len(self.torque_nm) < 2 and not self.orders:
            raise ValueError("a ripple needs `orders`, `cos_nm` and `sin_nm`, or two values of `torque_nm`")
        if not len(self.orders) == len(self.cos_nm) == len(self.sin_nm):
            raise ValueError("`orders`, `cos_nm` and `sin_nm` belong together and must be equally long")
        return self

    @staticmethod
    def of_table(period_rad: float, torque_nm: ArrayLike) -> Ripple:
        """The waves of a ripple known at equal steps; those below 2 % of the largest are left out."""
        table = np.asarray(torque_nm, dtype=np.float64)
        waves = 2.0 * np.fft.rfft(table)[1 : (table.size + 1) // 2] / table.size
        orders = np.flatnonzero(np.abs(waves) > 0.02 * np.abs(waves).max(initial=0.0))
        if not orders.size:
            return Ripple(period_rad=period_rad, torque_nm=tuple(table.tolist()))
        kept = waves[orders]
        return Ripple(
            period_rad=period_rad,
            orders=tuple((orders + 1).tolist()),
            cos_nm=tuple(kept.real.tolist()),
            sin_nm=tuple((-kept.imag).tolist()),
        )

    def table_nm(self, points: int = 64) -> tuple[float, ...]:
        """At equal steps over one period, the first at position 0."""
        if self.torque_nm:
            return self.torque_nm
        phase = np.outer(np.arange(points) / points * 2 * np.pi, self.orders)
        return tuple((np.cos(phase) @ self.cos_nm + np.sin(phase) @ self.sin_nm).tolist())


class ProcedureUsed(Strict):
    """The motion that the curve was measured with; None for recordings that followed no procedure."""

    amplitude_rad: Number = Field(gt=0)  # travel A, peak-to-peak
    velocity_rad_s: Number = Field(gt=0)  # highest peak speed V
    cycles: int = Field(ge=1)  # number of cycles N
    ratio: Number = Field(ge=0, lt=1)  # share c of a cycle's peak speed, above which its samples count
    shares: Numbers | None = None  # peak speeds over V, of a short programme
    # joints that moved in phase with this one, itself among them; None where all others were locked
    together: Names | None = None


class TimeSkew(Strict):
    """By how much torque lags position, where it was measured: each with one standard deviation."""

    declared_s: Number  # by the drive or its robot file
    declared_deviation_s: Number = Field(ge=0)  # of it
    measured_s: Number  # by the shaking
    measured_deviation_s: Number = Field(ge=0)  # of it
    used_s: Number  # of both, weighed by their precision; the measured one alone where they disagree
    used_deviation_s: Number = Field(ge=0)  # of it


class DriveIdentity(Strict):
    """The drive the torque was read from: a curve is good only with the same one."""

    serial: str = ""  # serial number
    firmware: str = ""  # version
    product: str = ""  # vendor and product
    rated_torque_nm: Number | None = None  # joint side, what the drive calls 1000 per mille
    gear_ratio: Number | None = None  # motor revolutions per joint revolution
    settings: dict[str, Any] = Field(default_factory=dict)  # friction compensation, feed-forward, filters as read


class JudgedGate(Strict):
    """One question asked of a measurement, and its answer in plain words."""

    name: str  # of the gate
    passed: bool  # whether the measurement may be used
    message: str  # the figure and its limit, in words


def _gates(value: Any) -> Any:
    """From the file's ``name: passed`` or ``name: why not``."""
    if not isinstance(value, Mapping):
        return as_tuple(value)
    told = {name: str(answer) for name, answer in value.items()}
    return tuple(
        {"name": name, "passed": answer == _PASSED, "message": f"{name}: {answer}" if answer == _PASSED else answer}
        for name, answer in told.items()
    )


_PASSED = "passed"


def _at_speeds(given: Any, velocity_rad_s: tuple[float, ...]) -> dict[str, Any]:
    values = given.model_dump() if isinstance(given, PairList) else dict(given)
    own = values.get("velocity_rad_s", velocity_rad_s)
    if len(own) == len(velocity_rad_s) and all(
        abs(one - v) <= _SAME_SPEED * abs(v) for one, v in zip(own, velocity_rad_s, strict=True)
    ):
        values["velocity_rad_s"] = velocity_rad_s
    values["torque_nm"] = tuple(rounded(float(torque), _SECONDARY) for torque in values["torque_nm"])
    return values


def _half_widths(torque_nm: tuple[float, ...], intervals_nm: Any) -> tuple[float, ...] | None:
    """None where an interval is not symmetric about its F_n."""
    intervals = np.array(intervals_nm, dtype=np.float64)
    half = (intervals[:, 1] - intervals[:, 0]) / 2
    even = np.abs(intervals.mean(axis=1) - torque_nm) <= 0.01 * half + 1e-6 * np.abs(torque_nm)
    return tuple(half.tolist()) if np.all(even) else None


LOOP_STIFFNESS = "loop_stiffness_nm_per_rad"
"""Figure of ``quality``: what the drive's own position loop gives per rad, where that loop is proportional alone."""


class JointProfile(Strict):
    """One joint; on a linear axis the file says m, m/s, N (see ``linear_axis``) and these names hold them."""

    method: str  # estimator (``function-a``, ``aligned``, ``least-squares``)
    prismatic: bool = False  # a linear axis
    velocity_rad_s: Numbers = Field(min_length=2)  # V_1..V_N, positive, increasing, shape (N,)
    torque_nm: Numbers = Field(min_length=2)  # F_1..F_N, shape (N,)
    # half the width of each F_n's 95 % interval, shape (N,); None without intervals, or where they are not symmetric
    torque_plus_minus_nm: Numbers | None = None
    # 95 % interval of each F_n, shape (N, 2), or None; not in the file where the former is
    torque_interval_nm: Pairs | None = None
    measured_range_rad_s: Pair | None = None  # from V_1 to V_N; outside it the curve is an extrapolation
    slopes_nm_s_per_rad: Numbers | None = None  # of the lines that join the pairs
    coulomb_nm: Estimate  # F_0
    presliding_stiffness_nm_per_rad: Estimate = Field(default_factory=_not_identified)  # from a slow small reversal
    # friction of creeping motion, from the same: where presliding yields
    presliding_level_nm: Estimate = Field(default_factory=_not_identified)
    # how, from the same; ``at once`` also where it was not plain to see. ``unseen``: the encoder hides it, and the
    # stiffness is the least that is possible.
    presliding_yields: Literal["at once", "gradually", "unseen"] = "at once"
    inertia_kg_m2: Estimate = Field(default_factory=_not_identified)  # of the whole joint
    # of ``gravity_cos * cos(q) + gravity_sin * sin(q)``
    gravity_cos_nm: Estimate = Field(default_factory=_not_identified)
    gravity_sin_nm: Estimate = Field(default_factory=_not_identified)  # see there
    bias_nm: Estimate = Field(default_factory=_not_identified)  # constant torque
    # pairs of positive motion as averaged, gravity and bias included; mean speeds within 0.1 % of V_n are taken as V_n
    forward: PairList | None = None
    backward: PairList | None = None  # of negative motion
    # what Function A gives untouched, beside the chosen method; not in the file (``identify --method function-a`` gives
    # it again)
    published: PairList | None = None
    ripple: Ripple | None = None  # by position, where identified
    torque_source: str = ""  # what the torque is (``6077 actual torque``)
    time_skew_s: Number = 0.0  # by which torque was taken to lag position
    time_skew: TimeSkew | None = None  # where that was measured: declared, measured and used, with their uncertainty
    temperature_c: Number | None = None  # during the cycles
    procedure: ProcedureUsed | None = None  # V, A, N, c
    drive: DriveIdentity = DriveIdentity()  # that measured
    quality: Figures = Field(default_factory=dict)  # figures of quality by name
    gates: Annotated[tuple[JudgedGate, ...], BeforeValidator(_gates)] = ()  # questions and answers
    # when, where that is not when the profile was made: joints taken over from an older profile
    identified_utc: str = ""

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, given: Any) -> Any:
        """What the file leaves out because it follows: speeds of both directions, intervals. Nonsense stays."""
        if not isinstance(given, Mapping):
            return given
        completed = dict(given)
        with suppress(TypeError, ValueError, KeyError, OverflowError):
            velocity, torque = (tuple(map(rounded, as_tuple(given[name]))) for name in ("velocity_rad_s", "torque_nm"))
            for name, sign in (("forward", 1.0), ("backward", -1.0)):
                if completed.get(name) is not None:
                    completed[name] = _at_speeds(completed[name], tuple(sign * v for v in velocity))
            half = completed.get("torque_plus_minus_nm")
            if half is None and completed.get("torque_interval_nm") is not None:
                half = _half_widths(torque, completed["torque_interval_nm"])
            if half is not None:
                half = completed["torque_plus_minus_nm"] = tuple(rounded(float(h), _SECONDARY) for h in as_tuple(half))
                completed["torque_interval_nm"] = [(f - h, f + h) for f, h in zip(torque, half, strict=True)]
        return completed

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
        stated = self.measured_range_rad_s
        range_follows = stated is None or stated == self.curve().measured_range_rad_s
        for name, follows in (("measured range", range_follows), ("slopes", self._slopes_follow())):
            if not follows:
                raise ValueError(f"the {name} do not follow from the pairs; delete them, or undo the edit of the pairs")
        return self

    def curve(self) -> FrictionCurve:
        """phi of (8) through the pairs; beyond the measured range it goes on straight."""
        return FrictionCurve(self.velocity_rad_s, self.torque_nm)

    def interval_nm(self, velocity_rad_s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper end of the curve's 95 % interval at velocities of any shape, both directions, N m each.

        Between the pairs by straight lines; NaN where no interval is known: outside of [V_1, V_N], or without any.
        """
        v = np.asarray(velocity_rad_s, dtype=np.float64)
        ends = np.array(self.torque_interval_nm or [(np.nan, np.nan)] * len(self.velocity_rad_s))
        low, high = (np.interp(np.abs(v), self.velocity_rad_s, end, left=np.nan, right=np.nan) for end in ends.T)
        return np.where(v < 0, -high, low), np.where(v < 0, -low, high)

    def __call__(self, velocity_rad_s: ArrayLike) -> NDArray[np.float64]:
        """Friction torque [N m] at any velocity [rad/s], same shape: phi of (8), odd, 0 at rest."""
        return np.asarray(self.curve().torque(np.asarray(velocity_rad_s, dtype=np.float64)))

    def _slopes_follow(self) -> bool:
        """Of each section to a small part of the torque: older files have more digits."""
        if self.slopes_nm_s_per_rad is None:
            return True
        width = np.diff(self.velocity_rad_s)
        derived, stated = self.curve().slopes_nm_s_per_rad, np.array(self.slopes_nm_s_per_rad)
        if stated.shape != derived.shape:
            return False
        off_nm = np.abs(stated - derived) * np.concatenate([width[:1], width, width[-1:]])
        return bool(np.all(off_nm <= _DERIVED * np.abs(self.torque_nm).max()))

    def values(self) -> dict[str, Any]:
        """As the file holds it: derived figures filled in, empty things and messages of passed gates left out."""
        derived = {
            "measured_range_rad_s": self.curve().measured_range_rad_s,
            "slopes_nm_s_per_rad": tuple(rounded(self.curve().slopes_nm_s_per_rad.tolist(), _SECONDARY)),
        }
        values: dict[str, Any] = plain(self.model_copy(update=derived).model_dump(exclude_defaults=True))
        values["gates"] = {gate.name: _PASSED if gate.passed else gate.message for gate in self.gates}
        values.pop("published", None)
        values.pop("torque_interval_nm" if self.torque_plus_minus_nm else "torque_plus_minus_nm", None)
        for name, sign in (("forward", 1.0), ("backward", -1.0)):
            if name in values and values[name]["velocity_rad_s"] == [sign * v for v in self.velocity_rad_s]:
                del values[name]["velocity_rad_s"]
        if self.presliding_stiffness_nm_per_rad.value is None and self.presliding_level_nm.value is None:
            values.pop("presliding_level_nm", None)  # the stiffness says why
        quality = values.get("quality", {})
        values["quality"] = {key: value for key, value in quality.items() if value not in (None, [])}
        for name, value in values.items():
            if name in _IN_A_ROW or (isinstance(value, dict) and "value" in value):
                values[name] = Row(value)
        ordered = {name: values[name] for name in type(self).model_fields if values.get(name) not in (None, {}, "")}
        return linear_names(ordered) if self.prismatic else ordered


_IN_A_ROW = ("procedure", "time_skew", "ripple", "forward", "backward", "drive", "quality", "gates")
"""Mappings that a person reads as one line."""


class FrictionProfile(Strict):
    """All joints of one robot, as identified by one run."""

    robot: str  # name
    joints: dict[str, JointProfile] = Field(min_length=1)  # by name
    provenance: Provenance  # where it comes from

    def joint(self, name: str) -> JointProfile:
        """The joint of that name; ``ProfileMismatch`` where the profile has none."""
        if name not in self.joints:
            raise ProfileMismatch(
                f"the profile of {self.robot} has no joint {name!r}; it has {', '.join(self.joints)}",
                next_step=f"calibrate it: `frictid-hil calibrate --joint {name}`",
            )
        return self.joints[name]

    def identified_utc(self, name: str) -> str:
        """When a joint was identified."""
        return self.joint(name).identified_utc or self.provenance.created_utc

    def completed_by(self, older: FrictionProfile) -> FrictionProfile:
        """With the joints of an older profile of the same robot that this one lacks; itself where it lacks none."""
        taken = {
            name: joint.model_copy(update={"identified_utc": older.identified_utc(name)})
            for name, joint in older.joints.items()
            if name not in self.joints
        }
        if older.robot != self.robot or not taken:
            return self
        order = [*older.joints, *(name for name in self.joints if name not in older.joints)]
        joints = {name: taken[name] if name in taken else self.joints[name] for name in order}
        note = f"joints {', '.join(taken)} as in the profile of {older.provenance.created_utc}"
        provenance = self.provenance.model_copy(update={"notes": [*self.provenance.notes, note]})
        return FrictionProfile(robot=self.robot, joints=joints, provenance=provenance)

    def values(self) -> dict[str, Any]:
        """As the file holds it, in its order."""
        joints = {name: joint.values() for name, joint in self.joints.items()}
        shared = {key: value for key, value in _shared(list(joints.values())).items() if key in _SHARED}
        if len(joints) > 1 and shared:
            joints = {name: _without(values, shared) for name, values in joints.items()}
        return {
            "schema": f"{KIND}/{NEWEST}",
            "robot": self.robot,
            **({"all_joints": shared} if len(joints) > 1 and shared else {}),
            "joints": joints,
            "provenance": plain(self.provenance.model_dump(exclude_defaults=True)),
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
        """Write the file, whole or not at all; ``FrictidError`` where the disk is full or refuses."""
        write_whole(path, self.to_yaml())


_SHARED = ("method", "torque_source", "time_skew_s", "procedure", "drive", "gates")
"""What a file says once where it is the same for all joints."""


def _shared(several: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The entries that all of them have alike, at any depth."""
    first, *others = several
    same: dict[str, Any] = {}
    for key, value in first.items():
        if all(key in other and other[key] == value for other in others):
            same[key] = value
        elif isinstance(value, dict) and all(isinstance(other.get(key), dict) for other in others):
            part = _shared([value, *(other[key] for other in others)])
            same |= {key: part} if part else {}
    return same


def _without(values: dict[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    left = type(values)()
    for key, value in values.items():
        if key not in shared:
            left[key] = value
        elif value != shared[key]:
            left[key] = _without(value, shared[key])
    return left


def profile_file(given: Path) -> Path:
    """The profile itself, or that of a run folder."""
    return given / "profile.yaml" if given.is_dir() else given


def load_profile(path: str | Path) -> FrictionProfile:
    """Read and check a profile (``ConfigError``: unreadable, all problems, their places, another or a newer schema)."""
    return profile_from(read(Path(path)))


def profile_from(document: Document) -> FrictionProfile:
    """A profile from a document already read; raises as ``load_profile``."""
    version = schema_version(document, KIND, NEWEST)
    document = _with_rotary_names(_with_shared(document))
    values = document.data
    for major in range(version, NEWEST):
        values = MIGRATIONS[major](values)
    del values["schema"]
    return validated(document, FrictionProfile, values)


def _with_shared(document: Document) -> Document:
    """The same document with ``all_joints`` in every joint."""
    content = dict(document.root.content)
    shared, joints = content.pop("all_joints", None), content.get("joints")
    if shared is None or joints is None or not joints.is_mapping:
        return document
    content["joints"] = joints._replace(content={name: merge(shared, one) for name, one in joints.content.items()})
    return replace(document, root=document.root._replace(content=content))


def _with_rotary_names(document: Document) -> Document:
    """The same document with the joints of linear axes under rotary names, every value keeping its place."""
    joints = document.root.content.get("joints")
    if joints is None or not joints.is_mapping:
        return document
    said = {name: joint.content.get("prismatic") for name, joint in joints.content.items() if joint.is_mapping}
    linear = {name for name, prismatic in said.items() if prismatic is not None and prismatic.content is True}
    renamed = {name: _renamed(joint) if name in linear else joint for name, joint in joints.content.items()}

    def spelled(path: KeyPath) -> KeyPath:
        if len(path) < 2 or path[0] != "joints" or path[1] not in linear:
            return path
        return tuple(linear_name(key) if isinstance(key, str) else key for key in path)

    root = document.root._replace(content={**document.root.content, "joints": joints._replace(content=renamed)})
    return Document(document.path, root, spelled)


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
