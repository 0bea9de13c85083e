"""One draw of ``benchmarks/arm_proof.py``: named on the two joints that have it, nothing on the four others."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", minversion="4.0")


@pytest.fixture(scope="module")
def proof() -> Iterator[Any]:
    folder = str(Path(__file__).resolve().parents[2] / "benchmarks")
    sys.path.insert(0, folder)
    import arm_proof

    yield arm_proof
    sys.path.remove(folder)


@pytest.mark.slow
def test_the_seal_is_opened_on_what_was_named(proof: Any) -> None:
    found = proof.judged(seed=1, number=2, seconds=10.0)
    assert found["sealed"] == {"wrist_1": "torque_bias", "elbow": "torque_bias"}
    assert all(found["first"].values()) and all(found["quiet"].values()) and found["arm"] == ""
    assert min(found["closed_percent"].values()) > 90.0
    assert "effect first among them: 2 of 2 (100 %)" in proof.summary([found])
