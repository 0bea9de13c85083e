"""The profile store under SIGKILL, and with 10,000 profiles in it.

    python benchmarks/store_kills.py [KILLS [PROFILES]]

A child adds and promotes profiles without end and is killed after a random 1 to 200 ms; after every kill the store must
open, and the active profile must be whole and one of those that the child was promoting. Then the history and the index
page of a robot with 10,000 profiles are timed in a process of their own.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance
from frictid_hil.config.store import ProfileStore

SPEEDS = tuple(0.2 * k for k in range(1, 11))


def main() -> None:
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    profiles = int(sys.argv[2]) if len(sys.argv) > 2 else 10_000
    with tempfile.TemporaryDirectory() as temporary:
        killed(Path(temporary) / "kills", kills)
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


def many(root: Path, count: int) -> None:
    """10,000 profiles as the store itself keeps them, added without a disk sync each to save an hour."""
    os.fsync = lambda _: None  # type: ignore[assignment]  # only here, and only for filling
    store = ProfileStore(root)
    store.promote("arm", store.add(profile(0)))
    folder = root / "arm" / "profiles"
    template = profile(0).to_yaml()
    for number in range(1, count):
        stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(1.7e9 + 3600 * number))
        text = template.replace(profile_stamp(0), stamp).encode()
        compact = stamp.replace("-", "").replace(":", "")
        (folder / f"{compact}-{hashlib.sha256(text).hexdigest()[:12]}.yaml").write_bytes(text)
    began = time.monotonic()
    store.rebuild_index("arm")
    print(f"{count} profiles: index rebuilt from the profiles in {time.monotonic() - began:.0f} s")
    command = [sys.executable, "-m", "frictid_hil.cli.app", "profile", "history", "arm", "--json", "--store", str(root)]
    page = (
        "from pathlib import Path; from frictid_hil.config.store import ProfileStore; "
        "from frictid_hil.jobs.history import write_index_page; "
        f"write_index_page(ProfileStore(Path({str(root)!r})), 'arm')"
    )
    for name, call in (("history", command), ("index page", [sys.executable, "-c", page])):
        began = time.monotonic()
        subprocess.run(call, check=True, stdout=subprocess.DEVNULL)
        print(f"{name}: {time.monotonic() - began:.2f} s, start of the program included")


def profile_stamp(number: int) -> str:
    return profile(number).provenance.created_utc


if __name__ == "__main__":
    main()
