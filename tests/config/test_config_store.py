from __future__ import annotations

import os
import random
import signal
import sqlite3
import threading
import time
from contextlib import closing
from pathlib import Path

import filelock
import pytest

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile, JudgedGate
from frictid_hil.config.provenance import Provenance
from frictid_hil.errors import ConfigError, FrictidError, UsageError
from frictid_hil.profiles import index as index_module
from frictid_hil.profiles import store as store_module
from frictid_hil.profiles.drift import drift
from frictid_hil.profiles.records import Attempt
from frictid_hil.profiles.store import ProfileStore

V = (0.2, 0.4, 0.6, 1.9)


def profile(factor: float = 1.0, night: int = 1, joints: str = "0", robot: str = "hp3j") -> FrictionProfile:
    torque = tuple(factor * t for t in (8.5, 9.2, 9.8, 12.0))
    one = JointProfile(
        method="aligned",
        velocity_rad_s=V,
        torque_nm=torque,
        torque_interval_nm=tuple((t - 0.1, t + 0.1) for t in torque),
        coulomb_nm=Estimate(value=7.8 * factor, low=7.7 * factor, high=7.9 * factor),
        temperature_c=25.0 + night % 10,
        gates=(JudgedGate(name="tracking", passed=factor < 2, message="..."),),
    )
    day = f"20{26 + night // 360}-{1 + night % 360 // 30:02d}-{1 + night % 30:02d}"
    return FrictionProfile(
        robot=robot, joints=dict.fromkeys(joints, one), provenance=Provenance(created_utc=f"{day}T02:00:00Z")
    )


@pytest.fixture
def store(tmp_path: Path) -> ProfileStore:
    return ProfileStore(tmp_path / "store")


def test_nothing_is_active_until_promoted(store: ProfileStore) -> None:
    assert store.active("hp3j") is None
    assert store.active_profile("hp3j") is None
    assert store.history("hp3j") == []
    assert store.robots() == []
    first = store.add(profile())
    assert store.active("hp3j") is None
    store.promote("hp3j", first, by="Iwatani", reason="first")
    active = store.active("hp3j")
    assert active is not None
    assert (active.id, active.by, active.reason) == (first, "Iwatani", "first")
    assert store.active_profile("hp3j") == store.load("hp3j", first)
    assert store.robots() == ["hp3j"]


def test_profiles_are_kept_as_they_were_and_added_once(store: ProfileStore) -> None:
    first = store.add(profile())
    path = store.path("hp3j", first)
    assert path.read_text() == profile().to_yaml()
    assert path.stat().st_mode & 0o777 == 0o444
    assert store.add(profile()) == first
    assert len(store.history("hp3j")) == 1
    second = store.add(profile(1.1))
    assert second != first
    assert second[:16] == first[:16], "same time, other content"


def test_rollback_goes_back_step_by_step(store: ProfileStore) -> None:
    ids = [store.add(profile(1 + k / 10, night=k)) for k in range(1, 4)]
    for identity in ids:
        store.promote("hp3j", identity)
    assert store.rollback("hp3j", reason="hums").id == ids[1]
    assert store.rollback("hp3j").id == ids[0]
    with pytest.raises(UsageError, match="active before the present one"):
        store.rollback("hp3j")
    store.promote("hp3j", ids[2])
    assert store.rollback("hp3j").id == ids[0]
    assert [line.action for line in store.promotions("hp3j")] == [
        "promote", "promote", "promote", "rollback", "rollback", "promote", "rollback",
    ]  # fmt: skip


def test_promoting_the_active_profile_again_changes_nothing(store: ProfileStore) -> None:
    first = store.add(profile())
    store.promote("hp3j", first)
    store.promote("hp3j", first)
    assert len(store.promotions("hp3j")) == 1


def test_an_id_may_be_shortened_while_it_is_clear(store: ProfileStore) -> None:
    first = store.add(profile(night=1))
    store.add(profile(night=2))
    assert store.promote("hp3j", first[:10]).id == first
    for wrong, words in (("2026", "2 profiles"), ("1999", "no profile"), ("", "2 profiles")):
        with pytest.raises(UsageError, match=words):
            store.promote("hp3j", wrong)
    with pytest.raises(UsageError, match="no name of a robot"):
        store.active("../hp3j")


def test_a_changed_file_is_never_promoted_nor_loaded(store: ProfileStore) -> None:
    first = store.add(profile())
    path = store.path("hp3j", first)
    path.chmod(0o644)
    path.write_text(path.read_text().replace("12.0", "13.0"))
    with pytest.raises(ConfigError, match="changed after it was stored"):
        store.promote("hp3j", first)
    assert store.active("hp3j") is None


def test_what_is_loaded_stays_when_another_is_promoted(store: ProfileStore) -> None:
    first, second = store.add(profile()), store.add(profile(1.2))
    store.promote("hp3j", first)
    running = store.active_profile("hp3j")
    store.promote("hp3j", second)
    assert running == store.load("hp3j", first)
    assert store.active_profile("hp3j") == store.load("hp3j", second)


def test_drift_is_seen_from_the_baseline(store: ProfileStore) -> None:
    ids = []
    for night in range(10):
        ids.append(store.add(profile(1 + night / 100, night)))
        store.promote("hp3j", ids[-1])
    assert store.baseline("hp3j") == ids[0]
    trend = store.trends("hp3j")["0"]
    assert [point.joint.distance_percent for point in trend[1:]] == pytest.approx(
        [float(k) for k in range(1, 10)], rel=0.01
    )
    assert [point.joint.temperature_c for point in trend] == [25.0 + k for k in range(10)]
    assert trend[3].joint.coulomb_nm == pytest.approx(7.8 * 1.03)
    store.pin_baseline("hp3j", ids[9], reason="new grease")
    assert store.active("hp3j") == store.promotions("hp3j")[9], "what is active stays"
    assert store.trends("hp3j")["0"][0].joint.distance_percent == pytest.approx(100 * (1 - 1 / 1.09), rel=0.01)
    assert list(store.trends("hp3j")) == ["0"]


def test_history_tells_failed_gates(store: ProfileStore) -> None:
    store.add(profile(2.5))
    assert store.history("hp3j")[0].joints["0"].gates_failed == ["tracking"]


def test_differences_between_two_profiles() -> None:
    change = drift(profile(joints="01"), profile(1.15, night=4, joints="12"))
    assert list(change) == ["1"]
    one = change["1"]
    assert one.distance_percent == pytest.approx(15.0, rel=0.01), "an rms, in percent of a mean"
    assert one.coulomb_change_percent == pytest.approx(15.0)
    assert one.overlap_share == 0.0
    assert one.temperature_change_c == 3.0
    assert one.other_changes == {}
    same = drift(profile(), profile(1.005))["0"]
    assert same.overlap_share == 1.0
    other = profile().joints["0"].model_copy(update={"method": "function-a", "torque_interval_nm": None})
    changed = drift(profile(), profile().model_copy(update={"joints": {"0": other}}))["0"]
    assert changed.other_changes == {"method": "aligned -> function-a"}
    assert changed.overlap_share is None


def test_a_lost_or_spoilt_index_costs_nothing_but_time(store: ProfileStore, tmp_path: Path) -> None:
    for night in range(5):
        store.promote("hp3j", store.add(profile(night=night)))
    before = store.history("hp3j"), store.promotions("hp3j")
    index = tmp_path / "store" / "hp3j" / "index.sqlite"
    whole = index.read_bytes()
    dice = random.Random(1)
    for spoilt in (b"", whole[:5000], b"\xff\xfe garbage\n" * 500, whole[:100] + dice.randbytes(len(whole) - 100)):
        index.write_bytes(spoilt)
        assert (store.history("hp3j"), store.promotions("hp3j")) == before
    with sqlite3.connect(index) as database:
        database.execute("PRAGMA user_version = 99")
        database.execute("DROP TABLE kept")
    assert store.history("hp3j") == before[0], "another version's index is made anew"
    with sqlite3.connect(index) as database:
        database.execute("UPDATE kept SET value = '{half'")
    assert (store.history("hp3j"), store.promotions("hp3j")) == before
    index.unlink()
    index.mkdir()
    assert (store.history("hp3j"), store.promotions("hp3j")) == before, "where none can be kept, files are read"


def test_a_person_may_take_a_profile_out(store: ProfileStore) -> None:
    first, second = (store.add(profile(night=night)) for night in (1, 2))
    assert len(store.history("hp3j")) == 2
    store.path("hp3j", first).unlink()
    assert [stored.id for stored in store.history("hp3j")] == [second]


def test_what_the_index_lost_is_read_once(store: ProfileStore, monkeypatch: pytest.MonkeyPatch) -> None:
    for night in range(4):
        store.add(profile(night=night))
    store.promote("hp3j", store.add(profile(night=5)))
    before = store.trends("hp3j")
    (store.root / "hp3j" / "index.sqlite").unlink()
    assert store.trends("hp3j") == before
    baseline = store.baseline("hp3j")
    read = []
    load = ProfileStore.load
    monkeypatch.setattr(ProfileStore, "load", lambda self, robot, one: read.append(one) or load(self, robot, one))
    assert store.trends("hp3j") == before
    assert set(read) <= {baseline}, "all others are told by the index"


def test_a_store_that_may_not_be_written_is_told_all_the_same(store: ProfileStore) -> None:
    store.promote("hp3j", store.add(profile()))
    before = store.history("hp3j")
    index = store.root / "hp3j" / "index.sqlite"
    with closing(sqlite3.connect(index)) as database:
        database.execute("DELETE FROM kept")
        database.commit()
        database.execute("BEGIN EXCLUSIVE")  # as another process, or a file system without locks, would have it
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(index_module, "_BUSY_S", 0.01)
            assert store.history("hp3j") == before


def test_a_file_that_a_crash_left_half_written_is_no_promotion(store: ProfileStore, tmp_path: Path) -> None:
    first, second = store.add(profile()), store.add(profile(1.1))
    store.promote("hp3j", first)
    store.promote("hp3j", second)
    newest = tmp_path / "store" / "hp3j" / "promotions" / "000002.yaml"
    newest.rename(newest.with_name(".000002.yaml.x.part"))
    active = store.active("hp3j")
    assert active is not None and active.id == first
    store.promote("hp3j", second)
    assert [one.id for one in store.promotions("hp3j")] == [first, second]
    assert not list(newest.parent.glob(".*"))


def test_a_promotion_that_is_none_is_told_with_its_place(store: ProfileStore, tmp_path: Path) -> None:
    store.promote("hp3j", store.add(profile()))
    (tmp_path / "store" / "hp3j" / "promotions" / "000002.yaml").write_text("schema: frictid.store-note/1\nwho: me\n")
    with pytest.raises(ConfigError, match=r"000002.yaml: not what the store wrote"):
        store.active("hp3j")


def test_recalibrations_are_kept_in_order(store: ProfileStore) -> None:
    nights = [Attempt(f"2026-11-{day:02d}T02:00:00Z", "ok", 0, drift_percent={"0": 1.0 * day}) for day in range(1, 5)]
    for night in [*nights, nights[0]]:
        store.note_attempt("hp3j", night)
    assert [night.utc for night in store.attempts("hp3j")] == [night.utc for night in nights]
    assert store.attempts("hp3j", 2)[0].drift_percent == {"0": 3.0}


def test_a_full_disk_leaves_the_store_as_it_was(store: ProfileStore, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = store.add(profile()), store.add(profile(1.1))
    store.promote("hp3j", first)

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(FrictidError, match="disk is full"):
            store.promote("hp3j", second)
        with pytest.raises(FrictidError, match="disk is full"):
            store.add(profile(1.3))
    active = store.active("hp3j")
    assert active is not None and active.id == first
    assert len(store.history("hp3j")) == 2
    assert len(store.promotions("hp3j")) == 1


def test_writers_exclude_each_other(store: ProfileStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store.add(profile())
    monkeypatch.setattr(store_module, "_LOCK_TIMEOUT_S", 0.05)
    with (
        filelock.FileLock(tmp_path / "store" / "hp3j" / ".lock"),
        pytest.raises(FrictidError, match="another process has held the profile store"),
    ):
        store.add(profile(1.1))
    monkeypatch.setattr(store_module, "_LOCK_TIMEOUT_S", 30.0)
    threads = [
        threading.Thread(target=ProfileStore(store.root).add, args=(profile(1 + k / 50, k),)) for k in range(1, 9)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(store.history("hp3j")) == 9


def kill_while_writing(root: Path, kills: int) -> None:
    """Fork writers that add, promote and roll back as fast as they can; kill each at a random moment."""
    store = ProfileStore(root)
    old, new = store.add(profile()), store.add(profile(1.1))
    store.promote("hp3j", old)
    dice = random.Random(1)
    for k in range(kills):
        writer = os.fork()
        if writer == 0:
            try:
                n = 0
                while True:
                    n += 1
                    store.promote("hp3j", new if n % 2 else old)
                    store.add(profile(1.0 + 1e-6 * (1000 * k + n), night=3))
                    if n % 3 == 0:
                        store.rollback("hp3j")
            finally:
                os._exit(1)
        time.sleep(dice.uniform(0.0, 0.03))
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        active = store.active("hp3j")
        assert active is not None
        assert active.id in (old, new)
        assert store.active_profile("hp3j") is not None
        if k % 50 == 49:
            assert [stored.id for stored in store.history("hp3j")] == sorted(
                path.stem for path in (root / "hp3j" / "profiles").glob("*.yaml")
            )
    store.add(profile(1.5))
    assert not list((root / "hp3j").glob("*/.*")), "what the killed had staged is tidied away"


@pytest.mark.slow
def test_fifty_kills_never_spoil_the_store(tmp_path: Path) -> None:
    kill_while_writing(tmp_path, 50)


def test_a_long_history_opens_no_profile(tmp_path: Path) -> None:
    store = ProfileStore(tmp_path)
    folder = tmp_path / "hp3j"
    first = store.add(profile(joints="012345"))
    store.promote("hp3j", first)
    assert len(store.history("hp3j")) == 1
    with sqlite3.connect(folder / "index.sqlite") as database:
        ((kind, value),) = database.execute("SELECT kind, value FROM kept WHERE kind LIKE 'profiles%'")
        assert first in kind
        for k in range(200):
            identity = f"20260101T{k:06d}Z-{k:012x}"
            (folder / "profiles" / f"{identity}.yaml").write_text("read, I am no profile")
            database.execute("INSERT INTO kept VALUES (?, ?, ?)", (kind, identity, value))
    assert len(store.history("hp3j")) == len(store.trends("hp3j")["5"]) == 201
    assert len(store.history("hp3j", 3)) == 3


def test_reading_many_profiles_anew_is_told(store: ProfileStore) -> None:
    for night in range(3):
        store.add(profile(night=night))
    told: list[tuple[int, int]] = []
    ProfileStore(store.root, lambda done, of: told.append((done, of))).history("hp3j")
    assert told == [(1, 3), (2, 3), (3, 3)]
    ProfileStore(store.root, lambda done, of: told.append((done, of))).history("hp3j")
    assert len(told) == 3, "the index was written"
