"""All six joints at once against one by one, joints on one arm: how far the curves differ, how long it takes.

    python benchmarks/together.py [--seeds 1,2,3] [--rate HZ] [--fd DATA_BITRATE] [--out FOLDER]

`profiles/hp3j-arm.yaml` is calibrated through the bus at its own rate or another, on classical CAN or CAN FD, once with
all joints together and once with each joint alone, first without torque noise - what then differs is of the method -,
then with the shipped noise, for every seed. `left in` is the distance with nothing taken off for other joints, the rows
below it say what MuJoCo's own terms would leave if they were known and taken off instead (least squares' gravity is
taken off in every row). With noise, single pairs differ by what noise alone makes of two runs; `methodical` is what all
runs show to be of the method (`two_ways.py` says how).
Distances are (15) in percent of the curve's mean, over the measured range [V_1, V_N] and, without noise, over [0, V].
`M found` is the largest error of a row of the off-diagonal inertia against MuJoCo's, in percent of the joint's own.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from two_ways import Comparison, Curves, compare, least_apart

from frictid_hil.config.profile import FrictionProfile, JointProfile, load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.friction.filtering import Gaussian
from frictid_hil.friction.metrics import CurveDistance, curve_distance, curve_mean
from frictid_hil.friction.trajectory import Array
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate, plan_calibration
from frictid_hil.jobs.compare import true_curve
from frictid_hil.jobs.identification.cycles import declared_skew
from frictid_hil.jobs.identification.joint_profile import identify_joint, procedure_of
from frictid_hil.jobs.watch import Silent
from frictid_hil.protocol.driver import load_driver
from frictid_hil.recording.read import read
from frictid_hil.simulation.arm_model import ArmModel
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.rigid_bodies import RigidBodies

ROBOT = "hp3j-arm.yaml"
NAMES = ("0", "1", "2", "3", "4", "5")


@dataclass(frozen=True)
class Run:
    """One calibration of the whole arm.

    Attributes:
        profile: what came of it.
        duration_s: of motion and powering, summed over sessions.
        folder: of the recording; of the first joint where they were run one by one.
    """

    profile: dict[str, JointProfile]
    duration_s: float
    folder: Path


def calibrated(robot: str, out: Path, seed: int, joints: tuple[str, ...], *, together: bool) -> Run:
    options = CalibrateOptions(
        robot, bus=f"virtual:bench-{out.name}", out=out, seed=seed, joints=joints, together=together
    )
    if not (out / "profile.yaml").exists():
        result = calibrate(options, Silent()).to_json()
        if result["outcome"] not in ("ok", "gate_failed"):
            raise SystemExit(f"{out}: {result}")
    profile: FrictionProfile = load_profile(out / "profile.yaml")
    return Run({name: profile.joint(name) for name in joints}, _duration_s(out, together=together), out)


def _duration_s(out: Path, *, together: bool) -> float:
    """Run time from the first to the last sample of the joints' sessions."""
    spans = [joint.time_s[-1] - joint.time_s[0] for joint in read(out, None) if joint.marks]
    return float(max(spans) if together else sum(spans))


def one_by_one(robot: str, folder: Path, name: str, seed: int) -> Run:
    runs = [calibrated(robot, folder / f"{name}-{j}", seed, (j,), together=False) for j in NAMES]
    return Run(
        {j: run.profile[j] for j, run in zip(NAMES, runs, strict=True)},
        sum(run.duration_s for run in runs),
        runs[0].folder,
    )


def distance(first: JointProfile, second: JointProfile) -> CurveDistance:
    assert first.procedure is not None
    return curve_distance(first.curve(), second.curve(), first.procedure.velocity_rad_s)


def to_truth(profile: JointProfile, joint: str) -> float:
    assert profile.procedure is not None
    velocity = profile.procedure.velocity_rad_s
    truth = true_curve(load_robot(ROBOT), joint, velocity)
    return curve_distance(profile.curve(), truth, velocity).e_percent_measured_range


def left_in(run: Run, alone: Run) -> dict[str, float]:
    """Distances of the same recording, the other joints' columns withheld."""
    setup = load_robot(ROBOT).to_setup()
    found = {s.joint: identify_joint(s, setup.joint(s.joint), method="aligned") for s in read(run.folder, None)}
    return {name: distance(found[name], alone.profile[name]).e_percent_measured_range for name in NAMES}


def without_true(run: Run, alone: Run) -> dict[str, dict[str, float]]:
    """Distances of the same recording, parts of the true rigid-body torque taken off: which one is it that is left?

    Args:
        run: together.
        alone: one by one.
    """
    setup = load_robot(ROBOT).to_setup()
    bodies = RigidBodies(the_arm())
    every = {samples.joint: samples for samples in read(run.folder, None)}
    marks = every["0"].marks
    step_s = float(np.median(np.diff(every["0"].time_s)))
    time_s = np.arange(marks[0].start_ns * 1e-9, marks[-1].end_ns * 1e-9, step_s)
    smoother = Gaussian(step_s, 1.5 * step_s)
    seen = [np.interp(time_s, s.time_s - declared_skew(s).position_delay_s, s.position_rad) for s in every.values()]
    orders = smoother.smooth, smoother.rate, smoother.curvature
    q, v, a = (np.column_stack([order(column) for column in seen]) for order in orders)
    parts = {what: np.zeros_like(q) for what in ("M a", "gravity", "velocity products")}
    still = np.zeros(len(NAMES))
    for k in range(time_s.size):
        matrix, asked = bodies.at(q[k], v[k])
        weight = bodies.at(q[k], still)[1]
        parts["M a"][k] = matrix @ a[k] - np.diag(matrix) * a[k]
        parts["gravity"][k] = weight
        parts["velocity products"][k] = asked - weight
    parts["all three"] = sum(parts.values(), np.zeros_like(q))
    rows: dict[str, dict[str, float]] = {}
    for what, taken in parts.items():
        found = {}
        for i, (name, samples) in enumerate(every.items()):
            assert samples.torque_nm is not None
            late = np.interp(samples.time_s - declared_skew(samples).torque_delay_s, time_s, taken[:, i])
            bare = replace(samples, torque_nm=samples.torque_nm - late)
            found[name] = identify_joint(bare, setup.joint(name), method="aligned")
        rows[f"true {what} taken off"] = {
            name: distance(found[name], alone.profile[name]).e_percent_measured_range for name in NAMES
        }
    return rows


def by_least_squares(folder: Path, prefix: str) -> dict[str, float]:
    """Distances of the same recordings, identified by least squares."""
    setup = load_robot(ROBOT).to_setup()
    company = read(folder / f"{prefix}-together", None)
    gaps = {}
    for samples in company:
        name = samples.joint
        (alone,) = (one for one in read(folder / f"{prefix}-{name}", None) if one.joint == name)
        first = identify_joint(samples, setup.joint(name), method="least-squares", company=company)
        second = identify_joint(alone, setup.joint(name), method="least-squares")
        gaps[name] = distance(first, second).e_percent_measured_range
    return gaps


def lag_ms(run: Run) -> dict[str, float]:
    """Of the measured position behind its set-point in the fastest cycle, milliseconds."""
    lags = {}
    for samples in read(run.folder, None):
        (mark,) = samples.marked("cycles")
        procedure = procedure_of(mark)
        time_s = samples.time_s - mark.start_ns * 1e-9
        starts_s, frequency_rad_s = procedure.cycle_starts_s, procedure.angular_frequencies_rad_s[-1]
        kept = (time_s >= starts_s[-2]) & (time_s < starts_s[-1])
        turn = np.exp(-1j * frequency_rad_s * time_s[kept])
        assert samples.position_command_rad is not None
        ahead, behind = (
            np.angle(np.sum((column[kept] - column[kept].mean()) * turn))
            for column in (samples.position_command_rad, samples.position_rad)
        )
        lags[samples.joint] = float(1e3 * ((ahead - behind + np.pi) % (2 * np.pi) - np.pi) / frequency_rad_s)
    return lags


def the_arm() -> ArmModel:
    setup = load_robot(ROBOT).to_setup()
    return ArmModel.from_mapping(setup.simulated_arm, {joint.name: joint.dh for joint in setup.joints})


def inertia_error(run: Run) -> dict[str, float]:
    """Largest error of each joint's row in the middle of the travel, in percent of the joint's own inertia."""
    robot = load_robot(ROBOT)
    middle = [joint.start_position_rad + math.radians(10) for joint in robot.to_setup().joints]
    matrix, _ = RigidBodies(the_arm()).at(np.array(middle), np.zeros(6))
    worst = {}
    for i, name in enumerate(NAMES):
        row = run.profile[name].quality["coupling_kg_m2"]
        model = JointModel.of(robot.file.joints[name], name)
        own = matrix[i, i] + model.motor_inertia_share * model.inertia_kg_m2
        worst[name] = 100 * max(abs(row[o] - matrix[i, j]) / own for j, o in enumerate(NAMES) if j != i)
    return worst


def on_wire(folder: Path, rate_hz: float | None, data_bitrate: int | None) -> str:
    """The arm as shipped, at another rate or on another wire."""
    if rate_hz is None and data_bitrate is None:
        return ROBOT
    path = folder / "wire.yaml"
    rate = f"cycle_hz: {rate_hz}\n" if rate_hz else ""
    options = f"options: {{fd: true, data_bitrate: {data_bitrate}}}\n" if data_bitrate else ""
    path.write_text(f"schema: frictid.robot/1\nextends: {ROBOT}\n{rate}{options}")
    return str(path)


def quiet(folder: Path, robot: str) -> str:
    path = folder / "quiet.yaml"
    lines = "".join(f"  '{name}': {{simulated: {{drive: {{torque_noise_per_mille: 0}}}}}}\n" for name in NAMES)
    path.write_text(f"schema: frictid.robot/1\nextends: {robot}\nname: hp3j-arm-quiet\njoints:\n{lines}")
    return str(path)


def table(title: str, rows: dict[str, dict[str, float]]) -> None:
    print(f"\n{title}")
    print(f"| {'':36} | " + " | ".join(f"J{name:<5}" for name in NAMES) + " |")
    for name, row in rows.items():
        print(f"| {name:36} | " + " | ".join(f"{row[joint]:6.3f}" for joint in NAMES) + " |")


def averaged(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in NAMES}


def highest_rates_hz() -> None:
    wires: list[dict[str, object]] = [{"bitrate": 1_000_000}, {"bitrate": 500_000}]
    wires += [{"fd": True, "data_bitrate": data} for data in (2_000_000, 4_000_000, 5_000_000, 8_000_000)]
    for wire in wires:
        for joints, together in ((("0",), False), (NAMES[:3], True), (NAMES, True)):
            planned = plan_calibration(CalibrateOptions(ROBOT, joints=joints, together=together))
            options = {**planned.order.setup.options, **wire}
            setup = replace(planned.order.setup, bus="virtual:bench-rates", options=options)
            driver = load_driver("virtual")(setup)  # type: ignore[call-arg]  # protocols carry no constructor
            driver.open(lambda *_: None)
            try:
                driver.configure(100.0, joints)
                rate = driver.capabilities().max_cycle_hz
            finally:
                driver.close()
            print(f"{len(joints)} joints moving, {wire}: at most {rate:.0f} Hz")


def noiseless(folder: Path, robot: str) -> None:
    """What differs is of the method."""
    file = quiet(folder, robot)
    together = calibrated(file, folder / "quiet-together", 1, NAMES, together=True)
    alone = one_by_one(file, folder, "quiet", 1)
    gaps = {name: distance(together.profile[name], alone.profile[name]) for name in NAMES}
    table(
        "without torque noise, percent",
        {
            "together - one by one, [V_1, V_N]": {name: gap.e_percent_measured_range for name, gap in gaps.items()},
            "together - one by one, [0, V]": {name: gap.e_percent for name, gap in gaps.items()},
            "left in: other joints not taken off": left_in(together, alone),
            **without_true(together, alone),
            "truth - together": {name: to_truth(together.profile[name], name) for name in NAMES},
            "truth - one by one": {name: to_truth(alone.profile[name], name) for name in NAMES},
            "M found: largest error": inertia_error(together),
            "least squares, [V_1, V_N]": by_least_squares(folder, "quiet"),
            "lag behind the set-point, ms": lag_ms(together),
        },
    )
    print(f"\ntogether {together.duration_s:.1f} s; one by one {alone.duration_s:.1f} s")


def noisy(folder: Path, seeds: list[int], robot: str) -> None:
    """Single pairs of runs, and what is left between the means of all of them."""
    together = [calibrated(robot, folder / f"s{seed}-together", seed, NAMES, together=True) for seed in seeds]
    alone = [one_by_one(robot, folder, f"s{seed}", seed) for seed in seeds]
    rows = {
        f"together - one by one, seed {seed}": {
            n: distance(a.profile[n], b.profile[n]).e_percent_measured_range for n in NAMES
        }
        for seed, a, b in zip(seeds, together, alone, strict=True)
    }
    if len(seeds) > 2:
        found = {name: compare(*at_same_speeds(name, together, alone)) for name in NAMES}
        for figure in fields(Comparison):
            rows[figure.name.replace("_", " ")] = {name: getattr(found[name], figure.name) for name in NAMES}
    rows["Cramer-Rao of two runs, all samples"] = {name: least(name, alone[0]) for name in NAMES}
    rows["knots that both intervals explain"] = explained(together, alone)
    rows["truth - together"] = averaged([{n: to_truth(run.profile[n], n) for n in NAMES} for run in together])
    rows["truth - one by one"] = averaged([{n: to_truth(run.profile[n], n) for n in NAMES} for run in alone])
    rows["M found: largest error"] = averaged([inertia_error(run) for run in together])
    table(f"with the shipped noise, {len(seeds)} seeds, [V_1, V_N], percent", rows)


def at_same_speeds(name: str, *groups: list[Run]) -> list[Curves]:
    """A joint's curves of every run of each group over the measured range that all of them share."""
    curves = [[run.profile[name].curve() for run in group] for group in groups]
    ranges = [curve.measured_range_rad_s for group in curves for curve in group]
    speeds = np.linspace(max(low for low, _ in ranges), min(high for _, high in ranges), 400)
    return [np.array([curve.magnitude(speeds) for curve in group]) for group in curves]


def least(name: str, run: Run) -> float:
    """Least distance of two unbiased curves of this joint, percent of the mean."""
    samples = next(one for one in read(run.folder, None) if one.marks)
    (cycles,) = samples.marked("cycles")
    drive = JointModel.of(load_robot(ROBOT).file.joints[name], name).drive
    per_mille = math.hypot(drive.torque_noise_per_mille, drive.torque_quantum_per_mille / math.sqrt(12))
    curve = run.profile[name].curve()
    apart_nm = least_apart(
        procedure_of(cycles),
        float(np.median(np.diff(samples.time_s))),
        np.array(curve.velocity_rad_s),
        per_mille * 1e-3 * drive.rated_torque_nm,
    )
    return 100 * apart_nm / curve_mean(curve, *curve.measured_range_rad_s)


def explained(together: list[Run], alone: list[Run]) -> dict[str, float]:
    """Share of the knots where a pair's difference is within the root sum of squares of both intervals."""
    shares: dict[str, list[float]] = {name: [] for name in NAMES}
    for k, run in enumerate(together):
        for name in NAMES:
            for other in alone[:k] + alone[k + 1 :]:
                first, second = run.profile[name], other.profile[name]
                gap = np.abs(first.curve().magnitude(np.array(second.velocity_rad_s)) - np.array(second.torque_nm))
                shares[name].append(float(np.mean(gap <= np.hypot(half_widths(first), half_widths(second)))))
    return {name: float(np.mean(values)) for name, values in shares.items()}


def half_widths(profile: JointProfile) -> Array:
    assert profile.torque_interval_nm is not None
    return np.diff(np.array(profile.torque_interval_nm), axis=1)[:, 0] / 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--rate", type=float, help="Hz; the robot file's unless told")
    parser.add_argument("--fd", type=int, help="CAN FD, data at so many bit/s")
    parser.add_argument("--out", type=Path, help="keep the runs here, and go on with those that are there")
    options = parser.parse_args()
    seeds = [int(seed) for seed in options.seeds.split(",")]
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        robot = on_wire(folder, options.rate, options.fd)
        noiseless(folder, robot)
        noisy(folder, seeds, robot)
        highest_rates_hz()


if __name__ == "__main__":
    main()
