from __future__ import annotations

import math
import random
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from frictid_drivers.mit.simulated import VirtualMitDriver
from frictid_drivers.motoman import MotomanDriver
from frictid_hil.config.reference import schema
from frictid_hil.config.robot import CareFile, GatesFile, Robot, load_robot
from frictid_hil.config.search import available, find, shipped_dir
from frictid_hil.config.write import dump
from frictid_hil.errors import ConfigError, FieldProblem, InvalidFields, UsageError
from frictid_hil.friction.gate import GateLimits
from frictid_hil.protocol.driver import DriverKind
from frictid_hil.runner.care import Care

FIXTURE = Path(__file__).with_name("fixture_robot.yaml")
TEXT = FIXTURE.read_text()


def written(folder: Path, *changes: tuple[str, str], name: str = "two.yaml") -> Path:
    text = TEXT
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = folder / name
    path.write_text(text)
    return path


def refused(path: Path) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        load_robot(path)
    return caught.value


def test_a_robot_file_becomes_a_setup() -> None:
    robot = load_robot(FIXTURE)
    setup = robot.to_setup(seed=7)
    assert (setup.name, setup.bus, setup.cycle_hz, setup.seed, setup.realtime) == ("two", "virtual:two", 1000, 7, False)
    first, second = setup.joints
    assert (first.name, first.address, first.direction, first.gear_ratio) == ("0", 1, 1, 100)
    assert (second.direction, second.options) == (-1, {"pulses_per_degree": 1000})
    assert first.simulated["friction"] == {"coulomb_nm": 8.0, "viscous_nm_s_per_rad": 2.0}
    assert robot.driver() == "virtual"


@pytest.mark.parametrize("name", ["../../../evil/x", "left/elbow", ".hidden", "a\\b", "x" * 65, "nul\u0000"])
def test_a_joint_is_not_named_like_a_path(tmp_path: Path, name: str) -> None:
    import json

    error = refused(written(tmp_path, ('"0":', f"{json.dumps(name)}:")))
    assert error.where.startswith("two.yaml:1") and "letters, digits" in error.what


@pytest.mark.parametrize("name", ["left_elbow", "J1", "shoulder pan", "wrist-3", "0.5"])
def test_a_joint_has_a_plain_name(tmp_path: Path, name: str) -> None:
    assert name in load_robot(written(tmp_path, ('"0":', f'"{name}":'))).joint_names


def test_a_joint_may_have_its_own_travel_and_a_person_overrides_both() -> None:
    robot = load_robot(FIXTURE)
    assert robot.procedure("0").amplitude_rad == 0.3490658503988659
    assert robot.procedure("1").amplitude_rad == 0.2
    assert robot.procedure("1", amplitude_rad=0.1, cycles=5).cycles == 5
    with pytest.raises(UsageError, match="no joint named '9'; two has 0, 1"):
        robot.procedure("9")
    with pytest.raises(UsageError, match="ratio"):
        robot.procedure("0", ratio=1.5)


@pytest.mark.parametrize(
    ("change", "where", "words"),
    [
        (
            ("gear_ratio: 100", "gear_ration: 100"),
            "two.yaml:14:5",
            "gear_ration: unknown key; did you mean gear_ratio?",
        ),
        (
            ("gear_ratio: 100", "gear_ratio: -1"),
            "two.yaml:14:17",
            "joints.0.gear_ratio: expected greater than 0, found -1",
        ),
        (("gear_ratio: 100", "gear_ratio: .inf"), "two.yaml:14:17", "finite"),
        (("gear_ratio: 100", "gear_ratio: '100'"), "two.yaml:14:17", "expected a valid number, found '100'"),
        (("gear_ratio: 100", "gear_ratio: true"), "two.yaml:14:17", "expected a valid number"),
        (("gear_ratio: 100", "gear_ratio: "), "two.yaml:14:16", "found nothing"),
        (("start_position_rad: -0.2", "start_position_rad: 20m"), "two.yaml:20:25", "it takes deg, rad, mrad"),
        (("position_max_rad: 2.9", "position_max_rad: 150"), "two.yaml:19:23", "in degrees? write 150deg"),
        (("position_max_rad: 2.9", "position_max_rad: 12"), "two.yaml:19:23", "over two turns of travel"),
        (("max_velocity_rad_s: 3.49", "max_velocity_rad_s: 190"), "two.yaml:15:25", "write 190deg/s"),
        (("velocity_rad_s: 2.007128639793479", "velocity_rad_s: 115"), "two.yaml:8:19", "in degrees? write 115"),
        (("start_position_rad: -0.2", "start_position_rad: 3.5"), "two.yaml:20:25", "3.5 lies outside the limits"),
        (("position_max_rad: 2.9", "position_max_rad: -3"), "two.yaml:19:23", "must be above position_min_rad"),
        (("node: 2", "node: 1"), "two.yaml:26:11", "node 1 is already that of joint 0"),
        (("node: 2", "node: -1"), "two.yaml:26:11", "greater than or equal to 0"),
        (("    node: 2\n", ""), "two.yaml:25:3", "has no `node` (CANopen), `axis`"),
        (("direction: -1", "direction: 2"), "two.yaml:35:16", "-1 or 1"),
        (("    max_torque_nm: 95.1\n", ""), "two.yaml:12:3", "joints.0.max_torque_nm: missing"),
        (("cycles: 10", "cycles: 1"), "two.yaml:9:11", "greater than or equal to 2"),
        (("bus: virtual:two", "bus: can0"), "two.yaml:4:6", "expected interface:channel"),
        (("name: two", "name: a/b"), "two.yaml:2:7", "name"),
        (("schema: frictid.robot/1", "schema: frictid.robot/2"), "two.yaml:1:9", "newer than this program"),
        (("schema: frictid.robot/1", "schema: frictid.profile/1"), "two.yaml:1:9", "this is a frictid.profile/1, not"),
        (("schema: frictid.robot/1\n", ""), "two.yaml:1:1", "does not say what it is"),
        (("cycle_hz: 1000", "cycle_hz: 1000\npolicy: {drif_percent: 3}"), "two.yaml:6:10", "did you mean drift_"),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path: Path, change: tuple[str, str], where: str, words: str) -> None:
    error = refused(written(tmp_path, change))
    assert words in str(error)
    assert error.where == where


def test_all_mistakes_are_told_at_once(tmp_path: Path) -> None:
    error = refused(written(tmp_path, ("gear_ratio: 100", "gear_ratio: x"), ("gear_ratio: 224", "gear_ratio: 0")))
    assert [line.split(": ")[0] for line in str(error).splitlines()] == ["two.yaml:14:17", "two.yaml:27:17"]


def test_no_joints_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "none.yaml"
    path.write_text(TEXT[: TEXT.index("joints:")] + "joints: {}\n")
    assert "joints" in str(refused(path))


def test_a_site_file_overrides_what_differs(tmp_path: Path) -> None:
    written(tmp_path)
    site = tmp_path / "site.yaml"
    site.write_text("schema: frictid.robot/1\nextends: two.yaml\nbus: socketcan:can0\njoints: {1: {node: 9}}\n")
    robot = load_robot(site)
    assert robot.to_setup().bus == "socketcan:can0"
    assert [joint.address for joint in robot.to_setup().joints] == [1, 9]
    assert robot.digest != load_robot(tmp_path / "two.yaml").digest
    assert robot.path == site
    (tmp_path / "used.yaml").write_text(dump(robot.values()))
    assert load_robot(tmp_path / "used.yaml").digest == robot.digest, "a run's copy is the configuration itself"


def test_a_quantity_may_be_typed_with_its_unit(tmp_path: Path) -> None:
    changes = (
        ("position_max_rad: 2.9", "position_max_rad: 150deg"),
        ("velocity_rad_s: 2.007128639793479", "velocity_rad_s: 30 rpm"),
    )
    robot = load_robot(written(tmp_path, *changes))
    assert robot.file.joints["0"].position_max_rad == math.radians(150)
    assert robot.file.procedure.velocity_rad_s == pytest.approx(math.pi)
    assert robot.values()["joints"]["0"]["position_max_rad"] == math.radians(150), "a run's copy holds plain numbers"
    stiff = written(tmp_path, ("viscous_nm_s_per_rad: 2.0", "viscous_nm_s_per_rad: 20deg"))
    assert load_robot(stiff).values()["joints"]["0"]["simulated"]["friction"]["viscous_nm_s_per_rad"] == "20deg"


def test_an_axis_that_turns_without_end_says_so(tmp_path: Path) -> None:
    wide = ("position_max_rad: 2.9", "position_max_rad: 1e4\n    continuous: true")
    fast = ("max_velocity_rad_s: 3.49", "max_velocity_rad_s: 300")
    assert load_robot(written(tmp_path, wide, fast)).to_setup().joints[0].position_max_rad == 1e4
    assert "in degrees?" in str(refused(written(tmp_path, fast)))


def test_a_site_file_leaves_joints_out(tmp_path: Path) -> None:
    site = tmp_path / "site.yaml"
    site.write_text('schema: frictid.robot/1\nextends: hp3j\njoints: {"3": null, "1": null, "4": {expected: null}}\n')
    robot = load_robot(site)
    assert robot.joint_names == ("0", "2", "4", "5")
    assert robot.file.joints["4"].expected is None
    assert [joint.name for joint in robot.to_setup().joints] == ["0", "2", "4", "5"]
    site.write_text('schema: frictid.robot/1\nextends: hp3j\njoints: {"7": null}\n')
    assert "site.yaml:3:15: joints.7" in str(refused(site))


def test_errors_of_a_site_file_point_into_the_file_at_fault(tmp_path: Path) -> None:
    written(tmp_path, ("gear_ratio: 224", "gear_ratio: 0"))
    site = tmp_path / "site.yaml"
    site.write_text("schema: frictid.robot/1\nextends: two\njoints:\n  '0': {node: -1}\n")
    lines = str(refused(site)).splitlines()
    assert {line.split(": ")[0] for line in lines} == {"site.yaml:4:15", "two.yaml:27:17"}
    site.write_text("schema: frictid.robot/1\nextends: absent.yaml\n")
    assert refused(site).where == "site.yaml:2:10"
    site.write_text("schema: frictid.robot/1\nextends: site.yaml\n")
    assert "extends itself" in str(refused(site))


def test_digest_is_of_the_values_alone(tmp_path: Path) -> None:
    same = written(tmp_path, ("cycle_hz: 1000", "cycle_hz:   1000   # a comment"))
    other = written(tmp_path, ("cycle_hz: 1000", "cycle_hz: 500"), name="other.yaml")
    assert load_robot(same).digest == load_robot(FIXTURE).digest != load_robot(other).digest


@pytest.mark.parametrize(
    ("bus", "driver"),
    [(None, "virtual"), ("virtual:x", "virtual"), ("socketcan:can0", "cia402"), ("serial:/dev/ttyUSB0", "motoman")],
)
def test_the_bus_chooses_the_driver(bus: str | None, driver: str) -> None:
    assert load_robot(FIXTURE).driver(bus) == driver


def test_a_bus_that_no_driver_of_the_robot_speaks_on_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MotomanDriver, "kind", DriverKind(line="serial", addressed_by="axis"))
    robot = load_robot(written(tmp_path, ("driver: virtual", "driver: motoman"), ("bus: virtual:two", "bus: serial:x")))
    assert robot.driver("serial:/dev/ttyUSB1") == "motoman"
    with pytest.raises(UsageError, match="speaks on a serial bus and has no counterpart on a can bus"):
        robot.driver("socketcan:can0")


@pytest.mark.parametrize(("key", "value", "bus"), [("node", 200, None), ("node", 0, None), ("axis", 64, "serial:x")])
def test_addresses_end_where_the_driver_says(tmp_path: Path, key: str, value: int, bus: str | None) -> None:
    site = tmp_path / "site.yaml"
    axes = "axis: 1" if key == "node" else f"axis: {value}"
    node = f"node: {value}" if key == "node" else "node: 9"
    site.write_text(f"schema: frictid.robot/1\nextends: {FIXTURE}\njoints:\n  '0': {{{node}, {axes}}}\n")
    with pytest.raises(ConfigError, match=rf"joints.0.{key}: driver .* has {key}s .*, found {value}"):
        load_robot(site).to_setup(bus)


def test_an_unknown_driver_is_told_where_it_stands(tmp_path: Path) -> None:
    robot = load_robot(written(tmp_path, ("driver: virtual", "driver: nobody")))
    with pytest.raises(ConfigError, match=r"no driver named 'nobody'; installed: .*cia402"):
        robot.to_setup()


def test_bounds_of_care_come_with_the_setup(tmp_path: Path) -> None:
    robot = load_robot(written(tmp_path, ("procedure:", "care: {following_error_rad: 0.2}\nprocedure:")))
    assert robot.to_setup().care == {"following_error_rad": 0.2}
    bad = written(tmp_path, ("procedure:", "care: {velocity_margin: 0.5}\nprocedure:"), name="bad.yaml")
    assert "velocity_margin" in str(refused(bad))


def test_limits_of_quality_gates_come_with_every_joint(tmp_path: Path) -> None:
    robot = load_robot(written(tmp_path, ("procedure:", "gates: {direction_asymmetry: 0.45}\nprocedure:")))
    assert [joint.gates for joint in robot.to_setup().joints] == [{"direction_asymmetry": 0.45}] * 2
    bad = written(tmp_path, ("procedure:", "gates: {drift: 5}\nprocedure:"), name="bad.yaml")
    assert (error := refused(bad)).where == "bad.yaml:6:16" and "gates.drift" in str(error)


def test_what_the_driver_says_of_its_devices_gives_way_to_the_robot_file(tmp_path: Path) -> None:
    usual = load_robot("mit-bench.yaml").to_setup().care
    site = "schema: frictid.robot/1\nextends: mit-bench.yaml\nname: mine\ncare: {still_rad_s: 0.2}\n"
    (tmp_path / "mine.yaml").write_text(site)
    assert usual["still_rad_s"] == 0.05
    assert load_robot(tmp_path / "mine.yaml").to_setup().care == {**usual, "still_rad_s": 0.2}


def test_a_driver_that_sets_bounds_that_there_are_not_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(VirtualMitDriver, "kind", replace(VirtualMitDriver.kind, gates={"drifts": 0.1}))
    with pytest.raises(ConfigError, match="driver virtual-mit sets drifts under gates"):
        load_robot("mit-bench.yaml").to_setup()


def test_the_address_must_be_of_the_kind_the_driver_uses() -> None:
    with pytest.raises(ConfigError, match=r"fixture_robot.yaml:12:3: joints.0: has no `axis`"):
        load_robot(FIXTURE).to_setup("serial:/dev/ttyUSB0")
    with pytest.raises(UsageError, match="interface:channel"):
        load_robot(FIXTURE).to_setup("can0")


def test_problems_found_by_the_simulation_get_their_places() -> None:
    with pytest.raises(ConfigError) as raised, load_robot(FIXTURE).document.locating(("joints", "0", "simulated")):
        raise InvalidFields([FieldProblem(("friction", "coulomb_nm"), "too large")])
    assert str(raised.value) == "fixture_robot.yaml:24:30: joints.0.simulated.friction.coulomb_nm: too large"


def test_unattended_needs_a_person_a_day_and_an_interlock(tmp_path: Path) -> None:
    def policy(text: str) -> tuple[str, str]:
        return ("cycle_hz: 1000", f"cycle_hz: 1000\npolicy: {{unattended: {text}}}")

    assert load_robot(FIXTURE).policy.unattended is None
    error = refused(written(tmp_path, policy("{allowed_by: Iwatani}")))
    assert "unattended.date: missing" in str(error)
    assert "interlock_input: missing" in str(error)
    whole = "{allowed_by: Iwatani, date: 2026-11-21, interlock_input: {joint: '0', bit: 16}}"
    allowed = load_robot(written(tmp_path, policy(whole))).policy.unattended
    assert allowed is not None
    assert (allowed.allowed_by, allowed.interlock_input.bit) == ("Iwatani", 16)
    assert "expected a date" in str(refused(written(tmp_path, policy(whole.replace("11-21", "13-21")))))
    assert "no such joint" in str(refused(written(tmp_path, policy(whole.replace("'0'", "'7'")))))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32))
@example(3792)
def test_a_damaged_file_is_read_or_refused_never_worse(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    dice = random.Random(seed)
    raw = bytearray(TEXT.encode())
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(raw))
        raw[at : at + dice.randint(0, 3)] = dice.randbytes(dice.randint(0, 3))
    path = tmp_path_factory.mktemp("fuzz") / "two.yaml"
    path.write_bytes(raw[: dice.choice([len(raw), dice.randrange(len(raw))])])
    try:
        robot = load_robot(path)
        setup = robot.to_setup()  # another driver's name is looked up here
    except ConfigError as error:
        assert error.where
    else:
        assert isinstance(robot, Robot)
        assert math.isfinite(setup.joints[0].gear_ratio)


def test_search_finds_a_name_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere, named, mine = tmp_path / "cwd", tmp_path / "named", tmp_path / "data"
    for folder in (elsewhere / "profiles", named, mine / "frictid-hil" / "profiles"):
        folder.mkdir(parents=True)
    monkeypatch.chdir(elsewhere)
    monkeypatch.setenv("XDG_DATA_HOME", str(mine))
    monkeypatch.setenv("FRICTID_HIL_PROFILES", f"{tmp_path / 'absent'}:{named}")
    in_order = [
        Path("two.yaml"),
        named / "two.yaml",
        Path("profiles/two.yaml"),
        mine / "frictid-hil" / "profiles" / "two.yaml",
    ]
    for path in reversed(in_order):
        path.write_text(TEXT)
        assert find("two.yaml") == path
        assert find("two") == path
    assert "two.yaml" in available()
    with pytest.raises(ConfigError) as caught:
        find("tow.yaml")
    assert "did you mean two.yaml?" in caught.value.next_step
    assert str(named) in caught.value.cause
    with pytest.raises(ConfigError, match="no such robot file"):
        find("there/two.yaml")


def test_the_shipped_folder_exists() -> None:
    assert (shipped_dir() / "columns").is_dir()


@pytest.mark.parametrize(("file", "usual"), [(CareFile, Care()), (GatesFile, GateLimits())])
def test_the_usual_bounds_that_the_reference_tells_are_those_in_force(file: type[BaseModel], usual: object) -> None:
    said = {key: field["description"] for key, field in schema(file)["properties"].items()}
    told = {key: found[1] for key, words in said.items() if (found := re.search(r"usually ([\d.]*\d(?: \S+)?)", words))}
    assert set(told) == set(file.model_fields)
    for key, text in told.items():
        number, _, unit = text.partition(" ")
        value = math.radians(float(number)) if unit.startswith("deg") else float(number)
        assert value == pytest.approx(getattr(usual, key)), key
