"""The closed loop as a judge: what takes the simulated joint further off is refuted, what brings it nearer leads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import gap_sets
import pytest

from frictid_hil.gap.borne_out import LITTLE, REFUTED, Loop, borne_out
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.forward import Effects, Replay, pooled
from frictid_hil.gap.verdict import DOUBTED, READ_DIRECTLY, Verdict

BACKLASH = {"gap_rad": 0.004, "contact_stiffness_nm_per_rad": 20000.0, "contact_relaxation_s": 0.004}


def cause(effect: str, where: str = "plant", chance: float = 0.99, **values: float) -> Finding:
    told = {name: Value(value, 0.9 * value, 1.1 * value) for name, value in (values or {"any": 1.0}).items()}
    return Finding(effect, chance, chance, 5.0, 1.0, told, (), where)


def loop(gaps_nm: Mapping[str, float], before_nm: float = 1.0, floor_nm: float = 0.02) -> Loop:
    """A loop whose gaps are told by a table; causes joined by "+" in the order of the alphabet, others far off."""

    def gap_nm(effects: Effects) -> float:
        return gaps_nm.get("+".join(sorted(effects)), 9.0)

    return Loop(gap_nm, before_nm, floor_nm)


def answer(said: Verdict, judge: Loop, *, open_along: bool = False) -> tuple[Verdict, str | None]:
    borne = borne_out(said, judge, open_along=open_along)
    return borne.said, borne.told


def test_a_pair_that_cancels_falls_and_the_cause_that_helps_leads() -> None:
    named = (cause("stribeck"), cause("viscous_error"), cause("inertia_error"))
    gaps = {"inertia_error": 0.1, "stribeck": 3.0, "viscous_error": 2.0}
    gaps |= {"inertia_error+stribeck": 2.9, "inertia_error+viscous_error": 1.9}
    said, told = answer(Verdict("explained", named), loop(gaps))
    assert said.word == "explained" and [f.effect for f in said.named] == ["inertia_error", "stribeck", "viscous_error"]
    assert said.named[0].chance == DOUBTED and said.named[1].chance == said.named[2].chance == REFUTED
    assert told is not None and "1 N m off, 0.1 with inertia_error" in told


def test_two_causes_that_help_only_together_stand() -> None:
    named = (cause("controller_gain_error"), cause("inertia_error"), cause("stribeck"))
    gaps = {"controller_gain_error": 1.5, "inertia_error": 1.4, "stribeck": 2.0}
    gaps |= {"controller_gain_error+inertia_error": 0.1, "controller_gain_error+inertia_error+stribeck": 1.2}
    said, told = answer(Verdict("explained", named), loop(gaps))
    assert said.word == "explained" and said.named[:2] == named[:2]
    assert said.named[2].chance == REFUTED
    assert told is not None and "0.1 with controller_gain_error and inertia_error" in told


@pytest.mark.parametrize(("bent_nm", "refuted"), [(0.1, False), (0.9, True)])
def test_a_cause_is_tried_with_the_errors_that_were_fitted_along(bent_nm: float, refuted: bool) -> None:
    """A bent curve and an error of the viscosity within its tolerance take a part of one another back."""
    gaps = {"electrical_lag": 0.9, "viscous_nonlinearity": 1.6, "electrical_lag+viscous_nonlinearity": 1.5}
    gaps |= {"viscous_error": 2.0, "electrical_lag+viscous_error": 1.9, "viscous_error+viscous_nonlinearity": 1.8}
    judge = loop({**gaps, "electrical_lag+viscous_error+viscous_nonlinearity": bent_nm})
    judge = replace(judge, tolerated={"viscous_error": {"error_share": -0.1}})
    named = (cause("viscous_nonlinearity"), cause("electrical_lag", "actuation"))
    said, _ = answer(Verdict("explained", named), judge)
    assert ("viscous_nonlinearity" in {f.effect for f in said.named if f.chance == REFUTED}) is refuted
    alone, _ = answer(Verdict("explained", named), replace(judge, tolerated={}))
    assert "viscous_nonlinearity" in {f.effect for f in alone.named if f.chance == REFUTED}


def test_a_rival_stands_in_the_place_of_a_cause_and_not_beside_it() -> None:
    first = replace(cause("load_dependent_friction", chance=0.75), rivals=("directional_efficiency",))
    named = (first, cause("directional_efficiency", chance=0.25))
    gaps = {"load_dependent_friction": 0.06, "directional_efficiency": 0.05}
    gaps |= {"directional_efficiency+load_dependent_friction": 1.2}
    assert answer(Verdict("explained", named), loop(gaps)) == (Verdict("explained", named), None)


def test_what_is_not_first_and_does_harm_is_refuted_sooner() -> None:
    named = (cause("encoder_offset"), cause("torque_constant_error"))
    gaps = {"encoder_offset": 0.1, "torque_constant_error": 1.1, "encoder_offset+torque_constant_error": 0.4}
    said, told = answer(Verdict("explained", named), loop(gaps))
    assert [f.chance for f in said.named] == [0.99, REFUTED]
    assert told is not None and "torque_constant_error would take it further off" in told


def test_what_does_harm_by_itself_and_none_among_all_stands() -> None:
    named = (cause("encoder_offset"), cause("torque_constant_error"), cause("gravity_error"))
    gaps = {"encoder_offset": 0.1, "torque_constant_error": 1.1, "gravity_error": 1.1}
    gaps |= {"encoder_offset+torque_constant_error": 0.4, "encoder_offset+gravity_error": 0.4}
    gaps |= {"encoder_offset+gravity_error+torque_constant_error": 0.1}
    assert answer(Verdict("explained", named), loop(gaps)) == (Verdict("explained", named), None)


def test_what_describes_the_gap_only_with_a_refuted_cause_must_close_the_loop() -> None:
    named = (cause("torque_bias"), cause("encoder_offset"))
    gaps = {"torque_bias": 0.55, "encoder_offset": 2.0, "encoder_offset+torque_bias": 1.2}
    said, told = answer(Verdict("explained", named), loop(gaps))
    assert (said.word, said.place) == ("unknown", LITTLE)
    assert told is not None and "0.55 with torque_bias; encoder_offset would take it further off" in told
    closing, _ = answer(Verdict("explained", named), loop(gaps | {"torque_bias": 0.45}))
    assert closing.word == "explained" and closing.named[0] == named[0]


def test_where_nothing_helps_the_gap_is_unknown() -> None:
    said, told = answer(Verdict("explained", (cause("joint_elasticity"),)), loop({"joint_elasticity": 1.3}))
    assert said.word == "unknown" and said.named[0].chance == REFUTED
    assert told is not None and "no cause helps" in told


def test_what_is_read_from_positions_stays_when_all_others_fall() -> None:
    """A coarse encoder that was read was taken back with a friction level that the loop refutes: `unknown`."""
    named = (cause("friction_level_error", chance=0.6), cause("encoder_quantisation", where=READ_DIRECTLY))
    gaps = {"friction_level_error": 3.0, "encoder_quantisation": 1.0}
    said, told = answer(Verdict("explained", named), loop(gaps))
    assert said.word == "explained" and told is not None and "friction_level_error" in told
    assert [(f.effect, f.confidence) for f in said.named] == [
        ("encoder_quantisation", 0.99),
        ("friction_level_error", REFUTED),
    ]


def test_a_cause_that_helps_too_little_leaves_an_unknown() -> None:
    named = (cause("torque_bias"), cause("inertia_error"))
    gaps = {"torque_bias": 9.0, "inertia_error": 0.5, "inertia_error+torque_bias": 9.0}
    said, _ = answer(Verdict("explained", named), loop(gaps))
    assert said.word == "unknown" and said.named[0].effect == "inertia_error"


@pytest.mark.parametrize("where", ["plant", READ_DIRECTLY])
def test_what_is_read_directly_needs_no_loop(where: str) -> None:
    said, _ = answer(Verdict("explained", (cause("stribeck", where),)), loop({"stribeck": 2.0}))
    assert (said.word == "explained") is (where == READ_DIRECTLY)


def test_causes_that_the_loop_hardly_feels_stay_as_they_are() -> None:
    verdict = Verdict("explained", (cause("friction_level_error"),))
    assert answer(verdict, loop({"friction_level_error": 0.99}, floor_nm=0.25)) == (verdict, None)


def test_causes_that_close_the_gap_neither_along_the_motion_nor_in_the_loop_explain_nothing() -> None:
    verdict = Verdict("explained", (cause("joint_elasticity"),))
    said, told = answer(verdict, loop({"joint_elasticity": 1.05}), open_along=True)
    assert said.word == "unknown" and said.named == verdict.named and "no cause helps" in (told or "")
    assert answer(verdict, loop({"joint_elasticity": 1.05}, floor_nm=0.25), open_along=False)[0].word == "explained"
    assert answer(verdict, loop({"joint_elasticity": 0.45}), open_along=True)[0].word == "explained"
    little = loop({"joint_elasticity": 0.85})
    assert answer(verdict, little, open_along=True)[0].place == LITTLE
    assert answer(verdict, replace(little, negligible_nm=0.9), open_along=True)[0].word == "explained"
    assert answer(verdict, replace(little, floor_nm=0.25), open_along=False)[0].word == "explained"
    in_the_noise = loop({"joint_elasticity": 0.031}, before_nm=0.03)
    assert answer(verdict, in_the_noise, open_along=True)[0].word == "explained"


def test_play_leads_where_the_motion_told_half_of_it() -> None:
    experiments = gap_sets.make({"backlash": BACKLASH}, only=("sines_small", "sines_large", "moves_payload"))
    replay = Replay(experiments)

    def gap_nm(effects: Effects) -> float:
        return pooled(replay(effects, validation=True), "torque_nm")

    half = cause("backlash", "plant", 0.99, **{**BACKLASH, "gap_rad": 0.5 * BACKLASH["gap_rad"]})
    wrong = cause("torque_constant_error", error_share=0.3)
    said, _ = answer(Verdict("unknown", (wrong, half)), Loop(gap_nm, gap_nm({}), 0.01))
    assert said.word == "explained" and said.named[0].effect == "backlash"
    told = {name: value.value for name, value in said.named[0].parameters.items()}
    assert gap_nm({"backlash": told}) < gap_nm({"backlash": {**BACKLASH, "gap_rad": 0.5 * BACKLASH["gap_rad"]}})


def test_a_cause_that_leaves_half_of_the_loop_open_is_doubted() -> None:
    named = (cause("torque_bias"), cause("inertia_error", chance=0.6))
    gaps = {"torque_bias": 0.6, "inertia_error": 1.0, "inertia_error+torque_bias": 0.6}
    said, told = answer(Verdict("explained", named), loop(gaps, floor_nm=0.2))
    assert told is None and [f.chance for f in said.named] == [DOUBTED, 0.6]
    gaps = {"torque_bias": 0.3, "inertia_error": 1.0, "inertia_error+torque_bias": 0.3}
    assert answer(Verdict("explained", named), loop(gaps, floor_nm=0.2))[0].named == named


def test_elasticity_that_the_motion_tells_badly_is_rescued_by_the_loop() -> None:
    elastic = cause("joint_elasticity", compliance_rad_per_nm=3e-4)

    def gap_nm(effects: Effects) -> float:
        return 0.1 + 2000.0 * abs(effects.get("joint_elasticity", {}).get("compliance_rad_per_nm", 1.0) - 2.1e-4)

    said, told = answer(Verdict("unknown", (elastic,)), Loop(gap_nm, 0.6, 0.02))
    assert said.word == "explained" and said.named[0].chance == DOUBTED
    assert said.named[0].parameters["compliance_rad_per_nm"].value == pytest.approx(2.1e-4, rel=0.01)
    assert told is not None and "would take" not in told


@pytest.mark.parametrize(("open_along", "word"), [(False, "explained"), (True, "unknown")])
def test_friction_that_describes_the_motion_is_tried_with_other_numbers_where_the_joint_sticks(
    open_along: bool, word: str
) -> None:
    """The joint let go too early with a Stribeck velocity a third too high, and half of its gap stayed: `unknown`."""
    falling = cause("stribeck", share=0.5, stribeck_velocity_rad_s=0.056)

    def gap_nm(effects: Effects) -> float:
        told = effects.get("stribeck")
        return 1.0 if told is None else 0.1 + 30.0 * abs(told["stribeck_velocity_rad_s"] - 0.039)

    said, told = answer(Verdict("explained", (falling,)), Loop(gap_nm, 1.0, 0.02), open_along=open_along)
    assert said.word == word
    velocity = said.named[0].parameters["stribeck_velocity_rad_s"].value
    assert velocity == pytest.approx(0.056 if open_along else 0.039, rel=0.03)
    assert (told or "").endswith("with stribeck")


def test_play_of_a_fifth_of_its_size_is_rescued_beside_a_larger_cause() -> None:
    """Gravity took most of the gap, play as the motion tells it next to nothing, and the rest was `unknown`."""
    play = cause("backlash", gap_rad=2e-3, contact_stiffness_nm_per_rad=2e5, contact_relaxation_s=3e-3)
    gravity = cause("gravity_error", error_share=0.15)

    def gap_nm(effects: Effects) -> float:
        heavy = 0.0 if "gravity_error" in effects else 0.4
        slack = 0.2 * max(0.0, 1.0 - effects.get("backlash", {}).get("gap_rad", 0.0) / 8e-3)
        return 0.04 + heavy + slack

    said, told = answer(Verdict("unknown", (gravity, play)), Loop(gap_nm, 0.64, 0.04))
    assert (said.word, [f.effect for f in said.named]) == ("explained", ["gravity_error", "backlash"])
    assert said.named[1].parameters["gap_rad"].value >= 7e-3 and said.named[0].chance == DOUBTED
    assert told is not None and "gravity_error and backlash" in told


def test_play_beside_another_cause_is_refined_too_and_may_leave_a_third() -> None:
    """Play whose columns told two thirds of its gap stood second, and the loop that it closes was `unknown`."""
    play = cause("backlash", gap_rad=1.5e-3, contact_stiffness_nm_per_rad=2e5, contact_relaxation_s=3e-3)
    named = (cause("stribeck"), cause("temperature_drift"), play)

    def gap_nm(effects: Effects) -> float:
        gap = 3.0 if "stribeck" in effects else 1.0
        gap -= 0.3 if "temperature_drift" in effects else 0.0
        if "backlash" in effects:
            gap -= 0.4 - 300.0 * abs(effects["backlash"]["gap_rad"] - 2.1e-3)
        return gap

    said, _ = answer(Verdict("explained", named), Loop(gap_nm, 1.0, 0.02))
    assert said.word == "explained"
    assert {f.effect for f in said.named[:2]} == {"temperature_drift", "backlash"}
    (backlash,) = [f for f in said.named if f.effect == "backlash"]
    assert backlash.parameters["gap_rad"].value == pytest.approx(2.1e-3, rel=0.01)
    left = loop({"stribeck": 3.0, "torque_bias": 0.3, "stribeck+torque_bias": 3.0})
    assert answer(Verdict("explained", (cause("stribeck"), cause("torque_bias"))), left)[0].word == "unknown"


@pytest.mark.parametrize(("left_nm", "before_nm", "place", "word"), [
    (0.15, 1.0, "plant: position", "explained"),
    (0.25, 1.0, "plant: position", "unknown"),  # outsiders leave a third
    (0.02, 0.03, "plant: position", "unknown"),  # no gap shows in the loop, and closing it says nothing
    (0.15, 1.0, "actuation: time", "unknown"),  # the loop does not feel it
])  # fmt: skip
def test_what_has_no_name_along_the_motion_is_no_gap_where_the_causes_close_the_loop(
    left_nm: float, before_nm: float, place: str, word: str
) -> None:
    """A friction level of 44 floors was `unknown` for functions without a name in a coarse encoder's rest."""
    named = (cause("gravity_error", chance=0.6), cause("friction_level_error"))
    gaps = {"friction_level_error": left_nm, "gravity_error": before_nm, "friction_level_error+gravity_error": left_nm}
    borne = borne_out(Verdict("unknown", named, place), loop(gaps, before_nm))
    assert borne.said.word == word
    if word == "explained":
        assert [(f.effect, f.chance) for f in borne.said.named] == [
            ("friction_level_error", DOUBTED),
            ("gravity_error", 0.6),
        ]
        assert borne.idle == {"gravity_error"}


@pytest.mark.parametrize(("left_nm", "word"), [(0.68, "explained"), (0.8, "unknown")])
def test_a_loop_closes_where_what_stays_is_no_louder_than_its_noise(left_nm: float, word: str) -> None:
    """Play of 1.9 floors was `unknown`: it left an eighth of a gap that is hardly a floor beside the noise."""
    named = (cause("inertia_error"), cause("backlash", gap_rad=1e-3))
    gaps = {"backlash": left_nm, "inertia_error": 1.4, "backlash+inertia_error": 1.5}
    said, _ = answer(Verdict("explained", named), loop(gaps, floor_nm=0.5))
    assert said.word == word and said.named[0].effect == "backlash"


@pytest.mark.parametrize(
    ("place", "word"), [("plant: time", "explained"), ("actuation: a cause that comes and goes", "unknown")]
)
def test_a_loop_that_closes_once_a_cause_is_refuted_says_nothing_of_what_is_seen_by_itself(
    place: str, word: str
) -> None:
    """Commands that a drive misses now and then were a lag, as the loop refuted another small cause beside it."""
    named = (cause("electrical_lag", "actuation"), cause("torque_constant_error"))
    gaps = {"electrical_lag": 0.1, "torque_constant_error": 1.6, "electrical_lag+torque_constant_error": 1.0}
    said, told = answer(Verdict("unknown", named, place), loop(gaps))
    assert said.word == word and said.named[1].chance == REFUTED
    assert told is not None and "0.1 with electrical_lag" in told


def test_a_cause_without_numbers_is_not_simulated() -> None:
    """It took its typical size, and was borne out or refuted by that."""
    unknown = replace(cause("stribeck"), parameters={})
    gaps = {"torque_bias": 0.1, "stribeck": 3.0, "stribeck+torque_bias": 3.0}
    said, told = answer(Verdict("explained", (cause("torque_bias"), unknown)), loop(gaps))
    assert said.named == (cause("torque_bias"), unknown) and told is None


def test_a_cause_gains_what_its_refuted_rivals_had() -> None:
    """A torque bias of 2 floors had 0.6 beside a gravity that the loop refutes, and stood behind a smaller cause."""
    bias = replace(cause("torque_bias", chance=0.55), rivals=("gravity_error",))
    named = (cause("friction_level_error"), bias, cause("gravity_error", chance=0.4), cause("stribeck", chance=0.3))
    gaps = {"friction_level_error": 0.6, "torque_bias": 0.5, "friction_level_error+torque_bias": 0.1, "stribeck": 1.0}
    gaps |= {"friction_level_error+stribeck": 0.6, "friction_level_error+stribeck+torque_bias": 0.1}
    said, _ = answer(Verdict("explained", named), loop(gaps))
    assert {f.effect: f.chance for f in said.named} == {
        "friction_level_error": 0.99, "torque_bias": DOUBTED, "stribeck": 0.3, "gravity_error": 0.4
    }  # fmt: skip


@pytest.mark.parametrize(("guessed", "word"), [(False, "explained"), (True, "unknown")])
def test_what_a_guess_alone_has_must_bring_the_joint_nearer(guessed: bool, word: str) -> None:
    """Gains that a demand between rows had, and that left all of 4 floors in closed loop, were sure."""
    named = (cause("controller_gain_error", "actuation"),)
    judge = replace(loop({"controller_gain_error": 1.02}, floor_nm=0.25), guessed=guessed)
    said, _ = answer(Verdict("explained", named), judge)
    assert said.word == word


@pytest.mark.parametrize(("floor_nm", "word"), [(0.02, "unknown"), (0.3, "explained")])
def test_what_closes_along_the_motion_alone_explains_no_gap_of_many_floors(floor_nm: float, word: str) -> None:
    """A cable of 28 floors was a bias and a gravity, which left 32 floors of the closed loop's 37."""
    named = (cause("torque_bias"), cause("gravity_error"))
    gaps = {"torque_bias": 0.95, "gravity_error": 0.93, "gravity_error+torque_bias": 0.85}
    assert answer(Verdict("explained", named), loop(gaps, floor_nm=floor_nm))[0].word == word


def test_play_whose_numbers_the_motion_tells_badly_stands_beside_causes_that_are_refuted() -> None:
    """Play of 13 floors was `unknown`: the motion told an eighth of it and made up for it by wrong causes."""
    play = cause("backlash", gap_rad=1e-3, contact_stiffness_nm_per_rad=2e5, contact_relaxation_s=3e-3)

    def gap_nm(effects: Effects) -> float:
        slack = abs(effects.get("backlash", {}).get("gap_rad", 0.0) - 4e-3) / 4e-3
        return 0.04 + 0.6 * slack + (1.0 if "torque_constant_error" in effects else 0.0)

    named = (cause("torque_constant_error", error_share=0.1), play)
    said, told = answer(Verdict("unknown", named), Loop(gap_nm, 0.64, 0.04))
    assert (said.word, [f.effect for f in said.named]) == ("explained", ["backlash", "torque_constant_error"])
    assert said.named[1].chance == REFUTED and told is not None and "with backlash" in told
