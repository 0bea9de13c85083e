"""A driver for moteus controllers as an outsider would write it: from the guide for authors, public names only.

CAN FD, identifier source << 8 | destination, 8000h more where an answer is wanted. Subframes write (0Ch), read (1Ch)
and reply (2Ch) floats, int8 with 0Ch less; revolutions, Hz and N m at the output shaft. A stop clears faults.
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

schema, LONG = "moteus-frames/1", api.EXTENDED | api.FD_FRAME
STOPPED, FAULT, POSITION, TIMEOUT, BRAKE = 0, 1, 10, 11, 15
WATCHDOG_S, COMMAND_BYTES, REPLY_BYTES = 0.1, 48, 24  # each command counts for so long
QUERY = bytes([0x1C, 4, 0x00, 0x13, 0x0D])  # mode, position, velocity, torque as floats; voltage, temperature, fault


class Reader:
    def __init__(self, joints):
        self.joints = joints  # (id, direction) of each
        self.feedback, self.modes = [api.Feedback() for _ in joints], [Mode.NONE for _ in joints]

    def decode(self, can_id, data):
        for at, (address, direction) in enumerate(self.joints):
            if can_id & 0xFFFF == 0x8000 | address and data[:2] == b"\x01\x00":
                position, _, _, kp = struct.unpack_from("<4f", data, 6) if data[2] == POSITION else [math.nan] * 4
                self.modes[at] = Mode.POSITION if kp else Mode.TORQUE
                return Command(at, direction * math.tau * position)
            if can_id & 0xFFFF == address << 8 and len(data) == REPLY_BYTES and data[:3] == b"\x2c\x04\x00":
                mode, position, velocity, torque = struct.unpack_from("<4f", data, 3)
                report, on = self.feedback[at], mode not in (STOPPED, FAULT, TIMEOUT)
                turn, failed = direction * math.tau, mode in (FAULT, TIMEOUT)
                report.position_rad, report.velocity_rad_s = turn * position, turn * velocity
                report.torque_nm, report.temperature_c = direction * torque, float(data[22])
                report.state = api.JointState.FAULT if failed else [api.JointState.DISABLED, api.JointState.ENABLED][on]
                report.mode, report.error_code = self.modes[at] if on else Mode.NONE, (data[23] or TIMEOUT) * failed
                return Report(at)
        return None


def decoder(frame_map):
    reader = Reader(list(frame_map["joints"].values()))
    return RowLog(RowDecoder(reader.feedback, reader.decode))


def _wished(name):
    return lambda self, joint: getattr(self.cycle.wish(joint), name)()


class Driver:
    disable, lock, unlock = map(_wished, ("disable", "lock", "unlock"))
    kind = api.DriverKind(line="can", addressed_by="id", addresses=(1, 127))

    def __init__(self, setup, *, bus_factory=None, clock=None):
        self.setup, self.clock, self.bus_factory = setup, clock or api.WallClock(), bus_factory
        self.limits = [joint.max_torque_nm for joint in setup.joints]
        self.line = self.cycle = None

    def open(self, frame_sink=None):
        options = {"fd": True, "data_bitrate": 5_000_000, **self.setup.options}
        self.line = CanLine(self.setup.bus, options, frame_sink, self.clock, self.bus_factory)
        try:
            self.configure(self.setup.cycle_hz, [])
            if not all(report.valid for report in self.exchange([api.SetPoint() for _ in self.setup.joints])):
                raise HardwareError("not every joint answers", where=self.setup.bus, next_step="check ids and supply")
        except BaseException:
            self.close()
            raise

    def identify(self):
        worth = {"position_resolution_rad": 1e-6, "torque_resolution_nm": 1e-4, "torque_source": "motor current x Kt"}
        return {joint.name: api.JointIdentity(joint.name, **worth) for joint in self.setup.joints}

    def capabilities(self):
        frames = [(LONG, COMMAND_BYTES), (LONG, REPLY_BYTES)] * len(self.setup.joints)
        modes, most_hz = frozenset({Mode.POSITION, Mode.TORQUE}), self.line.highest_rate_hz(frames)
        more = {"droop_rad": {joint.name: joint.options.get("droop_rad", 0.02) for joint in self.setup.joints}}
        return api.Capabilities(most_hz, modes, True, True, lock_step=self.clock.lock_step, **more)

    def check(self, plan):
        most_hz, asked_hz = self.capabilities().max_cycle_hz, (plan or self.setup).cycle_hz
        bad = api.Severity.OK if asked_hz <= most_hz else api.Severity.ERROR
        return [api.Finding(bad, "bus load", f"at most {most_hz:g} Hz, {asked_hz:g} Hz asked")]

    def configure(self, cycle_hz, active):
        if cycle_hz > self.capabilities().max_cycle_hz:
            raise PlanRefused(f"at most {self.capabilities().max_cycle_hz:g} Hz", where="bus load")
        reader = Reader(list(self.frame_map_values()["joints"].values()))
        self.wishes = list(map(Wish, self.setup.joints, reader.feedback))
        rows = RowDecoder(reader.feedback, reader.decode)
        self.cycle = CanCycle(self.line, self.clock, rows, self.wishes, self.frame, cycle_hz)

    def frame(self, at, order):
        joint, told = self.setup.joints[at], b"\x01\x00" + bytes([BRAKE if order.do is Do.BRAKE else STOPPED])
        if order.do in (Do.SWITCH_ON, Do.FOLLOW) and self.wishes[at].feedback.state is not api.JointState.FAULT:
            position, velocity, torque, gain = math.nan, 0.0, 0.0, 1.0  # no number: where it stands
            if order.do is Do.FOLLOW:
                torque, gain = joint.direction * order.torque_nm, float(order.mode is Mode.POSITION)
                position, velocity = (
                    joint.direction * v / math.tau for v in (order.position_rad, order.velocity_rad_s)
                )
            figures = struct.pack("<6f", position, velocity, torque, gain, gain, self.limits[at])
            last = struct.pack("<2sf2sf", b"\x0d\x27", WATCHDOG_S, b"\x0d\x2b", gain)
            told = b"\x01\x00\x0a\x0c\x06\x20" + figures + last
        return LONG | 0x8000 | joint.address, (told + QUERY).ljust(COMMAND_BYTES, b"\x50")

    def set_limits(self, joint, *, torque_nm, position_min_rad, position_max_rad):
        self.limits[[one.name for one in self.setup.joints].index(joint)] = torque_nm
        self.cycle.wish(joint).limit(torque_nm, position_min_rad, position_max_rad)

    def frame_map_values(self):
        return {"schema": schema, "joints": {j.name: [j.address, j.direction] for j in self.setup.joints}}

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
