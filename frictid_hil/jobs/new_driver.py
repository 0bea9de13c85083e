"""``frictid-hil new-driver``: a package with a driver that runs, a fake of its device, a robot file and its tests."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

from frictid_hil.errors import FrictidError, UsageError

_FILES = {
    "pyproject.toml": "pyproject.toml",
    "robot.yaml": "NAME.yaml",
    "driver.py": "frictid_NAME/driver.py",
    "fake.py": "frictid_NAME/fake.py",
    "test_driver.py": "tests/test_driver.py",
}


def new_driver(name: str, out: Path | None = None) -> list[Path]:
    """Write the package; its files in the order worth reading (``UsageError``: no name, or a full folder)."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UsageError(f"no name for a driver: {name!r}", next_step="small letters, digits and underscores")
    folder = out or Path(f"frictid-{name}")
    if folder.exists() and any(folder.iterdir()):
        raise UsageError("holds something already", where=str(folder), next_step="name another folder with --out")
    template = files("frictid_hil.testing") / "template"
    written = []
    try:
        for source, target in _FILES.items():
            path = folder / target.replace("NAME", name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text((template / f"{source}.txt").read_text(encoding="utf-8").replace("NAME", name))
            written.append(path)
        (folder / f"frictid_{name}" / "__init__.py").write_text("")
    except OSError as error:
        raise FrictidError(f"cannot be written: {error}", where=str(folder)) from error
    return written
