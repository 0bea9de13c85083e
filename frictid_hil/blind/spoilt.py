"""Real recordings with an effect added to their torque in software: nobody drew the joint, its noise or its friction.

What is added is larger than the gap that was there, so that its name is the right first answer.
"""

from __future__ import annotations

import gzip
import io
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.blind.joints import either_sign
from frictid_hil.blind.wide import Drawn, Row
from frictid_hil.blind.zoo import truth_of
from frictid_hil.friction.trajectory import Array

ADDED = ("torque_bias", "torque_ripple", "direction_asymmetry", "torque_constant_error")
TIMES = (4.0, 12.0)  # size of what is added over what shows already; where a third of a gap stays, nothing is named


def recorded_sets() -> tuple[Path, ...]:
    """Folders of real sets with a torque; empty where none are here."""
    told = os.environ.get("FRICTID_REAL_MORE_DATA")  # with ``cases/``; else beside the repository, in shared/data
    folder = Path(told) if told else Path(__file__).resolve().parents[3] / "shared" / "data" / "real-more"
    found = (path.parent for path in sorted((folder / "cases").glob("*/nominal.yaml")))
    return tuple(path for path in found if "torque_nm" in _header(path))


def draw_spoilt(index: int, seed: int, folder: Path) -> Drawn:
    """A recorded set with one effect added."""
    rng = np.random.default_rng([seed, 606, index])
    nominal = yaml.safe_load((folder / "nominal.yaml").read_text())
    logs = [_read(folder, entry) for entry in nominal["experiments"]]
    one_way = min(min(np.mean(v > 0), np.mean(v < 0)) for v in (np.diff(log["position_rad"]) for log in logs)) < 0.03
    scale = float(np.sqrt(np.mean([np.mean(_missing(log, nominal) ** 2) for log in logs])))
    times = math.exp(rng.uniform(*np.log(TIMES)))
    share = times * scale / max(float(np.std(np.concatenate([log["torque_nm"] for log in logs]))), 1e-12)
    # A drive that reports twice the torque is no torque constant.
    effect = str(rng.choice(("torque_ripple",) if one_way else ADDED if share < 0.4 else ADDED[:-1]))
    gear = float(nominal["joint"].get("gear_ratio") or 1.0)
    sign, cycles, phase = either_sign(rng, 0.99, 1.0), float(rng.choice([1, 2, 4])), rng.uniform(0.0, 6.28)
    parameters = []
    for log in logs:
        q, torque = log["position_rad"], log["torque_nm"]
        v = np.gradient(q, log["time_s"])
        if effect == "torque_bias":
            added = np.full_like(q, sign * times * scale)
            parameters = [{"effect": effect, "parameter": "bias_nm", "value": sign * times * scale}]
        elif effect == "torque_ripple":
            added = math.sqrt(2.0) * times * scale * np.cos(cycles * gear * q + phase)
        elif effect == "direction_asymmetry":
            added = sign * times * scale * np.tanh(np.abs(v) / (0.02 * np.abs(v).max()))
        else:
            # The drive reports more than the joint gets.
            added = torque * share
            parameters = [{"effect": effect, "parameter": "error_share", "value": 1.0 / (1.0 + share) - 1.0}]
        log["torque_nm"] = torque + added
    name = f"case_{index:03d}"
    rows = tuple(Row(entry["name"], log) for entry, log in zip(nominal["experiments"], logs, strict=True))
    for entry in nominal["experiments"]:
        entry["file"] = f"{entry['name']}.csv.gz"
    nominal["case"] = name
    return nominal, rows, truth_of(name, "zoo", "single", effect, times, parameters)


def _header(folder: Path) -> str:
    entry = yaml.safe_load((folder / "nominal.yaml").read_text())["experiments"][0]
    with gzip.open(folder / entry["file"], "rt") as file:
        return file.readline()


def _read(folder: Path, entry: dict[str, Any]) -> dict[str, Array]:
    with gzip.open(folder / entry["file"], "rt") as file:
        names = file.readline().strip().split(",")
        table = np.loadtxt(io.StringIO(file.read()), delimiter=",")
    return {name: table[:, k].copy() for k, name in enumerate(names)}


def _missing(log: dict[str, Array], nominal: dict[str, Any]) -> Array:
    """Torque less the user's own column and the believed curve, its mean left in: the gap that is there already."""
    curve = nominal["joint"]["friction"]
    v = np.gradient(log["position_rad"], log["time_s"])
    width = max(1, round(0.05 / float(np.median(np.diff(log["time_s"])))))
    smooth = np.convolve(v, np.ones(width) / width, "same")
    sliding = np.interp(np.abs(smooth), curve["velocity_rad_s"], curve["torque_nm"])
    left = log["torque_nm"] - log.get("rigid_body_torque_nm", 0.0) - np.sign(smooth) * sliding
    kept: Array = np.convolve(left, np.ones(width) / width, "same")[width:-width]
    return kept
