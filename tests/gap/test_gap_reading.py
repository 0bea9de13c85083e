"""In which band, and in which way, recordings are read before anything is said of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from frictid_hil.gap import diagnose, quiet, reading
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.how_far import Closed

JOINT = cast(Any, SimpleNamespace(reasons={}, nominal=None, logs=(), believed=(), stepped=()))


def cause(name: str, chance: float, where: str = "plant") -> Finding:
    """A cause of two floors."""
    return Finding(name, chance, chance, 2.0, 0.5, {}, (), where)


@pytest.mark.parametrize(
    ("found", "cutoff_hz"),
    [(cause("torque_ripple", 0.95), 160.0), (cause("torque_ripple", 0.2), 20.0), (cause("stribeck", 0.95), 20.0)],
)
def test_the_band_is_wide_only_where_a_line_is_likely(
    found: Finding, cutoff_hz: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    wide, usual = (SimpleNamespace(name="plant", cutoff_hz=hertz) for hertz in (160.0, 20.0))
    monkeypatch.setattr(reading, "_channels", lambda *_: [wide])
    monkeypatch.setattr(reading, "plant_channel", lambda *_, lines: wide if lines else usual)
    monkeypatch.setattr(reading, "Posterior", lambda channel, _: SimpleNamespace(channel=channel))
    monkeypatch.setattr(reading, "sampled", lambda posterior: SimpleNamespace(posterior=posterior))
    monkeypatch.setattr(reading, "_read", lambda *_: ([found], []))
    read = reading.along_the_motion(JOINT, ("torque_ripple", "stribeck"))
    assert read.channels[0].posterior.channel.cutoff_hz == cutoff_hz


def test_what_was_read_along_the_motion_is_tried_where_the_closed_loops_torque_leaves_its_gap() -> None:
    along = cast(Any, SimpleNamespace(allowed=()))
    floor = SimpleNamespace(inverse_nm=None, forward_torque_nm=None)
    for reasons, tried in (({"encoder": reading.HIDES}, [along]), ({}, [])):
        answer = cast(Any, SimpleNamespace(causes=(), noise_floor=floor, reasons=reasons))
        assert list(diagnose._others(JOINT, along, answer)) == tried


@pytest.mark.parametrize(("before", "guessed", "quiet_nm"), [(1.0, False, 2**0.5), (1.0, True, 0.9), (3.0, False, 0.9)])
def test_a_gap_as_loud_as_an_actuation_without_causes_is_its_noise(
    before: float, guessed: bool, quiet_nm: float
) -> None:
    gaps = [Closed("actuation", before, 1.0, 1.0, 1.0, 1.0)]
    assert quiet._quiet_nm(gaps, 0.3, 0.0, guessed=guessed) == pytest.approx(quiet_nm)
