from __future__ import annotations

import os
from pathlib import Path

import pytest

from frictid_hil.config.nominal import further_keys, load_nominal
from frictid_hil.errors import ConfigError

PRACTICE = Path(
    os.environ.get("FRICTID_PRACTICE_DATA", Path(__file__).parents[2].parent / "shared" / "data" / "gap-practice")
)

TEXT = """\
case: mine
note: anything a person wants to say
joint:
  inertia_kg_m2: 0.53
  gravity_torque_nm: 3.9
  gear_ratio: 51
  friction:
    velocity_rad_s: [0.2, 0.4]
    torque_nm: [3.0, 3.4]
controller: {rate_hz: 500, kp: 350}
experiments:
- {name: slow, role: identification, file: slow.csv}
- {name: fast, role: validation}
"""


def written(folder: Path, text: str) -> Path:
    (folder / "nominal.yaml").write_text(text)
    return folder


def test_a_small_file_is_enough(tmp_path: Path) -> None:
    nominal = load_nominal(written(tmp_path, "joint: {}\nexperiments: [{name: a, role: validation}]\n"))
    assert nominal.file.joint.inertia_kg_m2 is None
    assert nominal.file.experiments[0].role == "validation"


def test_values_and_further_keys_are_kept(tmp_path: Path) -> None:
    nominal = load_nominal(written(tmp_path, TEXT))
    assert nominal.file.joint.friction is not None
    assert nominal.file.joint.friction.torque_nm == (3.0, 3.4)
    assert nominal.document.data["note"] == "anything a person wants to say"
    assert further_keys(nominal.file) == ()
    colour = load_nominal(written(tmp_path, TEXT.replace("  gear_ratio: 51", "  colour: red\n  gear_ratio: 51")))
    assert further_keys(colour.file) == ("joint.colour",)


@pytest.mark.parametrize(
    ("old", "new", "where", "words"),
    [
        ("  inertia_kg_m2: 0.53", "  inertia_kgm2: 0.53", ":4:3", "did you mean inertia_kg_m2?"),
        ("0.53", "-0.53", ":4:18", "expected greater than or equal to 0"),
        ("0.53", "0.53 kg", ":4:18", "valid number"),
        ("[3.0, 3.4]", "[3.0]", ":8:5", "2 velocities and 1 torques"),
        ("[0.2, 0.4]", "[0.2, 0.2]", ":8:5", "each given once"),
        ("[0.2, 0.4]", "[0.2, fast]", ":8:27", "valid number"),
        ("kp: 350", "k_p: 350", ":10:13", "kp: missing in a controller of type pid; did you write it as k_p?"),
        ("  gear_ratio: 51", "  gravity_cos_nm: 51", ":4:3", "two names of one figure"),
        ("role: validation", "role: test", ":13:22", "'identification' or 'validation', found 'test'"),
        ("name: fast", "name: slow", ":13:10", "'slow' is also experiment 0"),
        ("name: fast, ", "", ":13:3", "name: missing"),
        ("joint:\n", "joints:\n", ":1:1", "missing"),
        (
            "joint:\n",
            "tolerance: {torque_constant: 10%}\njoint:\n",
            ":3:30",
            "tolerance.torque_constant: expected a valid number or 'data_sheet', 'cad' or 'profile', found '10%'",
        ),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path: Path, old: str, new: str, where: str, words: str) -> None:
    assert old in TEXT
    with pytest.raises(ConfigError) as caught:
        load_nominal(written(tmp_path, TEXT.replace(old, new, 1)))
    assert words in str(caught.value)
    assert f"nominal.yaml{where}: " in str(caught.value)


def test_a_folder_without_the_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no nominal.yaml in this folder"):
        load_nominal(tmp_path)


@pytest.mark.skipif(not PRACTICE.is_dir(), reason="no practice cases (FRICTID_PRACTICE_DATA)")
def test_every_practice_case_loads() -> None:
    folders = sorted((PRACTICE / "cases").iterdir())
    assert len(folders) == 16
    for folder in folders:
        nominal = load_nominal(folder)
        assert len(nominal.file.experiments) == 8
        assert sum(experiment.role == "validation" for experiment in nominal.file.experiments) == 2
