"""The drives of one simulated arm: their axes move on together, because what one link does the others feel.

Each drive still looks at its joint only when something happens to it; whoever looks first brings all of them to now.
"""

from __future__ import annotations

from collections.abc import Sequence

from frictid_drivers.virtual.axis import Axis
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.simulation.arm import ArmLoop
from frictid_hil.simulation.arm_model import ArmModel
from frictid_hil.simulation.servo_loop import ServoLoop

_NS = 1e-9


def couple(model: ArmModel, plants: Sequence[ServoLoop], axes: Sequence[Axis]) -> None:
    """Put joints that stood alone on one arm; plants and axes are in the order of its joints."""
    arm = ArmLoop(model, plants)

    def advance(now_ns: int) -> None:
        end_ns = min(axis.unbroken_until_ns(now_ns) for axis in axes)
        arm.advance((end_ns - axes[0].now_ns) * _NS, [axis.command_until(end_ns) for axis in axes])
        for axis in axes:
            axis.arrive(end_ns)
            axis.supervise()

    for axis in axes:
        axis.company = advance


def arm_of(setup: RobotSetup) -> ArmModel | None:
    """The simulated arm of a robot file, None where it has none.

    Raises:
        InvalidFields: what is wrong with it, by ``simulated_arm.KEY``.
    """
    if not setup.simulated_arm:
        return None
    try:
        return ArmModel.from_mapping(setup.simulated_arm, {joint.name: joint.dh for joint in setup.joints})
    except InvalidFields as error:
        raise InvalidFields([FieldProblem(("simulated_arm", *p.path), p.message) for p in error.problems]) from None
