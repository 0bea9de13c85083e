"""What the tests of this folder drive."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from maxwell import ARM, Joint, degrees_procedure, drive, record


@dataclass(frozen=True)
class Plants:
    """What the tests of this folder drive."""

    Joint = Joint
    arm = ARM
    record = staticmethod(record)
    drive = staticmethod(drive)
    procedure = staticmethod(degrees_procedure)
    replace = staticmethod(replace)


@pytest.fixture(scope="session")
def plants() -> Plants:
    return Plants()


@pytest.fixture(scope="session")
def real_data() -> Path:
    folder = os.environ.get("FRICTID_REAL_DATA")
    path = Path(folder) if folder else Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
    if not path.is_dir():
        pytest.skip("no real recordings: FRICTID_REAL_DATA does not name a folder")
    return path
