"""A driver for ODrive's CANSimple as an outsider would write it: from the guide for authors, public names only.

Identifier: node << 5 | command; little endian, revolutions and N m of the motor. 07 state (1 idle, 8 closed loop), 0B
control mode, 0C position, 0D velocity, 0E torque; told are 01 heartbeat, 09 position and velocity, 1C torques.
"""

import contextlib
import math
import struct

import frictid_hil.protocol.driver as api
from frictid_hil.errors import FrictidError, HardwareError, PlanRefused
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.can_cycle import CanCycle
from frictid_hil.protocol.can_line import CanLine
from frictid_hil.protocol.rows import Command, Report, RowDecoder, RowLog
from frictid_hil.protocol.wishes import Do, Wish

schema = "odrive-frames/1"
IDLE, CLOSED_LOOP = 1, 8
CONTROL = {Mode.TORQUE: 1, Mode.VELOCITY: 2, Mode.POSITION: 3}


class Reader:
    def __init__(self, joints):
        self.joints = joints  # node and rad of the joint per motor revolution, signed
        self.feedback, self.modes = [api.Feedback() for _ in joints], [Mode.NONE for _ in joints]

    def decode(self, can_id, data):
        for at, (node, rad) in enumerate(self.joints):
            command, report, figures = can_id & 0x1F, self.feedback[at], struct.unpack("<ff", data.ljust(8, b"\0")[:8])
            if can_id >> 5 != node or len(data) not in (4, 8):
                continue
            if command == 0x01:
                report.error_code, on = int.from_bytes(data[:4], "little"), data[4] == CLOSED_LOOP
                states = api.JointState.DISABLED, api.JointState.ENABLED
                report.state = api.JointState.FAULT if report.error_code else states[on]
            elif command == 0x09:
                report.position_rad, report.velocity_rad_s = (figure * rad for figure in figures)
            elif command == 0x1C:
                report.torque_nm, report.mode = figures[1] * math.tau / rad, self.modes[at]
                return Report(at)
            elif command in (0x07, 0x0B, 0x0C, 0x0D, 0x0E):
                if command == 0x0B:
                    self.modes[at] = {value: mode for mode, value in CONTROL.items()}.get(data[0], Mode.NONE)
                return Command(at, figures[0] * rad if command == 0x0C else math.nan)
        return None


def decoder(frame_map):
    reader = Reader([tuple(joint) for joint in frame_map["joints"].values()])
    return RowLog(RowDecoder(reader.feedback, reader.decode))


def _wished(name):
    return lambda self, joint: getattr(self.cycle.wish(joint), name)()


class Driver:
    disable, lock, unlock = map(_wished, ("disable", "lock", "unlock"))
    kind = api.DriverKind(line="can", addressed_by="node", addresses=(0, 63))

    def __init__(self, setup, *, bus_factory=None, clock=None):
        self.setup, self.clock, self.bus_factory = setup, clock or api.WallClock(), bus_factory
        self.joints = [(joint.address, joint.direction * math.tau / joint.gear_ratio) for joint in setup.joints]
        self.line = self.cycle = None

    def open(self, frame_sink=None):
        self.line = CanLine(self.setup.bus, self.setup.options, frame_sink, self.clock, self.bus_factory)
        try:
            self.configure(self.setup.cycle_hz, [])
            if not all(report.valid for report in self.exchange([api.SetPoint() for _ in self.setup.joints])):
                raise HardwareError("not every joint answers", where=self.setup.bus, next_step="check ids and supply")
        except BaseException:
            self.close()
            raise

    def identify(self):
        worth = {"position_resolution_rad": 1e-6, "torque_resolution_nm": 1e-4, "torque_source": "current x constant"}
        return {joint.name: api.JointIdentity(joint.name, **worth) for joint in self.setup.joints}

    def capabilities(self):
        most_hz = self.line.highest_rate_hz([(0, 8)] * 4 * len(self.joints))
        torque = [Mode.TORQUE] if self.setup.options.get("allow_torque_without_watchdog") else []
        return api.Capabilities(most_hz, frozenset([Mode.POSITION, *torque]), lock_step=self.clock.lock_step)

    def check(self, plan):
        most_hz, asked_hz = self.capabilities().max_cycle_hz, plan.cycle_hz if plan else self.setup.cycle_hz
        fits = api.Severity.OK if asked_hz <= most_hz else api.Severity.ERROR
        return [api.Finding(fits, "bus load", f"at most {most_hz:g} Hz, {asked_hz:g} Hz asked")]

    def configure(self, cycle_hz, active):
        if cycle_hz > self.capabilities().max_cycle_hz:
            raise PlanRefused(f"at most {self.capabilities().max_cycle_hz:g} Hz", where="bus load")
        self.reader = Reader(self.joints)
        self.wishes = list(map(Wish, self.setup.joints, self.reader.feedback))
        rows = RowDecoder(self.reader.feedback, self.reader.decode)
        self.cycle = CanCycle(self.line, self.clock, rows, self.wishes, self.frame, cycle_hz)

    def frame(self, at, order):
        (node, rad), mode = self.joints[at], self.reader.modes[at]
        wanted = {Do.BRAKE: Mode.VELOCITY, Do.FOLLOW: order.mode}.get(order.do, self.wishes[at].mode)
        if order.do is not Do.REST and mode is not wanted:
            return node << 5 | 0x0B, struct.pack("<II", CONTROL[wanted], 1)
        if order.do in (Do.REST, Do.SWITCH_ON):
            return node << 5 | 0x07, struct.pack("<I", IDLE if order.do is Do.REST else CLOSED_LOOP)
        if order.do is Do.BRAKE:
            return node << 5 | 0x0D, bytes(8)
        torque = order.torque_nm * rad / math.tau
        if wanted is Mode.TORQUE:
            return node << 5 | 0x0E, struct.pack("<f", torque)
        forward = [max(-32768, min(32767, round(value * 1e3))) for value in (order.velocity_rad_s / rad, torque)]
        return node << 5 | 0x0C, struct.pack("<fhh", order.position_rad / rad, *forward)

    def set_limits(self, joint, *, torque_nm, position_min_rad, position_max_rad):
        self.cycle.wish(joint).limit(torque_nm, position_min_rad, position_max_rad)

    def frame_map_values(self):
        return {"schema": schema, "joints": {j.name: self.joints[at] for at, j in enumerate(self.setup.joints)}}

    def start_cycling(self):
        getattr(self.clock, "restart", lambda: None)()

    def enable(self, joint, mode):
        if mode not in self.capabilities().modes:
            raise HardwareError(f"no mode {mode.name}", where=f"joint {joint}")
        self.cycle.wish(joint).enable(mode)

    def exchange(self, set_points):
        if self.cycle is None:
            raise HardwareError("not open")
        return self.cycle.exchange(set_points)

    def quick_stop(self):
        if self.cycle is not None:
            self.cycle.quick_stop()

    def stop_cycling(self):
        cycle, self.cycle = self.cycle, None
        if cycle is not None:
            cycle.stop()

    def close(self):
        if self.line is None:
            return
        self.quick_stop()
        with contextlib.suppress(FrictidError):
            self.stop_cycling()
        self.line.close()
        self.line = None
