"""How far a set-point and a sample walk through the program: few functions, those that docs/architecture.md names."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from frictid_drivers.cia402.codec import Decoder
from frictid_drivers.virtual.lock_step import LockStepBus
from frictid_hil.jobs import calibrate as job
from frictid_hil.jobs.calibrate import CalibrateOptions
from frictid_hil.jobs.identification import joint_profile
from frictid_hil.jobs.watch import Silent
from frictid_hil.runner.arm import Arm
from frictid_hil.runner.cycle import CyclicLoop
from frictid_hil.runner.ring import Ring
from frictid_hil.runs.keeper import RowKeeper

pytestmark = pytest.mark.slow
PAGE = Path(__file__).parents[2] / "docs" / "architecture.md"
OURS = ("frictid_hil", "frictid_drivers")
SET_POINT_FRAME = 0x206
"""What a set-point of joint 5, node 6, travels in."""


def frames() -> Iterator[str]:
    """Our own functions on the stack, the innermost first."""
    frame = sys._getframe()
    while frame := frame.f_back:  # type: ignore[assignment]
        if frame.f_globals["__name__"].split(".")[0] in OURS:
            yield frame.f_code.co_qualname.rpartition("<locals>.")[2]


def up_to(owner: str) -> list[str]:
    """The same, from a function of the runner or job inwards."""
    found: list[str] = []
    for name in frames():
        found.insert(0, name)
        if name == owner:
            return found
    return []


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """The functions on the stack at every station of a short calibration."""
    seen: dict[str, list[str]] = {}

    def probe(patch: pytest.MonkeyPatch, owner: Any, name: str, start: str, only: Any = lambda _: True) -> None:
        real = getattr(owner, name)

        def spied(*given: Any, **named: Any) -> Any:
            if name not in seen and only(given):
                walk = up_to(start) if start else list(frames())[::-1]
                # The very first set-points prove units; those of the motion itself come another way.
                if start or (CyclicLoop.run.__qualname__ in walk and Arm.prove_units.__qualname__ not in walk):
                    seen[name] = walk
            return real(*given, **named)

        patch.setattr(owner, name, spied)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("walk"))
        probe(patch, LockStepBus, "send", "", lambda given: given[1].arbitration_id == SET_POINT_FRAME)
        probe(patch, Decoder, "take", "CyclicLoop.cycle")
        probe(patch, Ring, "append", "CyclicLoop.cycle", lambda given: len(given) > 8)
        probe(patch, RowKeeper, "samples", "drain")
        probe(patch, RowKeeper, "taken", "_Measured.identify")
        probe(patch, joint_profile, "estimate", "_Measured.identify")
        options = CalibrateOptions("hp3j", joints=("5",), amplitude_rad=0.14, velocity_rad_s=1.05, cycles=2)
        assert job.calibrate(options, Silent()).profile is not None
    return seen


def named_in_the_page(functions: list[str], heading: str) -> None:
    section = PAGE.read_text().split(f"### {heading}")[1].split("\n#")[0]
    missing = [name for name in functions if f"`{name}`" not in section]
    assert not missing, f"not on the walk of docs/architecture.md: {missing}"


def test_a_set_point_reaches_the_wire_through_twelve_functions_at_most(walks: dict[str, list[str]]) -> None:
    walk = walks["send"]
    assert walk[0] == "calibrate" and walk[-1] == "MessageFrames.send"
    assert len(walk) <= 12, walk
    named_in_the_page(walk, "A set-point, from `calibrate` to the wire")


def test_a_sample_reaches_the_profile_through_fifteen_functions_at_most(walks: dict[str, list[str]]) -> None:
    stations = ("take", "append", "samples", "taken", "estimate")
    last = {"take": "Decoder.take", "append": "Ring.append", "samples": "RowKeeper.samples", "taken": "RowKeeper.taken"}
    walk = list(dict.fromkeys(name for s in stations for name in [*walks[s], last.get(s, "estimate")]))
    assert {"CyclicLoop.cycle", "drain", "identify_joint"} <= set(walk)
    assert len(walk) <= 15, walk
    named_in_the_page(walk, "A sample, from the wire to the profile")
