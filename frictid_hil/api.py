"""The product from Python: what ``import frictid_hil as fh`` offers to a notebook or a script.

::

    result = fh.calibrate("hp3j.yaml", joints=["3"])     # the simulated robot: nobody is asked
    friction = result.profile.joint("3")
    friction(np.array([-1.0, 1.0]))                      # N m at -1 and 1 rad/s
    fh.plot(result.profile)

The functions call the same jobs as the command line and return their values. Angles are in rad, torques in N m.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictid_hil.config.profile import FrictionProfile, JointProfile, profile_file
from frictid_hil.config.profile import load_profile as _load_profile
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import UsageError
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.jobs.calibrate import Calibrated, CalibrateOptions
from frictid_hil.jobs.calibrate import calibrate as _calibrate
from frictid_hil.jobs.identify import IdentifyOptions, identified_profile
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import Plan
from frictid_hil.recording.read import read as load_recording
from frictid_hil.runner.events import Preflight

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["calibrate", "diagnose", "identify", "load_profile", "load_recording", "load_robot", "plot"]

Confirm = Callable[[Plan], bool]
"""Is given the plan before anything moves; only True lets it move."""


class _Asking(Silent):
    """Asks the caller's function in the place of a person on a terminal."""

    def __init__(self, confirm: Confirm | None) -> None:
        self._confirm = confirm

    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        """What the caller's function says."""
        return self._confirm is None or self._confirm(plan) is True


def calibrate(
    robot: str | Path | Robot,
    *,
    joints: Sequence[str] = (),
    bus: str | None = None,
    confirm: Confirm | None = None,
    out: str | Path | None = None,
    **options: Any,
) -> Calibrated:
    """Run the procedure, each joint in turn, and identify its friction.

    Args:
        robot: robot file, by path or name, or one that was loaded.
        joints: names; all when empty.
        bus: ``interface:channel`` instead of the file's own.
        confirm: is given the plan and says whether the cell is clear; required where a real robot moves.
        out: run folder; a new one below ``runs/`` when None.
        **options: further fields of ``jobs.calibrate.CalibrateOptions`` (``amplitude_rad``, ``velocity_rad_s``,
            ``cycles``, ``method``, ``program``, ``seed``, ...).

    Raises:
        UsageError: refused before anything moved; also a real robot without ``confirm``.
        HardwareError: hardware unreachable.

    Returns:
        ``profile``, ``joints`` with every figure, and ``ended``; an ending by gate, stop or interruption is told there.
    """
    loaded = robot if isinstance(robot, Robot) else load_robot(robot)
    if confirm is None and not loaded.kind(bus).simulated:
        raise UsageError(
            f"{loaded.name} is a real robot on {bus or loaded.file.bus}, and nobody is asked before it moves",
            next_step="confirm=lambda plan: input(f'{plan} - is the cell clear? ') == 'yes'",
        )
    asked = CalibrateOptions(
        robot=str(loaded.path), joints=tuple(joints), bus=bus, out=None if out is None else Path(out), **options
    )
    return _calibrate(asked, _Asking(confirm))


def identify(
    log: str | Path, *, robot: str | Path | None = None, joints: Sequence[str] = (), **options: Any
) -> FrictionProfile:
    """Identify friction from one recording: a run folder, MCAP, CSV, .mat, ROS bag or bus log.

    A robot file tells limits and gear; all joints are identified when none is named. Further options are fields of
    ``jobs.identify.IdentifyOptions`` (``columns``, ``method``, ...).

    Raises:
        InputFileError: it is unreadable or unusable.
        IdentificationError: it gives no curve.
    """
    robot_file = None if robot is None else str(robot)
    return identified_profile(IdentifyOptions((Path(log),), robot=robot_file, joints=tuple(joints), **options))


def load_profile(path: str | Path) -> FrictionProfile:
    """A profile from its file, or from the folder of the run that wrote it.

    Raises:
        ConfigError: unreadable or wrong; every problem with file:line:column.
    """
    return _load_profile(profile_file(Path(path)))


def diagnose(*paths: str | Path, nominal: str | Path | None = None, **options: Any) -> Diagnosis:
    """Where a simulator differs from recordings of the machine, which effect causes it, and how far it closes.

    Paths are an experiment set's folder, or logs; ``nominal`` is what the simulator believes, unless a set says it.
    Further options are fields of ``jobs.gap.logs.Source`` (``columns``, ``profile``, ``joint``, ``validation``).

    Raises:
        InputFileError, ConfigError: the recordings are unusable.
    """
    from frictid_hil.gap.diagnose import diagnose as find_causes
    from frictid_hil.jobs.gap.logs import Source

    source = Source([Path(path) for path in paths], nominal=None if nominal is None else Path(nominal), **options)
    return find_causes(source.load())


def plot(profile: FrictionProfile | JointProfile) -> Figure:
    """Friction over speed with its intervals, a panel per joint; needs matplotlib (``frictid-hil[notebook]``).

    Returns:
        A matplotlib figure; a notebook shows it.
    """
    from matplotlib.figure import Figure

    joints = profile.joints if isinstance(profile, FrictionProfile) else {"": profile}
    columns = min(3, len(joints))
    rows = -(-len(joints) // columns)
    figure = Figure(figsize=(4.0 * columns, 3.0 * rows), layout="constrained")
    for number, (name, joint) in enumerate(joints.items(), start=1):
        axes = figure.add_subplot(rows, columns, number, title=f"joint {name}" if name else "")
        known, torque = np.array(joint.velocity_rad_s), np.array(joint.torque_nm)
        speeds = np.linspace(0.0, known[-1] * 1.05, 200)[1:]
        axes.plot(speeds, joint(speeds), linestyle=":", color="C0")
        axes.plot(known, torque, marker="o", color="C0")
        if joint.torque_interval_nm is not None:
            low, high = np.array(joint.torque_interval_nm).T
            axes.fill_between(known, low, high, alpha=0.25, color="C0")
        axes.set(xlabel="speed [m/s]" if joint.prismatic else "speed [rad/s]", ylim=(0, None))
        axes.set_ylabel("friction [N]" if joint.prismatic else "friction [N m]")
    return figure
