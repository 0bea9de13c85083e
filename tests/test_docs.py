"""Every link between pages leads somewhere, the README's and the changelog's too."""

import csv
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import frictid_drivers
import frictid_hil
from frictid_drivers import stop_paths
from frictid_drivers.cia402 import settings as cia402
from frictid_drivers.mit import settings as mit
from frictid_drivers.servos import settings as servos
from frictid_hil.config import reference
from frictid_hil.config.columns import load_columns
from frictid_hil.config.robot import load_robot
from frictid_hil.config.search import find
from frictid_hil.protocol.can_bus import FORWARDED

ROOT = Path(__file__).parents[1]
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    local = [link.split("#")[0] for link in links if "://" not in link and not link.startswith(("#", "mailto:"))]
    missing = [link for link in local if not (page.parent / link).exists()]
    # A page of the repository's root names files that the tests' own copy lacks.
    assert [link for link in missing if not (page.parent == ROOT and Path(link).suffix != ".md")] == []


def guide_files() -> list[tuple[str, str]]:
    """Every YAML block of the guides that names its kind, with its page."""
    blocks = [
        (page.stem, block)
        for page in sorted((ROOT / "docs" / "guides").glob("*.md"))
        for block in re.findall(r"```yaml\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    ]
    return [(stem, block) for stem, block in blocks if block.startswith("schema:")]


@pytest.mark.parametrize(("page", "block"), guide_files())
def test_a_file_shown_in_a_guide_loads(page: str, block: str, tmp_path: Path) -> None:
    path = tmp_path / f"{page}.yaml"
    path.write_text(block, encoding="utf-8")
    loaders = {"frictid.robot": load_robot, "frictid.columns": load_columns}
    assert loaders[re.match(r"schema: ([\w.]+)/", block)[1]](path)


GUIDES = sorted((ROOT / "docs" / "guides").glob("*.md"))
READ_ALOUD_IN_FIVE_MINUTES = 750


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_a_guide_is_read_aloud_in_five_minutes(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    prose = re.sub(r"^ {4,}\S.*$", "", prose, flags=re.MULTILINE)
    words = re.findall(r"\w[\w'./:-]*", re.sub(r"\]\([^)]*\)", "]", prose))
    assert len(words) <= READ_ALOUD_IN_FIVE_MINUTES
    assert re.findall(r"\b(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,40}\b", text) == [], "a commit hash"
    tables = re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE)
    assert all(len(table.splitlines()) <= 2 + 10 for table in tables), "a table above ten rows"


def test_the_map_of_the_house_names_files_that_exist() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert len(re.findall(r"^\| .*\? \| ", text.split("## Ten everyday questions")[1], flags=re.MULTILINE)) == 10
    named = re.findall(r"`((?:frictid_hil|drivers/frictid_drivers|profiles)/[\w/.]*)`", text)
    roots = {
        "frictid_hil": Path(frictid_hil.__file__).parent,
        "drivers": Path(frictid_drivers.__file__).parents[1],
        "profiles": find("hp3j.yaml").parent,
    }
    missing = [name for name in named if not (roots[name.split("/")[0]] / name.partition("/")[2]).exists()]
    assert len(named) > 20 and missing == []


def test_the_page_of_files_is_that_of_the_schemas() -> None:
    page = (ROOT / "docs" / "reference" / "files.md").read_text(encoding="utf-8")
    assert page == reference.page(), "python -m frictid_hil.config.reference docs/reference"


def test_every_key_of_every_file_has_a_meaning_in_its_schema() -> None:
    silent = []
    for title, model in reference.FILES.values():
        whole = reference.schema(model)
        for definition in (whole, *whole.get("$defs", {}).values()):
            fields = definition.get("properties", {})
            silent += [f"{title}: {key}" for key, field in fields.items() if not field["description"]]
    assert silent == []


def test_the_page_of_verbs_is_that_of_the_command_line() -> None:
    command = [sys.executable, "-m", "typer", "frictid_hil.cli.app", "utils", "docs", "--name", "frictid-hil"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    page = (ROOT / "docs" / "reference" / "verbs.md").read_text(encoding="utf-8")
    assert page.strip() == shown.strip(), " ".join(command[1:]) + " > docs/reference/verbs.md"


def test_the_page_of_stops_is_that_of_the_code() -> None:
    page = (ROOT / "docs" / "reference" / "stops.md").read_text(encoding="utf-8")
    assert page == stop_paths.page(), "python -m frictid_drivers.stop_paths docs/reference/stops.md"


@pytest.mark.parametrize(
    ("page", "settings", "elsewhere"),
    [
        ("reference/canopen-settings.md", cia402, {"faults"}),  # of a bus that injects faults: no setting of a drive
        ("guides/mit-actuators.md", mit, {"reply_window", "torque_delay_s", *FORWARDED}),  # as of CANopen
        ("guides/servos.md", servos, set()),
    ],
)
def test_the_page_of_a_driver_names_every_option(page: str, settings: ModuleType, elsewhere: set[str]) -> None:
    told = set(re.findall(r"\w+", (ROOT / "docs" / page).read_text(encoding="utf-8")))
    assert (settings.BUS_OPTIONS | settings.JOINT_OPTIONS) - told <= elsewhere


@pytest.mark.parametrize("name", ["fault-findings.csv", "drive-findings.csv"])
def test_every_finding_names_tests_that_exist(name: str) -> None:
    table = (ROOT / "docs" / "evidence" / "data" / name).read_text(encoding="utf-8")
    named = [test for row in csv.DictReader(table.splitlines()) for test in row["tests_below_tests"].split("; ")]
    missing = []
    for file, _, test in (one.partition("::") for one in named):
        path = ROOT / "tests" / file
        if not path.exists() or (test and f"def {test}(" not in path.read_text(encoding="utf-8")):
            missing.append(f"{file}::{test}")
    assert len(named) > 30 and missing == []


def test_every_proof_that_is_sampled_is_there() -> None:
    listed = re.search(r"SAMPLED = .*?\n}\n", (ROOT / "tests" / "conftest.py").read_text(), flags=re.DOTALL)
    long = re.search(r"LONG = .*?\n}\n", (ROOT / "tests" / "conftest.py").read_text(), flags=re.DOTALL)
    assert listed is not None and long is not None
    names = re.findall(r'^    "(test_\w+)"', listed[0] + long[0], flags=re.MULTILINE)
    written = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    assert len(names) > 10 and [name for name in names if f"def {name}(" not in written] == []
