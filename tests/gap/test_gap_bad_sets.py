"""Sets that cannot be right: a clear error that names file, line, column and what was expected; never a verdict."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gap_sets
import numpy as np
import pytest
import yaml

from frictid_hil.errors import ConfigError, InputFileError
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import MAX_ROWS, Experiment, ExperimentSet, Nominal
from frictid_hil.gap.sanity import checked

DEGREES = 180.0 / np.pi
HEADER = "time_s,position_rad,torque_nm,position_command_rad"


@pytest.fixture(scope="module")
def asymmetric() -> ExperimentSet:
    """A set with a cause to be sure of, were it not for what is done to it."""
    names = ("sines_large", "triangle_slow", "sines_repeat")
    return gap_sets.make({"direction_asymmetry": {"coulomb_share": 0.1, "viscous_share": 0.15}}, only=names)


def _with(**factors: float) -> Callable[[Experiment], Experiment]:
    return lambda e: replace(e, **{name: factor * getattr(e, name) for name, factor in factors.items()})


def _not_a_number(name: str) -> Callable[[Experiment], Experiment]:
    def change(e: Experiment) -> Experiment:
        column = getattr(e, name).copy()
        column[700] = np.nan
        return replace(e, **{name: column})

    return change


def _level(name: str) -> Callable[[Experiment], Experiment]:
    return lambda e: replace(e, **{name: np.full_like(getattr(e, name), 0.5)})


def _halted(e: Experiment) -> Experiment:
    position = e.position_rad.copy()
    position[position.size // 2 :] = position[position.size // 2]
    return replace(e, position_rad=position)


def _swapped_rows(e: Experiment) -> Experiment:
    time = e.time_s.copy()
    time[[300, 301]] = time[[301, 300]]
    return replace(e, time_s=time)


WRONG: dict[str, tuple[Callable[[Experiment], Experiment], str]] = {
    "all in degrees": (
        _with(position_rad=DEGREES, velocity_rad_s=DEGREES, position_command_rad=DEGREES),
        "positions up to",
    ),
    "position in degrees": (_with(position_rad=DEGREES), "positions up to"),
    "velocity in degrees": (_with(velocity_rad_s=DEGREES), "57.3 times the derivative"),
    "command in degrees": (_with(position_command_rad=DEGREES), "as far as its command"),
    "torque in per mille": (_with(torque_nm=1000.0 / 12.0), "times the torque that was measured"),
    "torque of the motor": (_with(torque_nm=0.01), "times the torque that was measured"),
    "time in milliseconds": (_with(time_s=1000.0), "apart"),
    "torque's sign": (_with(torque_nm=-1.0), "opposite signs"),
    "velocity's sign": (_with(velocity_rad_s=-1.0), "-1 times the derivative"),
    "command's sign": (_with(position_command_rad=-1.0), "opposite directions"),
    "motion's sign": (_with(position_rad=-1.0, velocity_rad_s=-1.0, position_command_rad=-1.0), "opposite signs"),
    "constant position": (_level("position_rad"), "position_rad never changes"),
    "constant torque": (_level("torque_nm"), "torque_nm never changes"),
    "constant velocity": (_level("velocity_rad_s"), "velocity_rad_s never changes"),
    "constant command": (_level("position_command_rad"), "position_command_rad never changes"),
    "position stops": (_halted, "repeats itself"),
    "time goes back": (_swapped_rows, "time does not increase at row 301"),
    "one NaN in time": (_not_a_number("time_s"), "row 700"),
    "one NaN in position": (_not_a_number("position_rad"), "row 700"),
    "one NaN in torque": (_not_a_number("torque_nm"), "row 700"),
    "one NaN in velocity": (_not_a_number("velocity_rad_s"), "row 700"),
    "one NaN in command": (_not_a_number("position_command_rad"), "row 700"),
}


@pytest.mark.parametrize("loop", [True, False], ids=["closed loop", "no controller"])
@pytest.mark.parametrize("wrong", list(WRONG))
def test_what_cannot_be_right_is_refused_with_its_reason(asymmetric: ExperimentSet, wrong: str, loop: bool) -> None:
    change, said = WRONG[wrong]
    nominal = asymmetric.nominal if loop else replace(asymmetric.nominal, controller=None)
    broken = ExperimentSet("broken", nominal, tuple(change(e) for e in asymmetric.experiments))
    with pytest.raises(InputFileError, match=said) as told:
        diagnose(broken)
    assert told.value.where


def test_a_slow_log_whose_velocity_is_mostly_steps_is_not_refused(asymmetric: ExperimentSet) -> None:
    def stepped(e: Experiment) -> Experiment:
        assert e.velocity_rad_s is not None
        if e.name != "triangle_slow":
            return e
        steps = np.where(np.arange(e.velocity_rad_s.size) % 97 == 0, 3.0, 0.0)
        return replace(e, velocity_rad_s=0.1 * e.velocity_rad_s + steps)

    changed = replace(asymmetric, experiments=tuple(stepped(e) for e in asymmetric.experiments))
    assert checked(changed) is changed
    dead = replace(asymmetric, experiments=(stepped(asymmetric.experiments[1]),))
    with pytest.raises(InputFileError, match="times the derivative"):
        checked(dead)
    first, *others = asymmetric.experiments
    assert first.velocity_rad_s is not None
    foreign = replace(first, velocity_rad_s=np.sin(np.arange(first.velocity_rad_s.size)))  # as of another joint
    with pytest.raises(InputFileError, match="times the derivative") as told:
        checked(replace(asymmetric, experiments=(foreign, *others)))
    assert told.value.where == first.name


@pytest.mark.slow
def test_a_joint_that_rests_in_its_dead_band_is_not_refused() -> None:
    """Command and position alone, as a hobby arm tells them: it stays where it is while a small command travels."""
    time_s = 0.02 * np.arange(2000)
    command = 0.03 * np.sin(time_s)
    position = np.where(time_s < 5.0, np.round(command, 2), 0.01)
    log = Experiment("small", False, False, 0, time_s, position, position_command_rad=command)
    found = diagnose(ExperimentSet("arm", Nominal(), (log,)))
    assert all(c.confidence < 0.9 for c in found.causes)


def _following(hertz: float, late_s: float = 0.0, radians: float = 0.5, scale: float = 1.0) -> Experiment:
    """A joint that follows its command late."""
    time_s = 0.01 * np.arange(3000)
    command = radians * (np.sin(2.0 * np.pi * hertz * time_s) + 0.2 * np.sin(time_s))
    position = scale * np.interp(time_s - late_s, time_s, command)
    return Experiment(f"{hertz:g} Hz", False, False, 0, time_s, position, position_command_rad=command)


def test_a_fast_log_that_comes_late_is_not_taken_for_one_of_swapped_sign() -> None:
    fast, slow = _following(3.0, 0.15), _following(0.2, 0.15)
    late = ExperimentSet("late", Nominal(), (fast, slow))
    assert checked(late) is late
    for logs in ((fast,), (_following(0.2, scale=-1.0), slow), (_following(0.2, scale=-1.0),)):
        with pytest.raises(InputFileError, match="opposite directions"):
            checked(ExperimentSet("turned", Nominal(), logs))


@pytest.mark.parametrize("hertz", [0.2, 0.8, 1.0, 3.0])
def test_a_swapped_sign_is_noticed_at_any_frequency(hertz: float) -> None:
    turned = (_following(hertz, scale=-1.0), _following(0.7 * hertz, scale=-1.0))
    with pytest.raises(InputFileError, match="opposite directions"):
        checked(ExperimentSet("turned", Nominal(), turned))


def test_a_joint_may_rest_while_a_small_command_travels() -> None:
    rests, follows = _following(1.0, radians=0.01, scale=0.01), _following(0.5, 0.05)
    assert checked(ExperimentSet("play", Nominal(), (rests, follows))).experiments == (rests, follows)
    degrees = _following(0.5, radians=57.3, scale=1.0 / 57.3)
    for logs in ((degrees, follows), (rests,)):
        with pytest.raises(InputFileError, match="times as far as its command"):
            checked(ExperimentSet("a log in degrees", Nominal(), logs))


def test_slow_motion_in_degrees_is_noticed_by_what_the_nominal_joint_asks_for() -> None:
    """Speeds that degrees do not give away: the torque does."""
    made = gap_sets.make(only=("triangle_slow", "breakaway"))
    change = WRONG["all in degrees"][0]
    with pytest.raises(InputFileError, match="times the torque that was measured"):
        diagnose(replace(made, experiments=tuple(change(e) for e in made.experiments)))


def _set(folder: Path, text: str | bytes) -> Path:
    document = {"joint": {}, "experiments": [{"name": "a", "role": "identification"}]}
    (folder / "nominal.yaml").write_text(yaml.safe_dump(document))
    (folder / "a.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def _rows(*broken: tuple[int, str]) -> str:
    """Ten rows under the header; broken ones by file line."""
    lines = [HEADER, *(f"{0.01 * k},{0.1 * k},{k % 3},{0.1 * k}" for k in range(10))]
    for line, text in broken:
        lines[line - 1] = text
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (_rows((5, "0.03,x,1,0.3")), "line 5, column position_rad: 'x' is not a number"),
        (_rows((5, "0.03,,1,0.3")), "line 5, column position_rad: blank"),
        (_rows((7, "0.05,0.5,1")), "line 7 has 3 values where the header has 4"),
        (_rows((4, "0.02,0.2,nan,0.2")), "line 4: torque_nm is nan"),
        (_rows((6, "0.01,0.4,1,0.4")), "line 6: time does not increase"),
        (_rows((1, "time_s,angle,torque_nm,position_command_rad")), "line 1: no column position_rad; the file has"),
        (_rows((1, "time_s,position_rad,current,speed")), "line 1: neither torque_nm nor position_command_rad"),
        (_rows((1, "time_s;position_rad;torque_nm;speed")), "line 2 has 1 values where the header has 4"),
        (_rows((1, "time_s,position_deg,torque_nm,speed")), "unknown column 'position_deg'; did you mean position_rad"),
        (HEADER + "\n", "at least 2"),
        ("", "empty"),
        (b"\x00\xff\xfe binary", "not UTF-8 text"),
    ],
    ids=[
        "text", "empty cell", "short row", "NaN", "time", "no position", "no torque", "semicolons", "degrees",
        "header only", "empty", "binary",
    ],
)  # fmt: skip
def test_a_broken_file_is_told_with_its_line_and_column(text: str | bytes, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputFileError) as told:
        ExperimentSet.load(_set(tmp_path, text))
    assert said in str(told.value)
    assert str(tmp_path / "a.csv") in told.value.where


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("joint: {inertia_kg_m2: heavy}\nexperiments: [{name: a}]\n", "nominal.yaml:1:24"),
        ("joint: {inertia_kgm2: 0.4}\nexperiments: [{name: a}]\n", "did you mean inertia_kg_m2"),
        ("joint: {}\nexperiments: [{name: a, role: test}]\n", "'identification' or 'validation'"),
        ("joint: {}\n", "experiments"),
        ("joint: {\n", "nominal.yaml"),
    ],
    ids=["no number", "misspelt", "role", "no experiments", "no YAML"],
)
def test_a_broken_nominal_file_is_told_with_its_place(text: str, said: str, tmp_path: Path) -> None:
    (_set(tmp_path, _rows()) / "nominal.yaml").write_text(text)
    with pytest.raises(ConfigError) as told:
        ExperimentSet.load(tmp_path)
    assert said in str(told.value)


def test_ten_million_rows_are_a_stated_limit_not_a_lost_machine(tmp_path: Path) -> None:
    _set(tmp_path, "")
    (tmp_path / "a.csv").unlink()
    with gzip.open(tmp_path / "a.csv.gz", "wb", compresslevel=1) as file:
        file.write(b"time_s,position_rad,torque_nm\n" + b"1,2,3\n" * 10**7)
    with pytest.raises(InputFileError, match=f"10000000 rows; at most {MAX_ROWS}") as told:
        ExperimentSet.load(tmp_path)
    assert told.value.next_step


def test_a_joint_that_rings_at_rest_has_no_swapped_sign() -> None:
    """In most rows it rings with the torque against the motion; the work is done in the moves all the same."""
    time = 0.002 * np.arange(6000)
    moving = ((time > 4.0) & (time < 4.6)).astype(float) - ((time > 9.0) & (time < 9.6))
    ringing = 5e-4 * np.sin(2.0 * np.pi * 15.0 * time) * (moving == 0.0)
    position = np.cumsum(0.5 * moving) * 0.002 + ringing
    torque = 0.4 * moving - 0.1 * np.sign(np.gradient(ringing))
    log = Experiment("rings", False, False, 0, time, position, torque_nm=torque)
    assert checked(ExperimentSet("rings", Nominal(), (log,))).experiments
    with pytest.raises(InputFileError, match="opposite signs"):
        checked(ExperimentSet("swapped", Nominal(), (replace(log, torque_nm=-0.4 * moving - 0.01),)))


def test_a_bias_larger_than_friction_is_no_swapped_sign_of_a_motor_that_spins_one_way() -> None:
    """The position's noise goes back a little in some rows."""
    random = np.random.default_rng(1)
    time = 0.001 * np.arange(4000)
    position = 5.0 * time + 2e-3 * random.standard_normal(time.size)
    torque = 0.1 - 0.5 + 0.05 * random.standard_normal(time.size)
    log = Experiment("spins", False, False, 0, time, position, torque_nm=torque)
    assert checked(ExperimentSet("spins", Nominal(), (log,))).experiments
