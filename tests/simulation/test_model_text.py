"""A user's file is changed where it must be and nowhere else."""

from __future__ import annotations

from pathlib import Path

import pytest

from frictid_hil.errors import InputFileError
from frictid_hil.simulation.model_text import ModelText

MAIN = b"""<mujoco model="arm">
  <!-- mine -->
  <include file="parts/drives.xml"/>
  <worldbody>
    <body name='b'>   <joint name="swing"
        axis="0 0 1"   damping='0.1 > 0'/>  <!-- keep me -->
    </body>
  </worldbody>
  <actuator>
    <motor name="m" joint="swing"/>
  </actuator>
</mujoco>
"""
PART = b"""<mujocoinclude>
  <!-- theirs -->
  <equality><joint joint1="swing" name="swing"/></equality>
  <actuator><position joint="swing" kp="3"/></actuator>
</mujocoinclude>"""


@pytest.fixture
def text(tmp_path: Path) -> ModelText:
    (tmp_path / "parts").mkdir()
    (tmp_path / "arm.xml").write_bytes(MAIN)
    (tmp_path / "parts" / "drives.xml").write_bytes(PART)
    return ModelText(tmp_path / "arm.xml")


def test_an_attribute_is_changed_added_and_taken_away_and_all_else_stays(text: ModelText, tmp_path: Path) -> None:
    joint = text.joint("swing")
    text.set(joint, {"damping": "2 3 4", "armature": "0.5", "axis": None})
    made = text.written(tmp_path / "arm.xml")
    expected = MAIN.replace(
        b"""\n        axis="0 0 1"   damping='0.1 > 0'/>""", b""" damping="2 3 4" armature="0.5"/>"""
    )
    assert made == {tmp_path / "arm.xml": expected}


def test_elements_are_added_with_the_indent_of_their_neighbours(text: ModelText, tmp_path: Path) -> None:
    text.add_inside(text.section("actuator") or text.main.root, "<a/>\n<b/>")
    text.add_inside(text.actuators("swing")[-1], "<inner/>")
    text.add_after(text.joint("swing"), '<joint name="play"/>')
    content = text.written(tmp_path / "arm.xml")[tmp_path / "arm.xml"].decode()
    assert '    <joint name="play"/>  <!-- keep me -->' in content
    assert '<motor name="m" joint="swing">\n      <inner/>\n    </motor>' in content


def test_what_is_included_and_changed_is_written_beside_the_new_model(text: ModelText, tmp_path: Path) -> None:
    included = text.actuators("swing")[0]
    assert included.tag == "position", "elements stand in the order in which MuJoCo reads them"
    text.set(included, {"kp": "5"})
    out = tmp_path / "new" / "better.xml"
    made = text.written(out)
    assert made[tmp_path / "new" / "better_drives.xml"] == PART.replace(b'kp="3"', b'kp="5"')
    assert b'<include file="better_drives.xml"/>' in made[out]
    assert (tmp_path / "parts" / "drives.xml").read_bytes() == PART


def test_paths_of_what_stays_lead_there(tmp_path: Path, text: ModelText) -> None:
    content = MAIN.replace(b"  <worldbody>", b'  <asset><mesh file="a.stl"/></asset>\n  <worldbody>')
    (tmp_path / "arm.xml").write_bytes(content)
    out = tmp_path / "new" / "arm.xml"
    made = ModelText(tmp_path / "arm.xml").written(out)[out]
    assert b'<include file="../parts/drives.xml"/>' in made
    assert b'<compiler meshdir=".." texturedir=".."/>' in made


def test_a_joint_that_is_not_there_is_told(text: ModelText, tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="does not stand in the file by this name"):
        text.joint("elbow")
    (tmp_path / "parts" / "drives.xml").write_bytes(b"<mujocoinclude>")
    with pytest.raises(InputFileError, match=r"drives.xml: cannot be read"):
        ModelText(tmp_path / "arm.xml")
