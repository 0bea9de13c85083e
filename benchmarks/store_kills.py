"""The profile store under SIGKILL, and with 10,000 profiles in it.

    python benchmarks/store_kills.py [KILLS NIGHTS PROFILES]

A child adds, promotes and rolls back profiles without end and is killed after a random 1 to 200 ms; after every kill
the store must open, and the active profile must be whole and one of those that the child was promoting. Then whole
nights of ``recalibrate`` (one joint of the shipped robot, 2 cycles) are killed, each at a moment drawn evenly over how
long a night takes: the store must open, the active profile must be whole, and either that of before or the one of this
night.
Last, the history and the index page of a robot with 10,000 profiles are timed, each as a program of its own from its
start to its end.
"""

from __future__ import annotations

import hashlib
import os
import random
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.jobs.recalibrate import RecalibrateOptions, recalibrate
from frictid_hil.jobs.watch import Silent
from frictid_hil.profiles.store import ProfileStore

SPEEDS = tuple(0.2 * k for k in range(1, 11))
JOINT, ROBOT = "5", "killed"


def main() -> None:
    kills, nights, profiles = 1000, 1000, 10_000
    if len(sys.argv) > 1:
        kills, nights, profiles = (int(given) for given in sys.argv[1:4])
    with tempfile.TemporaryDirectory() as temporary:
        if kills:
            killed(Path(temporary) / "kills", kills)
        if nights:
            killed_nights(Path(temporary) / "nights", nights)
        if profiles:
            many(Path(temporary) / "many", profiles)


def profile(number: int) -> FrictionProfile:
    torque = tuple((1 + 1e-5 * number) * (4 + v) for v in SPEEDS)
    joint = JointProfile(
        method="aligned",
        velocity_rad_s=SPEEDS,
        torque_nm=torque,
        torque_interval_nm=tuple((t - 0.1, t + 0.1) for t in torque),
        coulomb_nm=Estimate(value=4.0 + 1e-4 * number, low=3.9, high=4.1 + 1e-4 * number),
        temperature_c=25.0,
    )
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(1.7e9 + 3600 * number))
    joints = {str(name): joint for name in range(6)}
    return FrictionProfile(robot="arm", joints=joints, provenance=Provenance(created_utc=stamp))


def killed(root: Path, kills: int) -> None:
    store = ProfileStore(root)
    two = [store.add(profile(number)) for number in (1, 2)]
    store.promote("arm", two[0])
    chance = random.Random(1)
    bad, promoted, began = 0, 0, time.monotonic()
    for _ in range(kills):
        before = len(store.promotions("arm"))
        child = os.fork()
        if child == 0:
            while True:
                for number in (1, 2):
                    store.promote("arm", store.add(profile(number)))
                store.rollback("arm")
        time.sleep(chance.uniform(0.001, 0.200))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        try:
            active = store.active("arm")
            assert active is not None and active.id in two
            expected = profile(1 + two.index(active.id)).content_sha256
            assert store.load("arm", active.id).content_sha256 == expected
        except Exception as error:  # whatever it is, it is what this benchmark looks for
            bad += 1
            print(f"after a kill: {error!r}")
        promoted += len(store.promotions("arm")) - before
    print(f"{kills} kills in {time.monotonic() - began:.0f} s, {promoted} promotions between them: {bad} bad stores")


def killed_nights(place: Path, kills: int) -> None:
    place.mkdir()
    store = ProfileStore(place / "store")
    # The first nights are whole: they say how long one takes, and everything is compiled and imported afterwards.
    for number in range(2):
        began = time.monotonic()
        assert night(place, number)["promoted"]
        lasts_s = time.monotonic() - began
    chance = random.Random(2)
    bad = finished = stored = promoted = 0
    started = time.monotonic()
    for number in range(2, kills + 2):
        before, had = store.active(ROBOT), {one.id for one in store.history(ROBOT)}
        assert before is not None
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            try:
                night(place, number)
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        time.sleep(chance.uniform(0.0, lasts_s))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        shutil.rmtree(place / f"run-{number}", ignore_errors=True)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0, f"night {number} failed by itself"
            finished += 1
            lasts_s = min(lasts_s, time.monotonic() - began)
        try:
            active, has = store.active(ROBOT), {one.id for one in store.history(ROBOT)}
            assert active is not None and len(has - had) <= 1 and had <= has
            assert active.id in {before.id} | (has - had)
            for identity in has - had | {active.id}:
                store.load(ROBOT, identity)
            store.attempts(ROBOT)
            stored += len(has - had)
            promoted += active.id != before.id
        except Exception as error:  # whatever it is, it is what this benchmark looks for
            bad += 1
            print(f"after the kill of night {number}: {error!r}")
        if number % 50 == 1:
            print(f"{number - 1} nights killed so far, {bad} bad stores", file=sys.stderr, flush=True)
    assert night(place, kills + 2)["promoted"], "the night after all of them must be a good one"
    print(
        f"{kills} nights killed in {time.monotonic() - started:.0f} s (a whole one takes {lasts_s:.2f} s): {stored} had"
        f" stored their profile, {promoted} had promoted it, {finished} had ended: {bad} bad stores; the next is good"
    )


def night(place: Path, number: int) -> dict[str, object]:
    values = load_robot("hp3j").values()
    values |= {"name": ROBOT, "bus": "virtual:store-kills", "joints": {JOINT: values["joints"][JOINT]}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 2}
    values["policy"] = {"warm_up": {"fixed_s": 0.0}}
    path = place / "killed.yaml"
    path.write_text(dump(values))
    options = RecalibrateOptions(str(path), store=place / "store", seed=number, out=place / f"run-{number}")
    return recalibrate(options, Silent())


def many(root: Path, count: int) -> None:
    """10,000 profiles as the store itself keeps them, added without a disk sync each to save an hour."""
    store = ProfileStore(root)
    first = store.add(profile(0))
    store.promote("arm", first)
    folder, stamp = root / "arm", profile(0).provenance.created_utc
    template = store.path("arm", first).read_text()
    store.history("arm")
    with sqlite3.connect(folder / "index.sqlite") as index:
        ((kind, value),) = index.execute("SELECT kind, value FROM kept WHERE kind LIKE 'profiles%'")
        for number in range(1, count):
            later = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(1.7e9 + 3600 * number))
            text = template.replace(stamp, later).encode()
            identity = f"{later.replace('-', '').replace(':', '')}-{hashlib.sha256(text).hexdigest()[:12]}"
            (folder / "profiles" / f"{identity}.yaml").write_bytes(text)
            row = value.replace(f'"id": "{first}"', f'"id": "{identity}"').replace(stamp, later)
            index.execute("INSERT INTO kept VALUES (?, ?, ?)", (kind, identity, row))
    history = [sys.executable, "-m", "frictid_hil.cli.app", "profile", "history", "arm", "--store", str(root)]
    page = [sys.executable, "-m", "frictid_hil.cli.app", "report", "--robot", "arm", "--store", str(root)]
    for name, command in (("history", history), ("history --json", [*history, "--json"]), ("index page", page)):
        timed(f"{count} profiles, {name}", command)
    (folder / "index.sqlite").unlink()
    timed(f"{count} profiles, history after the index was lost", history)
    timed(f"{count} profiles, history --json after the index was lost", [*history, "--json"])
    timed(f"{count} profiles, history after that", history)


def timed(name: str, command: list[str]) -> None:
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    wall_s, after = time.monotonic() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{name}: {wall_s:.2f} s, {cpu_s:.2f} s of one core, start of the program included")


if __name__ == "__main__":
    main()
