"""The whole arm around the joints that move: it is verified, gets power, is locked, and is brought to rest again."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Move
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback, JointState
from frictid_hil.protocol.error_words import told_error
from frictid_hil.runner.care import Care
from frictid_hil.runner.cycle import CyclicLoop
from frictid_hil.runner.motions import AT_RAD, stream
from frictid_hil.runner.unit_proof import UnitProof
from frictid_hil.units import degrees, format_angle

_POWER_TIMEOUT_S = 15.0
_STANDSTILL_S = 0.2
STOPPING_S = 0.3
DISABLING_S = 0.1


@dataclass(frozen=True)
class Arm:
    """All joints of one stretch of cyclic traffic; ``SafetyAbort`` names the joint that is not as it must be."""

    joints: Sequence[JointSetup]  # in the order of set-points and reports
    loop: CyclicLoop
    care: Care

    def verify(self, planned_rad: Mapping[str, float]) -> None:
        """Check, before anything gets power, that every joint is where it should be and the interlock is closed."""
        loop = self.loop
        loop.wait_for(lambda feedback: all(report.valid for report in feedback), 1.0, "a first report of every joint")
        verify_reference(self.joints, loop.feedback, planned_rad, self.care.reference_tolerance_rad)
        self._aim_where_it_stands()
        self._verify_interlock()

    def enable(self) -> None:
        """Give power to every joint; each one is held where it stands."""
        self._settling()
        for joint in self.joints:
            self.loop.driver.enable(joint.name, Mode.POSITION)
        self.loop.wait_for(
            lambda feedback: all(report.state is JointState.ENABLED or report.error_code for report in feedback),
            _POWER_TIMEOUT_S,
            "power on every joint",
        )
        for joint, report in zip(self.joints, self.loop.feedback, strict=True):
            if report.error_code or report.state is not JointState.ENABLED:
                raise SafetyAbort(
                    f"could not be enabled: state {report.state.value}, error {told_error(report.error_code)}",
                    where=f"joint {joint.name}",
                    next_step="clear the cause of the fault, then `frictid-hil reset`",
                )
        # The bumpless set-point is where the drive stood when it was enabled.
        self._aim_where_it_stands()
        self._settling()

    def prove_units(
        self, moving: Collection[int], planned_rad: Mapping[str, float], resolution_rad: Mapping[str, float]
    ) -> None:
        """Move each joint of the plan by a few encoder steps and by 0.5 deg while all others are locked."""
        loop = self.loop
        for index, joint in enumerate(self.joints):
            here_rad = loop.set_points[index].position_rad
            if index not in moving and abs(planned_rad.get(joint.name, here_rad) - here_rad) <= AT_RAD:
                continue
            self.loop.supervisor.watch(index, Mode.POSITION, self._lock([index]))
            resolution, droop = resolution_rad.get(joint.name, math.nan), self.care.droop_of(joint.name)
            loop.run({index: UnitProof(joint, here_rad, resolution, droop, loop.period_s)})

    def lock_all_but(self, moving: Collection[int], planned_rad: Mapping[str, float]) -> None:
        """Bring every other joint to its planned place, lock it there, and wait until all of them stand."""
        # Joints that are near, but not at, their planned locked position are brought there one by one.
        for index, joint in enumerate(self.joints):
            target_rad = planned_rad.get(joint.name)
            here_rad = self.loop.set_points[index].position_rad
            if index not in moving and target_rad is not None and abs(target_rad - here_rad) > AT_RAD:
                self.loop.supervisor.watch(index, Mode.POSITION, self._lock([index]))
                approach = Move.within(here_rad, target_rad, self.care.approach_rad_s, name="approach")
                stream(self.loop, index, approach)
        locked_at = self._lock(moving)
        self._settling()
        self._see_standstill()
        self.loop.supervisor.watch(list(moving), Mode.POSITION, locked_at)

    def power_off(self) -> None:
        """Switch off the power of every joint, and wait until the drives report it."""
        self._settling()
        for joint in self.joints:
            self.loop.driver.unlock(joint.name)
            self.loop.driver.disable(joint.name)
        self.loop.wait_for(
            lambda feedback: all(report.state is JointState.DISABLED for report in feedback),
            _POWER_TIMEOUT_S,
            "power off on every joint",
        )

    def stop(self) -> None:
        """Stop quickly, cycle until the drives have followed, switch off. The error that led here is never hidden."""
        loop = self.loop
        self.loop.driver.quick_stop()
        try:
            loop.settle(STOPPING_S)
            for joint in self.joints:
                self.loop.driver.disable(joint.name)
            loop.settle(DISABLING_S)
        except Exception:  # whatever it is, it is not what the person must hear of
            # The wire itself failed: the drives' own watchdogs finish what the quick stop began.
            self.loop.driver.quick_stop()

    def _aim_where_it_stands(self) -> None:
        for set_point, report in zip(self.loop.set_points, self.loop.feedback, strict=True):
            set_point.position_rad = report.position_rad

    def _verify_interlock(self) -> None:
        """The interlock must be closed now, and is watched in every cycle from here on."""
        interlock = self.care.interlock
        if interlock is None:
            return
        index = next(index for index, joint in enumerate(self.joints) if joint.name == interlock.joint)
        self.loop.wait_for(
            lambda feedback: feedback[index].digital_inputs is not None, 1.0, f"the inputs of joint {interlock.joint}"
        )
        self.loop.supervisor.arm_interlock(self.loop.feedback)

    def _settling(self) -> None:
        """Watch all joints as ones that must stand near their set-points, with or without power."""
        at_rad = {index: set_point.position_rad for index, set_point in enumerate(self.loop.set_points)}
        self.loop.supervisor.watch(None, Mode.POSITION, {}, at_rad)

    def _lock(self, moving: Collection[int]) -> dict[int, float]:
        """Lock all joints but these; returns where each of them is locked, by index."""
        locked_at: dict[int, float] = {}
        for index, joint in enumerate(self.joints):
            if index in moving:
                self.loop.driver.unlock(joint.name)
            else:
                self.loop.driver.lock(joint.name)
                locked_at[index] = self.loop.set_points[index].position_rad
        return locked_at

    def _see_standstill(self) -> None:
        loop, care = self.loop, self.care
        need = max(2, round(_STANDSTILL_S / loop.period_s))
        bounds_rad = [care.still_of(joint.name) for joint in self.joints]
        still = 0

        def standing(feedback: Sequence[Feedback]) -> bool:
            nonlocal still
            quiet = all(
                abs(report.position_rad - set_point.position_rad) <= still_rad
                and abs(report.velocity_rad_s if math.isfinite(report.velocity_rad_s) else 0.0) <= care.still_rad_s
                for report, set_point, still_rad in zip(feedback, loop.set_points, bounds_rad, strict=True)
            )
            still = still + 1 if quiet else 0
            return still >= need

        loop.wait_for(standing, 2.0 + _STANDSTILL_S, "standstill of every locked joint")


def verify_reference(
    joints: Sequence[JointSetup],  # in the order of the reports
    reports: Sequence[Feedback],  # valid
    # Where joints are to be locked, by name; others are expected at their own locked position.
    planned_rad: Mapping[str, float],
    tolerance_rad: float,  # a joint further off has lost its reference, or was moved
) -> None:
    """Compare every joint's position with the plan and with its limits; ``SafetyAbort`` names the joint."""
    for joint, report in zip(joints, reports, strict=True):
        expected_rad = planned_rad.get(joint.name, joint.locked_position_rad)
        if not abs(report.position_rad - expected_rad) <= tolerance_rad:
            raise SafetyAbort(
                f"stands at {degrees(report.position_rad):.2f} deg, expected {degrees(expected_rad):.2f} deg "
                f"(within {format_angle(tolerance_rad)})",
                where=f"joint {joint.name}",
                cause="the position reference is lost, or the arm was moved",
                next_step="home the robot or bring the joint to its locked_position_rad, then start again",
            )
        if not joint.position_min_rad <= report.position_rad <= joint.position_max_rad:
            raise SafetyAbort(
                f"stands at {degrees(report.position_rad):.2f} deg, outside its limits", where=f"joint {joint.name}"
            )
