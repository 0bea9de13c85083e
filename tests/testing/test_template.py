"""The template that `new driver` writes: an outsider's driver, short, public names only, that passes and calibrates.

Fifteen defects are planted in it, each of which the conformance suite must find.
"""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from frictid_hil.errors import UsageError
from frictid_hil.jobs.new_driver import new_driver
from frictid_hil.testing import driver_conformance
from frictid_hil.testing.driver_conformance import CHECKS


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("outsider") / "frictid-acme"
    new_driver("acme", folder)
    return folder


def test_it_is_short_and_imports_public_names_only(package: Path) -> None:
    text = (package / "frictid_acme" / "driver.py").read_text()
    assert len(text.splitlines()) <= 150
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            assert not any(name.startswith("_") for name in names), names
            assert "frictid_drivers" not in names
        if isinstance(node, ast.Attribute) and not node.attr.startswith("__"):
            assert not node.attr.startswith("_"), node.attr


PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "driver-helpers.md"


@pytest.mark.parametrize("file", ["frictid_acme/driver.py", "frictid_acme/fake.py", "tests/test_driver.py"])
def test_the_page_names_every_module_that_a_driver_needs(package: Path, file: str) -> None:
    page = PAGE.read_text()
    for node in ast.walk(ast.parse((package / file).read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("frictid_hil"):
            assert f"`{node.module}`" in page or f"from {node.module} import" in page, node.module


@pytest.mark.slow
def test_its_own_tests_pass(package: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"],
        cwd=package,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    assert done.returncode == 0 and f"{len(CHECKS)} passed" in done.stdout, done.stdout[-3000:]


def test_nothing_is_overwritten_and_names_are_names(package: Path) -> None:
    with pytest.raises(UsageError, match="holds something already"):
        new_driver("acme", package)
    with pytest.raises(UsageError, match="no name for a driver"):
        new_driver("../x", package / "new")


# -- planted defects ---------------------------------------------------------------------------------------------------


DEFECTS = {
    "torque has the wrong sign": ("direction * ((word >> 4) - 2048)", "-direction * ((word >> 4) - 2048)"),
    "velocity in degrees": ("direction * velocity * 1e-3", "direction * velocity * 0.0573"),
    "position of a reversed joint has the wrong sign": ("direction * position * 1e-6", "position * 1e-6"),
    "reports are always young": (
        "return self.cycle.exchange(set_points)",
        "return young(self.cycle.exchange(set_points))",
    ),
    "what is no number goes out": (
        "return self.cycle.exchange(set_points)",
        "return self.cycle.exchange(zeroed(set_points))",
    ),
    "position limits are forgotten": (
        ".limit(torque_nm, position_min_rad, position_max_rad)",
        ".limit(torque_nm, -9, 9)",
    ),
    "torque limits are forgotten": (".limit(torque_nm, position_min_rad", ".limit(1e3, position_min_rad"),
    "close leaves power on": (
        "        with contextlib.suppress(FrictidError):\n            self.stop_cycling()\n        self.line.close()",
        "        self.line.close()",
    ),
    "quick stop does nothing": ("            self.cycle.quick_stop()", "            pass"),
    "power comes on with a jump": (
        "mode, value = (TORQUE, order.torque_nm) if torque else (POSITION, order.position_rad)",
        "mode, value = (TORQUE, order.torque_nm) if torque else (POSITION, self.asked[at].position_rad)",
    ),
    "locked joints are not": ("self.cycle.wish(joint).lock()", "pass"),
    "torque mode moves to a position": ("if torque else (POSITION", "if False else (POSITION"),
    "a replay forgets the direction": ("tuple(joint) for joint", "(joint[0], 1) for joint"),
    "it says that it has power": (
        "[JointState.DISABLED, JointState.ENABLED][state",
        "[JointState.ENABLED, JointState.ENABLED][state",
    ),
    "any rate is taken": ("if cycle_hz > self.capabilities().max_cycle_hz:", "if False:"),
}
HELPERS = """

def young(reports):
    for report in reports:
        report.age_cycles = 0
    return reports


def zeroed(set_points):
    for point in set_points:
        point.position_rad = point.position_rad if math.isfinite(point.position_rad) else 0.5
    return set_points
"""


@pytest.fixture
def importing(package: Path) -> Iterator[None]:
    sys.path.insert(0, str(package))
    yield
    sys.path.remove(str(package))
    for name in [name for name in sys.modules if name.startswith("frictid_acme")]:
        del sys.modules[name]


def bench_of(package: Path, text: str) -> Any:
    module: Any = ModuleType("planted")
    exec(compile(text + HELPERS, "planted.py", "exec"), module.__dict__)
    fake = importlib.import_module("frictid_acme.fake")
    tests: Any = ModuleType("tests_of_it")
    source = (package / "tests" / "test_driver.py").read_text()
    source = source.replace("from frictid_acme import driver as mine\n", "").replace(
        "acme.yaml", str(package / "acme.yaml")
    )
    tests.__dict__.update(mine=module, FakeRobot=fake.FakeRobot)
    exec(compile(source, "test_driver.py", "exec"), tests.__dict__)
    return tests.Bench()


def failing(package: Path, text: str) -> list[str]:
    compile(text, "planted.py", "exec")  # a defect that is no Python would be found by anybody
    found = []
    for check in CHECKS:
        try:
            check(bench_of(package, text))
        except Exception:
            found.append(check.__name__)
            break
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("importing")
@pytest.mark.parametrize("defect", DEFECTS)
def test_every_planted_defect_is_found(package: Path, defect: str) -> None:
    old, new = DEFECTS[defect]
    text = (package / "frictid_acme" / "driver.py").read_text()
    assert old in text, old
    planted = text.replace(old, new)
    if "self.asked" in new:
        planted = planted.replace(
            "return self.cycle.exchange(set_points)",
            "self.asked = set_points\n        return self.cycle.exchange(set_points)",
        )
    assert failing(package, planted), defect


@pytest.mark.slow
@pytest.mark.usefixtures("importing")
def test_nothing_is_found_where_nothing_was_planted(package: Path) -> None:
    assert not failing(package, (package / "frictid_acme" / "driver.py").read_text())
    assert driver_conformance.CHECKS
