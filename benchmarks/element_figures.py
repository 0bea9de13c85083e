"""What MuJoCo's own elements do by themselves, on the three joints of ``native_elements``: rest, break-away, sliding.

Run: python benchmarks/element_figures.py [--docs]

A row per figure, a column per joint. ``--docs`` writes them to ``docs/evidence/data/element-figures.csv``.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import native_elements
import numpy as np

JOINTS = native_elements.JOINTS
DOCS = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "data" / "element-figures.csv"
STEP_S = 0.001
MODEL = """<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="Euler" gravity="0 0 0"/>
<worldbody><body><inertial pos="0 0 0" mass="1" diaginertia="{link} {link} {link}"/>
<joint name="joint" axis="0 -1 0" armature="{motor}" {joint}/>{inner}</body></worldbody>
<tendon>{tendon}</tendon><actuator>{actuator}</actuator></mujoco>"""
RINGING_1_S = 20.0
"""Damping over inertia from outside, so that a spring without any comes to rest."""
STIFF = 'solimpfriction="0.9999 0.9999" solreffriction="0.004 1"'


def model(name: str, parts: Mapping[str, str], step_s: float = STEP_S) -> Any:
    """One joint without gravity, compiled."""
    j = JOINTS[name]
    motor = j["share"] * j["inertia"]
    told = {"joint": "", "inner": "", "tendon": "", "actuator": "", **parts}
    text = MODEL.format(step=step_s, link=j["inertia"] - motor, motor=motor, **told)
    return mujoco.MjModel.from_xml_string(text)


def lugre(name: str, rule: float) -> str:
    """Level and bristle of the joint as LuGre, its micro-damping so many times what the step asks for."""
    j = JOINTS[name]
    stiffness = min(j["dry"] / j["turn"], j["inertia"] / (1.3 * STEP_S**2))
    numbers = f"{stiffness} {rule * STEP_S * stiffness} {j['dry']} {j['dry']} 1"
    return f'<dcmotor joint="joint" input="none" motorconst="0" resistance="1" lugre="{numbers}"/>'


def spring(name: str) -> str:
    """The same as a spring that yields."""
    j = JOINTS[name]
    return f'stiffness="{j["dry"] / j["turn"]}" springyield="{j["turn"]}"'


ELEMENTS: dict[str, Callable[[str], dict[str, str]]] = {
    "frictionloss": lambda n: {"joint": f'frictionloss="{JOINTS[n]["dry"]}"'},
    "frictionloss, stiff solver": lambda n: {"joint": f'frictionloss="{JOINTS[n]["dry"]}" {STIFF}'},
    "springyield": lambda n: {"joint": spring(n)},
    "LuGre, 1.3 times the step rule": lambda n: {"actuator": lugre(n, 1.3)},
    "LuGre, half of the step rule": lambda n: {"actuator": lugre(n, 0.5)},
}


def loaded(name: str, element: str, share: float) -> tuple[Any, Any]:
    """(model, data) of a joint at rest under so much of its level; what rang has been damped from outside."""
    m = model(name, ELEMENTS[element](name))
    data, j = mujoco.MjData(m), JOINTS[name]
    for step in range(3000):
        torque = min(1.0, step / 2000) * share * j["dry"]
        data.qfrc_applied[0] = torque - RINGING_1_S * j["inertia"] * data.qvel[0]
        mujoco.mj_step(m, data)
    data.qfrc_applied[0] = share * j["dry"]
    return m, data


def creep_urad_s(name: str, element: str) -> float:
    """Speed under half of the friction level."""
    m, data = loaded(name, element, 0.5)
    places = []
    for _ in range(3000):
        mujoco.mj_step(m, data)
        places.append(float(data.qpos[0]))
    return 1e6 * abs(float(np.mean(places[-500:]) - np.mean(places[500:1000]))) / 2.0


def breaks_at(name: str, element: str) -> float:
    """Torque over the level at which the joint goes, %; it rises by two hundredths a second from 0.9 on."""
    m, data = loaded(name, element, 0.9)
    level, start = JOINTS[name]["dry"], float(data.qpos[0])
    while abs(float(data.qpos[0]) - start) < 5.0 * JOINTS[name]["turn"] and data.qfrc_applied[0] < 1.2 * level:
        data.qfrc_applied[0] += 0.02 * level * STEP_S
        mujoco.mj_step(m, data)
    return 100.0 * float(data.qfrc_applied[0]) / level


def slides_at(name: str, element: str) -> float:
    """Torque that a joint needs which is driven at 0.5 rad/s, over its level, %."""
    m = model(name, ELEMENTS[element](name))
    data, gain = mujoco.MjData(m), 50.0 * JOINTS[name]["inertia"]
    torque, told = 0.0, []
    for step in range(4000):
        error = 0.5 - float(data.qvel[0])
        torque += 20.0 * gain * error * STEP_S
        data.qfrc_applied[0] = torque + gain * error
        mujoco.mj_step(m, data)
        told += [float(data.qfrc_applied[0])] if step >= 3000 else []
    return 100.0 * float(np.mean(told)) / JOINTS[name]["dry"]


def play_percent(name: str, limits: str) -> float:
    """Width of a play of 2 mrad under a tenth of the friction level both ways, % of it."""
    own = JOINTS[name]["inertia"]
    inner = (
        f'<body><inertial pos="0 0 0" mass="1" diaginertia="{own} {own} {own}"/>'
        f'<joint name="play" axis="0 -1 0" limited="true" range="-0.001 0.001" {limits}/></body>'
    )
    m = model(name, {"joint": 'damping="1"', "inner": inner})
    ends = []
    for sign in (1.0, -1.0):
        data = mujoco.MjData(m)
        for _ in range(3000):
            data.qpos[0], data.qvel[0] = 0.0, 0.0
            data.qfrc_applied[1] = sign * 0.1 * JOINTS[name]["dry"] - 5.0 * own * data.qvel[1]
            mujoco.mj_step(m, data)
        ends.append(float(data.qpos[1]))
    return 100.0 * (ends[0] - ends[1]) / 0.002


def delay_ms(name: str, interp: str, asked_s: float, samples: int, step_s: float) -> float:
    """By how much a step of the control comes later as force, ms."""
    drive = f'<motor name="drive" joint="joint" delay="{asked_s}" nsample="{samples}" interp="{interp}"/>'
    m = model(name, {"actuator": drive}, step_s)
    data = mujoco.MjData(m)
    data.ctrl[0] = 1.0
    late = 0.0
    for _ in range(20):
        mujoco.mj_step(m, data)
        late += 1.0 - float(data.actuator_force[0])
    return 1e3 * late * step_s


def cogging_percent(name: str) -> float:
    """Largest error of a line of 0.3 N m, 7 periods a turn and 0.4 rad of phase, % of it."""
    line = '<dcmotor joint="joint" input="none" motorconst="0" resistance="1" cogging="0.3 7 0.4"/>'
    m = model(name, {"actuator": line})
    data, off = mujoco.MjData(m), 0.0
    for place in np.linspace(-1.0, 1.0, 41):
        data.qpos[0] = place
        mujoco.mj_forward(m, data)
        off = max(off, abs(abs(float(data.qfrc_actuator[0])) - abs(0.3 * math.sin(7.0 * place + 0.4))))
    return 100.0 * off / 0.3


def far_spring_percent(name: str) -> float:
    """Error of a constant 0.3 N m by a far spring over a travel of 2 rad, % of it."""
    m = model(name, {"joint": 'stiffness="1e-6" springref="3e5"'})
    data, off = mujoco.MjData(m), 0.0
    for place in (-1.0, 0.0, 1.0):
        data.qpos[0] = place
        mujoco.mj_forward(m, data)
        off = max(off, abs(float(data.qfrc_passive[0]) - 0.3))
    return 100.0 * off / 0.3


def rows() -> list[tuple[str, list[float]]]:
    """(figure, one number for each joint)."""
    told: list[tuple[str, list[float]]] = []
    for element in ELEMENTS:
        told.append((f"creep under half of the level, {element}, urad/s", [creep_urad_s(n, element) for n in JOINTS]))
    for element in list(ELEMENTS)[:4]:
        told.append((f"breaks away at, {element}, % of the level", [breaks_at(n, element) for n in JOINTS]))
        told.append((f"slides at 0.5 rad/s, {element}, % of the level", [slides_at(n, element) for n in JOINTS]))
    contact = 'solimplimit="0.001 0.001 0.001" solreflimit="-190000 -390"'
    for what, limits in (("default", ""), ("solreflimit 0.004 1", 'solreflimit="0.004 1"'), ("as written", contact)):
        told.append((f"play of 2 mrad, {what}, %", [play_percent(n, limits) for n in JOINTS]))
    told.append(
        ("delay of 5 ms at a step of 2 ms, linear, ms", [delay_ms(n, "linear", 0.005, 4, 0.002) for n in JOINTS])
    )
    told.append(("delay of 5 ms at a step of 2 ms, zoh, ms", [delay_ms(n, "zoh", 0.005, 4, 0.002) for n in JOINTS]))
    told.append(("cogging, largest error, %", [cogging_percent(n) for n in JOINTS]))
    told.append(("far spring over 2 rad, largest error, %", [far_spring_percent(n) for n in JOINTS]))
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", action="store_true")
    asked = parser.parse_args()
    told = [["Figure", *JOINTS], *([name, *(f"{value:.3g}" for value in values)] for name, values in rows())]
    csv.writer(sys.stdout).writerows(told)
    if asked.docs:
        with DOCS.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(told)


if __name__ == "__main__":
    main()
