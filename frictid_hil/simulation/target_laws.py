"""The friction that a file for another simulator says, read back from the text of the file."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.errors import FrictidError
from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.usd import joint_numbers, prim_name


@dataclass(frozen=True, slots=True)
class Law:
    """Friction over speed, as a file says it."""

    level_nm: float  # at speed
    rise_nm: float = 0.0  # what it is higher at standstill
    fall_rad_s: float = 0.0  # speed of the fall, exp(-(v/fall)**2); 0 where it falls at once
    damping: tuple[float, float, float] = (0.0, 0.0, 0.0)  # (a, b, c) of a v + b v abs(v) + c v**3
    armature_kg_m2: float | None = None  # None where the file has none

    def torque_nm(self, velocity_rad_s: Array, slip: Array) -> Array:
        """Against the motion, N m; ``slip`` is how much of the level has built up, -1..1. Shapes (n,)."""
        v, speed = velocity_rad_s, np.abs(velocity_rad_s)
        a, b, c = self.damping
        bump = np.exp(-((speed / self.fall_rad_s) ** 2)) if self.fall_rad_s > 0.0 else 0.0
        return np.asarray((self.level_nm + self.rise_nm * bump) * slip + (a + (b + c * speed) * speed) * v)


def laws_of(target: str, texts: Mapping[str, str], joints: Iterable[str]) -> list[dict[str, Law]]:
    """What the files of a target, as ``targets.written_as`` gives them, say by joint; several sets for ``samples``."""
    if target == "bam":
        by_stem = {Path(file).stem: _bam(json.loads(text)) for file, text in texts.items()}
        return [{name: law for name in joints for stem, law in by_stem.items() if stem.endswith(f"_{name}")}]
    (text,) = texts.values()
    if target == "samples":
        rows = json.loads(text)["samples"]
        return [{name: _numbers(n) for name, n in row.items()} for row in rows]
    if target == "newton":
        by_prim = _newton(text)
        return [{name: by_prim[prim_name(name)] for name in joints}]
    read = {"isaaclab": _isaac_lab, "mjlab": _mjlab, "c": _c_header, "ros2": _ros2}
    return [read[target](text)]


def _bam(told: Mapping[str, float]) -> Law:
    return Law(
        told["friction_base"],
        told["friction_stribeck"],
        told["dtheta_stribeck"],
        (told["friction_viscous"], 0.0, 0.0),
        told["armature"],
    )


def _numbers(n: Mapping[str, Any]) -> Law:
    a, b, c = n["damping"]
    return Law(n["dry_nm"], n["rise_nm"], n["stribeck_rad_s"], (a, b, c), n["armature_kg_m2"])


def _calls(text: str) -> list[dict[str, Any]]:
    """Keywords of the actuator configurations in a Python file."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id.endswith("Cfg"):
            found.append({word.arg: ast.literal_eval(word.value) for word in node.keywords if word.arg})
    return found


def _isaac_lab(text: str) -> dict[str, Law]:
    return {
        told["joint_names_expr"][0]: Law(
            told["dynamic_friction"],
            told["friction"] - told["dynamic_friction"],
            damping=(told["viscous_friction"], 0.0, 0.0),
            armature_kg_m2=told["armature"],
        )
        for told in _calls(text)
    }


def _mjlab(text: str) -> dict[str, Law]:
    tables = {ast.unparse(n.targets[0]): n.value for n in ast.parse(text).body if isinstance(n, ast.Assign)}
    damping = ast.literal_eval(tables["JOINT_DAMPING"])
    laws = {}
    for told in _calls(text):
        (name,) = told["target_names_expr"]
        laws[name] = Law(told["frictionloss"], damping=(damping[name], 0.0, 0.0), armature_kg_m2=told["armature"])
    return laws


def _ros2(text: str) -> dict[str, Law]:
    friction = yaml.safe_load(text)["/**"]["ros__parameters"]["friction"]
    return {
        name: Law(told["coulomb_nm"], damping=(told["viscous_nm_s_per_rad"], 0.0, 0.0))
        for name, told in friction.items()
    }


def _newton(text: str) -> dict[str, Law]:
    return {
        name: Law(told["friction"], damping=(told["damping"], 0.0, 0.0), armature_kg_m2=told["armature"])
        for name, told in joint_numbers(text).items()
    }


def _c_header(text: str) -> dict[str, Law]:
    table = text.partition("FRICTID_JOINTS[] = {")[2].partition("};")[0]
    laws = {}
    for words in re.findall(r'\{("(?:[^"\\]|\\.)*"), ([^}]*)\}', table):
        dry, rise, fall, a, b, c, _ = map(float, words[1].split(", "))
        laws[json.loads(words[0])] = Law(dry, rise, fall, (a, b, c))
    return laws


_PROGRAM = """#include <stdio.h>
#include <stdlib.h>
#include "friction.h"
int main(int count, char **words) {
    struct frictid_state state = {0.0};
    double v, step_s = atof(words[2]);
    if (count != 3) return 1;
    while (scanf("%lf", &v) == 1) printf("%.17g\\n", frictid_step(&FRICTID_JOINTS[atoi(words[1])], &state, v, step_s));
    return 0;
}
"""


def c_compiler() -> str | None:
    """The C compiler of this computer, if it has one."""
    return next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)


def run_c(header: str, velocity_rad_s: Mapping[str, Array], step_s: float) -> dict[str, Array]:
    """Friction of the header's step function along velocities at even steps, by joint, N m, (n,).

    ``FrictidError``: there is no compiler, or the header does not compile or run.
    """
    compiler = c_compiler()
    if compiler is None:
        raise FrictidError("no C compiler was found", next_step="install gcc or clang")
    found: dict[str, Array] = {}
    with tempfile.TemporaryDirectory(prefix="frictid-c-") as name:
        folder = Path(name)
        (folder / "friction.h").write_text(header)
        (folder / "main.c").write_text(_PROGRAM)
        try:
            build = [compiler, "-std=c99", "-O1", "main.c", "-o", "run", "-lm"]
            subprocess.run(build, cwd=folder, check=True, capture_output=True, text=True, timeout=60)
            for number, joint in enumerate(_c_header(header)):
                if joint in velocity_rad_s:
                    told = "\n".join(repr(float(v)) for v in velocity_rad_s[joint])
                    words = [str(folder / "run"), str(number), repr(step_s)]
                    ran = subprocess.run(words, input=told, check=True, capture_output=True, text=True, timeout=60)
                    found[joint] = np.array(ran.stdout.split(), dtype=np.float64)
        except (subprocess.SubprocessError, OSError) as error:
            said = getattr(error, "stderr", None) or str(error)
            raise FrictidError(f"the C header does not run: {said.strip()[:300]}", where=compiler) from error
    return found
