"""``--export`` and ``--randomise``: what they ask for, and samples that stay within what the diagnosis leaves open."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from frictid_hil.errors import UsageError
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, Value

pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.jobs.gap.exports import Wanted, write_targets
from frictid_hil.jobs.gap.from_model import ArmSet, ModelLogs, sets_from_model
from frictid_hil.jobs.gap.write_model import exports

MODEL = """<mujoco><compiler angle="radian"/><worldbody><body>
  <inertial pos="0.4 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
  <joint name="lift" axis="0 -1 0" frictionloss="2" damping="0.5" armature="0.2"/></body></worldbody>
  <actuator><position joint="lift" kp="500" kv="20"/></actuator></mujoco>"""


@pytest.fixture
def arm(tmp_path: Path) -> ArmSet:
    (tmp_path / "arm.xml").write_text(MODEL)
    time = np.arange(0, 6, 0.005)
    q = 0.6 * np.sin(1.3 * time) + 0.2 * np.sin(4.1 * time)
    table = np.column_stack([time, q, np.cos(q)])
    header = "time_s,position_rad,torque_nm"
    np.savetxt(tmp_path / "walk.csv", table, delimiter=",", header=header, comments="")
    return sets_from_model(ModelLogs(tmp_path / "arm.xml", [tmp_path / "walk.csv"]))


def test_words_are_read_and_refused() -> None:
    assert Wanted.of(["c=a.h", "bam=b.json"], 0).files == {"c": Path("a.h"), "bam": Path("b.json")}
    for words, samples in ((["drake=x"], 0), (["c"], 0), (["samples=s.json"], 0), ([], 5)):
        with pytest.raises(UsageError):
            Wanted.of(words, samples)


@pytest.mark.slow
@pytest.mark.parametrize("draws", [(), ({"torque_bias": {"bias_nm": 0.1}},)], ids=["no draws", "draws of others"])
def test_samples_spread_as_the_interval_says_and_nothing_is_written_over(
    arm: ArmSet, tmp_path: Path, draws: tuple[dict[str, dict[str, float]], ...]
) -> None:
    """What was read without a posterior is in no draw, as a link that was sought in closed loop."""
    cause = Cause("friction_level_error", 0.9, {"error_share": Value(0.5, 0.4, 0.6)})
    found = {"lift": Diagnosis("lift", "explained", (cause,), (), Figures(), Figures(), Figures(), samples=draws)}
    wanted = Wanted({"samples": tmp_path / "s.json", "c": tmp_path / "f.h"}, samples=200)
    told = write_targets(arm, found, exports(arm, found), wanted, force=False)
    drawn = json.loads((tmp_path / "s.json").read_text())["samples"]
    levels = np.array([sample["lift"]["dry_nm"] for sample in drawn])
    slopes = np.array([sample["lift"]["viscous_nm_s_per_rad"] for sample in drawn])
    assert levels.mean() == pytest.approx(3.0, rel=0.02) and levels.std() == pytest.approx(2.0 * 0.05, rel=0.2)
    assert np.corrcoef(levels, slopes)[0, 1] > 0.99, "a wrong level scales the whole curve, so both hang together"
    assert told["c"]["files"] == [str(tmp_path / "f.h")] and told["samples"]["lost"]
    with pytest.raises(UsageError, match="would be overwritten"):
        write_targets(arm, found, exports(arm, found), wanted, force=False)


@pytest.mark.slow
def test_numbers_of_a_sample_come_from_one_draw_of_the_posterior(arm: ArmSet, tmp_path: Path) -> None:
    causes = (
        Cause("friction_level_error", 0.9, {"error_share": Value(0.5, 0.1, 0.9)}),
        Cause("viscous_error", 0.9, {"error_share": Value(0.5, 0.1, 0.9)}),
    )
    shares = np.linspace(0.1, 0.9, 50)
    # The more level, the less slope; and every fifth draw has no error of the level at all.
    draws = tuple(
        ({} if k % 5 == 0 else {"friction_level_error": {"error_share": float(s)}})
        | {"viscous_error": {"error_share": float(1.0 - s)}}
        for k, s in enumerate(shares)
    )
    found = {"lift": Diagnosis("lift", "explained", causes, (), Figures(), Figures(), Figures(), samples=draws)}
    wanted = Wanted({"samples": tmp_path / "s.json"}, samples=300)
    write_targets(arm, found, exports(arm, found), wanted, force=False)
    drawn = [sample["lift"] for sample in json.loads((tmp_path / "s.json").read_text())["samples"]]
    held = [(one["dry_nm"], one["viscous_nm_s_per_rad"] / one["dry_nm"]) for one in drawn if one["dry_nm"] > 2.1]
    assert np.corrcoef(np.array(held).T)[0, 1] < -0.9
    assert 0.1 < np.mean([one["dry_nm"] < 2.1 for one in drawn]) < 0.3
