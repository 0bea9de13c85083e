"""All drives of a robot on one bus, and their run time.

A frame goes in by ``process``, time goes on by ``advance``; whatever the drives say comes out by ``transmit``. The rack
knows no wall clock and no threads: the same calls give the same frames, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from frictid_drivers.virtual.axis import Axis
from frictid_drivers.virtual.devices import plant_for
from frictid_drivers.virtual.joint_drive import servo_for
from frictid_drivers.virtual.pdo import NEVER_NS
from frictid_drivers.virtual.servo import Servo
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.simulation.arm import ArmLoop
from frictid_hil.simulation.arm_model import ArmModel
from frictid_hil.simulation.servo_loop import ServoLoop

Transmit = Callable[[int, bytes], None]
Handler = Callable[[bytes, int], None]

SYNC_GAP_TENTHS = 20  # 2010h:01 in lock-step: drives alarm when a SYNC is more than twice its period late

_WARM_UP_NS = 1_000_000


class Rack:
    """The drives of one robot; empty until ``add`` or ``install``."""

    def __init__(self) -> None:
        # Where the drives' frames go; set by whoever owns the bus.
        self.transmit: Transmit = lambda can_id, data: None  # no bus yet
        self.now_ns = 0  # run time
        self.servos: dict[str, Servo] = {}  # by joint name, in the order of the robot file
        self.next_event_ns = NEVER_NS  # when something falls due by itself
        self._routes: dict[int, list[Handler]] | None = None

    def install(
        self,
        setup: RobotSetup,
        *,
        missing: Mapping[str, frozenset[int]] | None = None,  # indices of objects that drives do not have, by joint
        sync_gap_tenths: int = SYNC_GAP_TENTHS,  # longest tolerated gap between SYNCs, in tenths of the period
    ) -> None:
        """Build the drives of a robot file in; they have no power yet.

        ``InvalidFields`` where a joint's ``simulated`` mapping, or ``simulated_arm``, is wrong; ``ConfigError`` without
        the library that a simulated arm needs.
        """
        arm = arm_of(setup)
        plants = [plant_for(setup, joint) for joint in setup.joints]
        for joint, plant in zip(setup.joints, plants, strict=True):
            absent = (missing or {}).get(joint.name, frozenset())
            servo = servo_for(setup, joint, plant, self.send, missing=absent, sync_gap_tenths=sync_gap_tenths)
            self.add(joint.name, servo)
        if arm is not None:
            couple(arm, plants, [servo.axis for servo in self.servos.values()])

    def add(self, name: str, servo: Servo) -> None:
        """Connect a drive."""
        servo.wake = self._wake
        servo.routes_changed = self._drop_routes
        self.servos[name] = servo
        self._routes = None

    def send(self, can_id: int, data: bytes) -> None:
        """A drive puts a frame on the bus."""
        self.transmit(can_id, data)

    def power_on(self) -> None:
        """All drives boot."""
        for servo in self.servos.values():
            servo.boot(self.now_ns)

    def process(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        """A frame with an 11-bit identifier (``FD_FRAME`` set: a CAN FD one) arrives at every drive, now."""
        if self._routes is None:
            self._routes = self._compiled_routes()
        if remote:
            for servo in self.servos.values():
                servo.receive_remote(can_id, self.now_ns)
            return
        now_ns = self.now_ns
        for handler in self._routes.get(can_id, ()):
            handler(data, now_ns)

    def advance(self, to_ns: int) -> None:
        """Let run time go on to ``to_ns``, everything that falls due on the way in its order."""
        while self.next_event_ns <= to_ns:
            self.now_ns = max(self.now_ns, self.next_event_ns)
            now_ns = self.now_ns
            self.next_event_ns = NEVER_NS
            for servo in self.servos.values():
                if servo.next_event_ns <= now_ns:
                    servo.on_time(now_ns)
            self.next_event_ns = min((servo.next_event_ns for servo in self.servos.values()), default=NEVER_NS)
        if to_ns > self.now_ns:
            self.now_ns = to_ns

    def warm_up(self) -> None:
        """Let every joint's physics run a little before power-on, so that nothing is compiled or loaded later."""
        self.now_ns += _WARM_UP_NS
        for servo in self.servos.values():
            servo.axis.catch_up(self.now_ns)

    @property
    def at_rest(self) -> bool:
        """No motor has power, or every powered one stands still."""
        return all(not servo.axis.powered or servo.axis.at_rest for servo in self.servos.values())

    def _wake(self, at_ns: int) -> None:
        self.next_event_ns = min(self.next_event_ns, at_ns)

    def _drop_routes(self) -> None:
        self._routes = None

    def _compiled_routes(self) -> dict[int, list[Handler]]:
        found: dict[int, list[Handler]] = {}
        for servo in self.servos.values():
            for can_id, handler in servo.routes().items():
                found.setdefault(can_id, []).append(handler)
        found[0x000] = [servo.receive_nmt for servo in self.servos.values()]
        return found


def couple(model: ArmModel, plants: Sequence[ServoLoop], axes: Sequence[Axis]) -> None:
    """Put joints on one arm, where what one link does the others feel: whoever looks at one first brings all to now."""
    arm = ArmLoop(model, plants)

    def advance(now_ns: int) -> None:
        end_ns = min(axis.unbroken_until_ns(now_ns) for axis in axes)
        arm.advance((end_ns - axes[0].now_ns) * 1e-9, [axis.command_until(end_ns) for axis in axes])
        for axis in axes:
            axis.arrive(end_ns)
            axis.supervise()

    for axis in axes:
        axis.company = advance


def arm_of(setup: RobotSetup) -> ArmModel | None:
    """The simulated arm of a robot file, None where it has none; ``InvalidFields`` by ``simulated_arm.KEY``."""
    if not setup.simulated_arm:
        return None
    try:
        return ArmModel.from_mapping(setup.simulated_arm, {joint.name: joint.dh for joint in setup.joints})
    except InvalidFields as error:
        raise InvalidFields([FieldProblem(("simulated_arm", *p.path), p.message) for p in error.problems]) from None
