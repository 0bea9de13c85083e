from __future__ import annotations

import math
from pathlib import Path

import pytest

from frictid_hil.columns import Source
from frictid_hil.config.columns import load_columns
from frictid_hil.config.search import shipped_dir
from frictid_hil.errors import ConfigError

TEXT = """\
schema: frictid.columns/1
name: mine
time: {column: t, unit: ms}
joints:
  "1":
    meta: {torque_source: current}
    position: {column: q, unit: deg, offset: 0.5}
    velocity: {column: w, unit: rpm}
    torque: {product: [i, kt], unit: mNm, scale: -100}
"""


def test_units_become_factors(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(TEXT)
    columns = load_columns(tmp_path / "m.yaml")
    assert columns.time == Source(("t",), 1e6)
    joint = columns.joints["1"]
    assert joint.meta == {"torque_source": "current"}
    assert joint.sources["position_rad"] == Source(("q",), math.pi / 180, 0.5)
    assert joint.sources["velocity_rad_s"].scale == pytest.approx(2 * math.pi / 60)
    assert joint.sources["torque_nm"] == Source(("i", "kt"), -0.1)


@pytest.mark.parametrize(
    ("old", "new", "where", "words"),
    [
        ("unit: deg", "unit: grad", "m.yaml:7:33", "'grad' is not a unit of angle; it takes deg, rad, mrad"),
        ("unit: deg", "unit: m", "m.yaml:7:33", "not a unit of angle"),
        ("unit: ms", "unit: hours", "m.yaml:3:25", "'s', 'ms', 'us' or 'ns'"),
        ("column: w,", "column: w, product: [a, b],", "m.yaml:8:15", "either `column` or `product`"),
        ("column: w,", "", "m.yaml:8:15", "either `column` or `product`"),
        ("product: [i, kt]", "product: [i]", "m.yaml:9:23", "at least 2"),
        ("scale: -100", "scale: 0", "m.yaml:9:13", "leaves nothing"),
        ("torque: {", "torqe: {", "m.yaml:9:5", "did you mean torque?"),
        ("column: q,", "column: q, file: ../q.csv,", "m.yaml:7:33", "pattern"),
        ("    position:", "    pos:", "m.yaml:7:5", "did you mean position?"),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path: Path, old: str, new: str, where: str, words: str) -> None:
    (tmp_path / "m.yaml").write_text(TEXT.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load_columns(tmp_path / "m.yaml")
    assert words in str(caught.value)
    assert where in str(caught.value)


def test_a_joint_without_torque_and_command_has_nothing_to_explain(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(TEXT[: TEXT.index("    torque")])
    with pytest.raises(ConfigError, match="at least one of `torque` and `position_command`"):
        load_columns(tmp_path / "m.yaml")


@pytest.mark.parametrize("path", sorted((shipped_dir() / "columns").glob("*.yaml")), ids=lambda path: path.name)
def test_every_shipped_map_loads_by_its_name_alone(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_columns(path.name).name == path.stem
