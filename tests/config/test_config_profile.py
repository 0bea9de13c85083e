from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frictid_hil.config import profile as profile_module
from frictid_hil.config.profile import (
    DriveIdentity,
    Estimate,
    FrictionProfile,
    JointProfile,
    JudgedGate,
    PairList,
    ProcedureUsed,
    Ripple,
    load_profile,
    rounded,
)
from frictid_hil.config.provenance import Provenance, file_sha256, git_revision, utc_now
from frictid_hil.errors import ConfigError, ProfileMismatch

GOLDEN = Path(__file__).parent / "golden"
V = (0.187, 0.374, 0.561, 1.87)
F = (8.5, 9.25, 9.75, 12.0)


def joint(**changes: object) -> JointProfile:
    values: dict[str, object] = {
        "method": "aligned",
        "velocity_rad_s": V,
        "torque_nm": F,
        "torque_interval_nm": tuple((f - 0.1, f + 0.1) for f in F),
        "coulomb_nm": Estimate(value=7.75, low=7.6, high=7.9),
        "presliding_stiffness_nm_per_rad": Estimate.none("no slow reversal in this recording"),
        "inertia_kg_m2": Estimate(value=1.25, low=1.2, high=1.3),
        "gravity_cos_nm": Estimate(value=-31.0, low=-31.5, high=-30.5),
        "gravity_sin_nm": Estimate(value=0.5, reason="interval not formed: one repeat"),
        "forward": PairList(velocity_rad_s=V, torque_nm=(8.6, 9.35, 9.85, 12.1)),
        "backward": PairList(velocity_rad_s=tuple(-v for v in V), torque_nm=(-8.4, -9.15, -9.65, -11.9)),
        "published": PairList(velocity_rad_s=V, torque_nm=(8.4, 9.1, 9.6, 11.5)),
        "ripple": Ripple(period_rad=0.0314, torque_nm=(0.1, 0.0, -0.1, 0.0)),
        "torque_source": "6077 actual torque",
        "time_skew_s": 0.001,
        "temperature_c": 31.5,
        "procedure": ProcedureUsed(amplitude_rad=0.349, velocity_rad_s=2.007, cycles=4, ratio=0.8),
        "drive": DriveIdentity(serial="00012345", rated_torque_nm=50.0, gear_ratio=100.0, settings={"6072": 1000}),
        "quality": {"tracking_rms_rad": 0.0012, "samples_per_window": [402, 400, 398, 395]},
        "gates": (JudgedGate(name="tracking", passed=True, message="0.98 of the commanded peak speed was reached"),),
    }
    return JointProfile(**{**values, **changes})  # type: ignore[arg-type]


def profile(**joints: JointProfile) -> FrictionProfile:
    return FrictionProfile(
        robot="hp3j",
        joints=joints or {"0": joint(), "1": joint(torque_nm=(10.0, 11.0, 12.0, 20.0), ripple=None)},
        provenance=Provenance(created_utc="2026-11-21T05:15:00Z", driver="virtual", bus="virtual:hp3j", seed=1),
    )


def test_what_was_saved_is_loaded_to_the_last_bit(tmp_path: Path) -> None:
    saved = profile()
    saved.save(tmp_path / "p.yaml")
    loaded = load_profile(tmp_path / "p.yaml")
    left_out = {"measured_range_rad_s": None, "slopes_nm_s_per_rad": None, "published": None}
    gates = tuple(JudgedGate(name=gate.name, passed=True, message=f"{gate.name}: passed") for gate in joint().gates)
    for name, original in saved.joints.items():
        read = loaded.joint(name).model_copy(update=left_out)
        assert read == original.model_copy(update={"published": None, "gates": gates})
        assert loaded.joint(name).curve() == original.curve()
    assert loaded.to_yaml() == saved.to_yaml()
    assert loaded.content_sha256 == saved.content_sha256


floats = st.floats(min_value=1e-300, max_value=1e300)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.lists(floats, min_size=2, max_size=12, unique=True), st.data())
def test_any_curve_survives_the_file_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, velocities: list[float], data: st.DataObject
) -> None:
    velocities = sorted({rounded(velocity) for velocity in velocities})
    n = len(velocities)
    if n < 2:
        return
    torques = data.draw(st.lists(st.floats(-1e6, 1e6), min_size=n, max_size=n))
    one = JointProfile(
        method="aligned",
        velocity_rad_s=tuple(velocities),
        torque_nm=tuple(torques),
        coulomb_nm=Estimate.none("drawn by lot"),
    )
    if not np.all(np.isfinite(one.curve().slopes_nm_s_per_rad)):
        return
    path = tmp_path_factory.mktemp("bits") / "p.yaml"
    profile(a=one).save(path)
    assert load_profile(path).joint("a").curve() == one.curve()


words = st.text(min_size=1, alphabet="abc :#'\"\n-{}[]é", max_size=200)
figures = st.floats(1.0, 9.0)


@st.composite
def stored_joints(draw: st.DrawFn) -> JointProfile:
    count = draw(st.integers(2, 12))
    torque = sorted(draw(st.lists(figures, min_size=count, max_size=count, unique=True)))
    missing = draw(st.booleans())
    return JointProfile(
        method=draw(words),
        prismatic=draw(st.booleans()),
        velocity_rad_s=tuple(0.2 * (n + 1) for n in range(count)),
        torque_nm=tuple(torque),
        torque_interval_nm=draw(st.sampled_from([None, tuple((t - 0.1, t + 0.1) for t in torque)])),
        coulomb_nm=Estimate.none("why: - not") if missing else Estimate(value=draw(figures)),
        temperature_c=draw(st.one_of(st.none(), figures)),
        torque_source=draw(words),
        drive=DriveIdentity(settings={"a": {"joints": 1}, "gates": [{"name": draw(words)}]}),
        gates=tuple(JudgedGate(name=name, passed=draw(st.booleans()), message=draw(words)) for name in ("a", "b: c")),
    )


@pytest.mark.slow
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(joints=st.dictionaries(st.sampled_from(["0", "all_joints", "a: b", "- x", "é"]), stored_joints(), min_size=1))
def test_any_profile_survives_the_file(
    tmp_path_factory: pytest.TempPathFactory, joints: dict[str, JointProfile]
) -> None:
    whole = profile(**joints)
    path = tmp_path_factory.mktemp("any") / "p.yaml"
    whole.save(path)
    loaded = load_profile(path)
    assert loaded.to_yaml() == whole.to_yaml()
    for name, one in joints.items():
        kept = loaded.joints[name]
        assert (kept.curve(), kept.coulomb_nm, kept.temperature_c) == (one.curve(), one.coulomb_nm, one.temperature_c)
        assert (kept.method, kept.torque_source, kept.drive) == (one.method, one.torque_source, one.drive)
        assert {(g.name, g.passed) for g in kept.gates} == {(g.name, g.passed) for g in one.gates}
        assert {g.message for g in kept.gates if not g.passed} == {g.message for g in one.gates if not g.passed}


def test_arrays_of_the_mathematics_are_taken_as_they_are() -> None:
    one = joint(velocity_rad_s=np.array(V), torque_nm=np.array(F), torque_interval_nm=np.column_stack([F, F]))
    assert one.velocity_rad_s == V
    assert all(type(value) is float for value in one.torque_nm)


def test_same_content_gives_same_bytes_but_for_provenance() -> None:
    first = profile()
    later = first.model_copy(update={"provenance": Provenance(created_utc="2027-01-01T00:00:00Z")})
    head = first.to_yaml().split("provenance:")[0]
    assert later.to_yaml().split("provenance:")[0] == head
    assert later.to_yaml() != first.to_yaml()
    assert later.content_sha256 == first.content_sha256 != profile(a=joint()).content_sha256


def test_a_person_can_read_it() -> None:
    text = profile().to_yaml()
    assert "    velocity_rad_s: [0.187, 0.374, 0.561, 1.87]\n" in text
    assert "    coulomb_nm: {value: 7.75, low: 7.6, high: 7.9}\n" in text
    assert "    presliding_stiffness_nm_per_rad: {value: null, reason: no slow reversal in this recording}\n" in text
    assert "    measured_range_rad_s: [0.187, 1.87]\n" in text
    assert max(map(len, text.splitlines())) <= 120


def test_a_linear_axis_speaks_metres_and_newtons(tmp_path: Path) -> None:
    saved = profile(axis=joint(prismatic=True))
    saved.save(tmp_path / "p.yaml")
    text = (tmp_path / "p.yaml").read_text()
    for name in ("velocity_m_s:", "force_n:", "coulomb_n:", "mass_kg:", "slopes_n_s_per_m:", "amplitude_m:"):
        assert name in text
    assert "_nm" not in text.split("provenance:")[0]
    assert "_rad" not in text.split("provenance:")[0].replace("tracking_rms_rad", "")
    assert load_profile(tmp_path / "p.yaml").joint("axis").curve() == saved.joint("axis").curve()


def edited(folder: Path, old: str, new: str) -> ConfigError:
    text = profile(**{"0": joint()}).to_yaml()
    assert old in text, old
    path = folder / "p.yaml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load_profile(path)
    return caught.value


@pytest.mark.parametrize(
    ("old", "new", "where", "words"),
    [
        ("[0.187, 0.374,", "[0.374, 0.187,", "p.yaml:6:21", "V_2 = 0.187 does not rise above 0.374"),
        ("[0.187, 0.374,", "[-0.187, 0.374,", "p.yaml:6:21", "V_1 = -0.187 does not rise above 0"),
        ("[0.187, 0.374,", "[0.187, .nan,", "p.yaml:6:29", "finite"),
        ("[0.187, 0.374,", "[0.187, fast,", "p.yaml:6:29", "valid number, found 'fast'"),
        ("torque_nm: [8.5, 9.25,", "torque_nm: [8.5,", "p.yaml:5:5", "lists of 4 and 3 values"),
        ("torque_nm: [8.5, 9.25,", "torque_nm: [8.5, 9.5,", "p.yaml:5:5", "slopes do not follow from the pairs"),
        ("torque_nm: [8.5", "torque: [8.5", "p.yaml:7:5", "did you mean torque_nm?"),
        ("value: 7.75, low: 7.6", "value: 7.75, low: 8.6", "p.yaml:11:17", "above high"),
        ("value: 7.75, low: 7.6, high: 7.9", "value: null", "p.yaml:11:17", "needs a reason"),
        ("frictid.profile/1", "frictid.profile/2", "p.yaml:1:9", "newer than this program"),
        ("frictid.profile/1", "frictid.robot/1", "p.yaml:1:9", "this is a frictid.robot/1"),
        ("robot: hp3j\n", "robot: hp3j\nrobot: hp3j\n", "p.yaml:3:1", "appears twice"),
    ],
)
def test_a_spoilt_profile_is_refused_with_the_place(tmp_path: Path, old: str, new: str, where: str, words: str) -> None:
    error = edited(tmp_path, old, new)
    assert words in str(error)
    assert error.where == where


@pytest.mark.parametrize("name", ["torque_nm: [8.5", "torque_plus_minus_nm: [0.1"])
def test_a_number_that_no_float_holds_is_refused(tmp_path: Path, name: str) -> None:
    before, _, number = name.rpartition("[")
    error = edited(tmp_path, name, f"{before}[{number.replace('.', '')}{'9' * 400}")
    assert "expected a" in str(error) and error.where is not None and error.where.startswith("p.yaml:")


def test_errors_on_a_linear_axis_use_the_names_of_the_file(tmp_path: Path) -> None:
    text = profile(axis=joint(prismatic=True)).to_yaml()
    path = tmp_path / "p.yaml"
    path.write_text(text.replace("velocity_m_s: [0.187", "velocity_m_s: [-0.187", 1))
    with pytest.raises(ConfigError, match=r"p.yaml:7:19: joints.axis.velocity_m_s: V_1"):
        load_profile(path)
    path.write_text(text.replace("force_n: [", "torque_nm: [", 1))
    with pytest.raises(ConfigError, match=r"p.yaml:8:5: torque_nm: a linear axis says force_n"):
        load_profile(path)


def test_a_joint_that_is_not_there() -> None:
    with pytest.raises(ProfileMismatch, match="no joint '7'; it has 0, 1"):
        profile().joint("7")


def test_an_older_version_is_migrated_by_pure_functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    profile().save(tmp_path / "p.yaml")
    monkeypatch.setattr(profile_module, "NEWEST", 2)
    monkeypatch.setattr(profile_module, "MIGRATIONS", {1: lambda values: {**values, "robot": "migrated"}})
    assert load_profile(tmp_path / "p.yaml").robot == "migrated"


def test_six_joints_are_twelve_kilobytes_that_a_person_reads(tmp_path: Path) -> None:
    """With as many figures, and as long ones, as a calibration of ten cycles gives."""
    dice = np.random.default_rng(1)

    def measured(address: int) -> JointProfile:
        v: Any = np.linspace(0.1870112755, 1.8293683420470817, 10)
        f: Any = (5.0 + address) * (1.0 + v / 3.0) + dice.normal(0.0, 0.01, 10)
        half = 0.02 + 0.05 * dice.random(10)
        around = {
            name: Estimate(value=1e1**k / 3, low=1e1**k / 3.1, high=1e1**k / 2.9) for k, name in enumerate(FIGURES)
        }
        angle = np.arange(64) / 32 * np.pi
        return JointProfile(
            method="aligned",
            velocity_rad_s=v,
            torque_nm=f,
            torque_interval_nm=tuple(zip(f - half, f + half, strict=True)),
            **around,  # type: ignore[arg-type]
            forward=PairList(velocity_rad_s=v, torque_nm=f + 0.2),
            backward=PairList(velocity_rad_s=-v * 1.0001, torque_nm=0.2 - f),
            published=PairList(velocity_rad_s=v, torque_nm=f),
            ripple=Ripple.of_table(0.06283185307, 0.1187 * np.cos(2 * angle) - 0.049 * np.sin(2 * angle)),
            torque_source="6077 actual torque",
            time_skew_s=0.0005,
            temperature_c=25.0 + address,
            procedure=ProcedureUsed(amplitude_rad=0.3490658503988659, velocity_rad_s=2.0071286, cycles=10, ratio=0.8),
            drive=DriveIdentity(
                serial=f"106829341{address}",
                product="virtual servo (vendor 0x0, product 0x46524943)",
                rated_torque_nm=38.0 / 3,
                gear_ratio=80.0 + address,
                settings={"velocity low-pass, us": 1000, "gear (6091)": f"{80 + address}:1"},
            ),
            quality={
                "residual_rms_nm": 0.0322067438,
                "seen_delay_s": 2.72e-05,
                "asymmetry_nm": (f / 30).tolist(),
                "notes": [],
            },
            gates=tuple(
                JudgedGate(name=name, passed=True, message="0.98 of the peak speed " * 4) for name in "abcdefgh"
            ),
        )

    whole = profile(**{str(address): measured(address) for address in range(6)})
    text = whole.to_yaml()
    assert len(text) < 12_000
    assert max(map(len, text.splitlines())) <= 140 and text.count("0.349066") == 1, "what all share is said once"
    (tmp_path / "p.yaml").write_text(text)
    loaded = load_profile(tmp_path / "p.yaml")
    assert loaded.to_yaml() == text
    for name, one in whole.joints.items():
        assert loaded.joint(name).curve() == one.curve()
        assert (
            loaded.joint(name).model_copy(update={"published": one.published, "gates": one.gates}).values()
            == one.values()
        )


FIGURES = ("coulomb_nm", "presliding_level_nm", "inertia_kg_m2", "gravity_cos_nm", "gravity_sin_nm", "bias_nm")


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e6))
def test_rounding_an_estimate_again_changes_nothing(value: float, width: float) -> None:
    once = Estimate(value=value, low=value - width, high=value + width)
    assert Estimate(**once.model_dump()) == once
    assert once.low is not None and once.high is not None and once.low <= once.high
    assert abs(once.low - (value - width)) <= 0.01 * width + 1e-5 * (abs(value) + width)


def test_a_joint_is_a_function_of_velocity(tmp_path: Path) -> None:
    one = joint()
    velocity = np.linspace(-2.0, 2.0, 9).reshape(3, 3)
    assert np.array_equal(one(velocity), one.curve().torque(velocity))
    assert one([0.374, -0.374]).tolist() == [9.25, -9.25]
    low, high = one.interval_nm([0.187, -1.87, 0.0, 5.0])
    assert np.allclose(low[:2], [8.4, -12.1]) and np.allclose(high[:2], [8.6, -11.9])
    assert np.isnan(low[2:]).all() and np.isnan(high[2:]).all()
    assert np.isnan(joint(torque_interval_nm=None).interval_nm(1.0)).all()


def test_a_ripple_is_kept_as_its_waves() -> None:
    angle = np.arange(64) / 32 * np.pi
    table = 0.1187 * np.cos(2 * angle) - 0.049 * np.sin(5 * angle)
    kept = Ripple.of_table(0.0628, table)
    assert (kept.orders, kept.torque_nm) == ((2, 5), ())
    assert np.allclose(kept.table_nm(), table, atol=1e-6)
    assert Ripple.of_table(0.0628, np.zeros(8)).table_nm() == (0.0,) * 8


def test_a_file_with_all_digits_still_loads(tmp_path: Path) -> None:
    """As every profile was written before figures were rounded."""
    old, new = (load_profile(GOLDEN / name) for name in ("profile-1-all-digits.yaml", "profile-1.yaml"))
    assert old.to_yaml() == new.to_yaml()
    assert old.joint("0").gates[0].message.startswith("0.98 of the commanded")


@pytest.mark.parametrize("version", range(1, profile_module.NEWEST + 1))
def test_the_golden_file_of_every_version_still_loads(version: int) -> None:
    loaded = load_profile(GOLDEN / f"profile-{version}.yaml")
    assert loaded.joint("0").curve().torque_nm == F
    assert loaded.joint("axis").prismatic
    if version == profile_module.NEWEST:
        assert loaded.to_yaml() == (GOLDEN / f"profile-{version}.yaml").read_text()


def test_provenance_knows_time_revision_and_log(tmp_path: Path) -> None:
    log = tmp_path / "samples.mcap"
    log.write_bytes(b"abc" * 100_000)
    assert file_sha256(log) == hashlib.sha256(log.read_bytes()).hexdigest()
    assert Provenance.now(run="here").tool_version
    assert not Provenance(created_utc=utc_now()).tool_version, "a file without it was written by another version"
    assert len(git_revision().rstrip("+")) in (0, 40)
