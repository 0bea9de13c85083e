"""One simulated CiA-402 drive on the bus: NMT, heartbeat both ways, SYNC, SDO, PDO, EMCY and the power state machine.

Frames come in by the handlers that ``routes`` names, each with the run time of its arrival; frames go out by ``send``.
Everything that happens by itself - heartbeats, watchdogs, ramps, event timers - is a deadline in run time, served by
``on_time``; ``next_event_ns`` is never later than the earliest of them.

Written from the facts of CiA 301 and CiA 402 alone; it shares no code with the host driver.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import cast

from frictid_drivers.virtual import emergency
from frictid_drivers.virtual.axis import CSP, MODES, VELOCITY_UNITS, Axis, Plant
from frictid_drivers.virtual.emergency import Emergency
from frictid_drivers.virtual.object_dictionary import (
    CANNOT_STORE,
    DEVICE_STATE,
    INCOMPATIBLE,
    INVALID_VALUE,
    ObjectDictionary,
    SdoAbort,
    encode,
)
from frictid_drivers.virtual.objects import Key, Value, key
from frictid_drivers.virtual.pdo import NEVER_NS, ProcessData, ReceivePdo
from frictid_drivers.virtual.power_state import FAULT_RESET, HALT, PowerState, next_state
from frictid_drivers.virtual.sdo_server import SdoServer

INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F

_MS = 1_000_000
_SUPERVISION_NS = 10 * _MS
_RAMP_TICK_NS = 1 * _MS
_SAVE, _LOAD = 0x65766173, 0x64616F6C

_K6040, _K6041, _K6060, _K6061 = key(0x6040), key(0x6041), key(0x6060), key(0x6061)
_K60FD, _K60FE = key(0x60FD), key(0x60FE, 1)
_INTERLOCK_CLOSED = 1 << 3
_BRAKE_ENGAGED = 1 << 16
_OUTPUT_BRAKE = 1 << 0

_POWERED = (PowerState.ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION)

Send = Callable[[int, bytes], None]


@dataclass(slots=True)
class _Consumer:
    """A heartbeat this node listens for (1016h); ``deadline_ns`` None until the first one came."""

    node: int
    timeout_ns: int
    deadline_ns: int | None = None
    lost: bool = False


class Servo:
    """One node.

    Args:
        node_id: 1 to 127.
        plant: the joint behind it.
        send: puts a frame on the bus.
        gear_ratio: motor revolutions per joint revolution, as built.
        increments_per_revolution: encoder increments per joint revolution, as built.
        direction: +1 or -1, sign of joint motion for positive motor motion.
        torque_step: smallest step of the reported torque, per mille.
        overrides: defaults of objects of this drive.
        missing: indices of objects that it does not have.
        hold_hand: called as (held, centre_rad, amplitude_rad, frequency_hz) when the simulated hand (2040h) changes.

    Attributes:
        next_event_ns: call ``on_time`` at this run time.
        wake: told when an earlier event appeared.
        routes_changed: told when COB-IDs changed.
    """

    def __init__(
        self,
        node_id: int,
        plant: Plant,
        send: Send,
        *,
        gear_ratio: float = 1.0,
        increments_per_revolution: float = 131_072.0,
        direction: int = 1,
        torque_step: int = 1,
        overrides: Mapping[Key, Value] | None = None,
        missing: Iterable[int] = (),
        hold_hand: Callable[[bool, float, float, float], None] | None = None,
    ) -> None:
        self.node_id = node_id
        self.dictionary = ObjectDictionary(node_id, overrides, missing=missing)
        self._values = cast("dict[Key, int]", self.dictionary.values)
        self._plant = plant
        self._send = send
        self._hold_hand = hold_hand
        self._now_ns = 0
        self.axis = Axis(
            self.dictionary,
            plant,
            gear_ratio=gear_ratio,
            increments_per_revolution=increments_per_revolution,
            direction=direction,
            torque_step=torque_step,
        )
        self.emergency = Emergency(self.dictionary, self._send_emergency)
        self.process_data = ProcessData(self.dictionary, send, self._pdo_changed)
        self._sdo = SdoServer(self.dictionary)
        self.nmt_state = INITIALISING
        self.state = PowerState.NOT_READY
        self.interlock_closed = True
        self.next_event_ns = NEVER_NS
        self.wake: Callable[[int], None] = _ignore
        self.routes_changed: Callable[[], None] = _do_nothing
        self._after_ramp: PowerState | None = None
        self._halted = False
        self._controlword = 0
        self._outputs = 0
        self._brake_blocked = False
        self._last_sync_ns: int | None = None
        self._heartbeat_ns = NEVER_NS
        self._consumers: list[_Consumer] = []
        self._sync_window_ns = 0
        self._sync_length = 0
        self._changed = False  # something that event-driven PDOs may carry, other than actual values
        self._guard_objects()
        plant.power(False)
        plant.brake(True)

    # -- frames --------------------------------------------------------------------------------------------------------

    def routes(self) -> dict[int, Callable[[bytes, int], None]]:
        """Who handles which COB-ID; NMT (000h) aside, which is ``receive_nmt``."""
        found: dict[int, Callable[[bytes, int], None]] = {}
        for pdo in reversed(self.process_data.receive):
            found[pdo.cob_id] = self._rpdo_handler(pdo)
        for consumer in self._consumers:
            found[0x700 + consumer.node] = self._heartbeat_handler(consumer)
        found[self._values[key(0x1005)] & 0x7FF] = self.receive_sync
        found[0x600 + self.node_id] = self.receive_sdo
        return found

    def receive_nmt(self, data: bytes, now_ns: int) -> None:
        """An NMT command for this node or all."""
        if len(data) < 2 or data[1] not in (0, self.node_id):
            return
        self._arrive(now_ns)
        command = data[0]
        if command == 0x01:
            self._enter(OPERATIONAL)
        elif command == 0x02:
            self._enter(STOPPED)
        elif command == 0x80:
            self._enter(PRE_OPERATIONAL)
        elif command == 0x81:
            self.reset(now_ns)
        elif command == 0x82:
            self._reset_communication()
        self._settle()

    def receive_sdo(self, data: bytes, now_ns: int) -> None:
        """An SDO request."""
        if self.nmt_state in (STOPPED, INITIALISING):
            return
        self._arrive(now_ns)
        reply = self._sdo.answer(data)
        if reply is not None:
            self._send(0x580 + self.node_id, reply)
        self._settle()

    def receive_sync(self, data: bytes, now_ns: int) -> None:
        """SYNC: report the values of this moment, then take over what was commanded for it."""
        if self.nmt_state != OPERATIONAL:
            return
        self._now_ns = now_ns
        if self._last_sync_ns is None:
            self._changed = True  # from here on SYNC is supervised
        self._last_sync_ns = now_ns
        if len(data) != self._sync_length:
            self.emergency.report(emergency.SYNC_LENGTH, len(data))
        process_data = self.process_data
        due = process_data.due_on_sync(data[0] if data else None)
        pending = process_data.pending
        if due or pending or process_data.live:
            self._run_to(now_ns)
            self._latch()
            process_data.send_due(due)
        if process_data.acyclic:
            self._latch()
            process_data.send_acyclic(now_ns)
        if pending:
            process_data.apply_pending()
            self._commanded()
        if self._changed or process_data.live:
            self._settle()

    def _rpdo_handler(self, pdo: ReceivePdo) -> Callable[[bytes, int], None]:
        size = pdo.layout.size
        process_data = self.process_data

        def receive(data: bytes, now_ns: int) -> None:
            if self.nmt_state != OPERATIONAL:
                return
            if len(data) < size:
                self._now_ns = now_ns
                self.emergency.report(emergency.PDO_TOO_SHORT, len(data))
            elif pdo.on_sync:
                pdo.pending = data
                process_data.pending = True
            else:
                self._arrive(now_ns)
                process_data.apply(pdo, data)
                self._commanded()
                self._settle()

        return receive

    def receive_remote(self, cob_id: int, now_ns: int) -> None:
        """A remote frame: TPDOs that allow it are sent."""
        self._arrive(now_ns)
        self.process_data.answer_remote(cob_id, now_ns)

    def _heartbeat_handler(self, consumer: _Consumer) -> Callable[[bytes, int], None]:
        def receive(data: bytes, now_ns: int) -> None:
            first = consumer.deadline_ns is None
            consumer.deadline_ns = now_ns + consumer.timeout_ns
            if consumer.lost:
                consumer.lost = False
                if self.state is not PowerState.FAULT and not any(other.lost for other in self._consumers):
                    self._now_ns = now_ns
                    self.emergency.clear(emergency.HEARTBEAT_LOST)
            if first:
                self._now_ns = max(self._now_ns, now_ns)
                self._schedule()

        return receive

    # -- time ----------------------------------------------------------------------------------------------------------

    def on_time(self, now_ns: int) -> None:
        """Do what is due at ``now_ns``."""
        self._now_ns = now_ns
        if now_ns >= self._heartbeat_ns:
            self._heartbeat_ns += self._values[key(0x1017)] * _MS
            self._send(0x700 + self.node_id, bytes([self.nmt_state]))
        for consumer in self._consumers:
            if consumer.deadline_ns is not None and now_ns >= consumer.deadline_ns:
                consumer.deadline_ns = None
                consumer.lost = True
                self._connection_lost(emergency.HEARTBEAT_LOST, consumer.node)
        if now_ns >= self._sync_deadline_ns():
            self._sync_lost()
        if self.axis.powered and now_ns - self.axis.now_ns >= self._tick_ns():
            self._run_to(now_ns)
            self._changed = self._changed or self.process_data.live
        if self._changed or now_ns >= self.process_data.next_timer_ns:
            self._run_to(now_ns)
            self._settle()
        else:
            self._schedule()

    def _tick_ns(self) -> int:
        return _RAMP_TICK_NS if self.axis.ramping else _SUPERVISION_NS

    def _sync_deadline_ns(self) -> int:
        supervised = (
            self._sync_window_ns
            and self._last_sync_ns is not None
            and self.state is PowerState.ENABLED
            and self.nmt_state == OPERATIONAL
            and emergency.SYNC_LOST not in self.emergency.present
        )
        # One nanosecond past the window: a gap of exactly twice the period is still on time.
        return (
            self._last_sync_ns + self._sync_window_ns + 1 if supervised and self._last_sync_ns is not None else NEVER_NS
        )

    def _schedule(self) -> None:
        due = min(self._heartbeat_ns, self._sync_deadline_ns(), self.process_data.next_timer_ns)
        for consumer in self._consumers:
            if consumer.deadline_ns is not None:
                due = min(due, consumer.deadline_ns)
        if self.axis.powered:
            due = min(due, self.axis.now_ns + self._tick_ns())
        self.next_event_ns = max(due, self._now_ns + 1)
        self.wake(self.next_event_ns)

    def _arrive(self, now_ns: int) -> None:
        """Something slow arrives: let physics catch up first, so that it acts from now on."""
        self._now_ns = now_ns
        self._run_to(now_ns)

    def _settle(self) -> None:
        """After anything out of the ordinary: tell the bus what changed, and when to come back."""
        self._changed = False
        if self.process_data.event_driven:
            self._latch()
            self.process_data.send_events(self._now_ns)
        self._schedule()

    def _run_to(self, now_ns: int) -> None:
        axis = self.axis
        axis.catch_up(now_ns)
        if axis.alarm:
            code, axis.alarm = axis.alarm, 0
            self.fault(code)
        if axis.ramping and axis.ramp_done:
            self._ramp_ended()

    # -- NMT -----------------------------------------------------------------------------------------------------------

    def boot(self, now_ns: int) -> None:
        """Power-on: initialise, say boot-up, wait in pre-operational."""
        self._now_ns = now_ns
        self.axis.catch_up(now_ns)
        self._power_off()
        self.dictionary.reset()
        self._sdo.reset()
        self.emergency.forget()
        self._controlword = 0
        self._outputs = 0
        self._halted = False
        self.axis.encoder_stuck = False
        self.axis.mode = 0
        self.axis.units_changed()
        self.state = PowerState.SWITCH_ON_DISABLED  # transitions 0 and 1
        self._restart_communication()
        self._settle()

    def reset(self, now_ns: int) -> None:
        """Reset node: as after power-on; a powered motor loses its power."""
        self.boot(now_ns)

    def _reset_communication(self) -> None:
        if self.state in _POWERED:
            self._connection_lost(emergency.CONNECTION_ABORTED, 0)
        self.dictionary.reset(0x1000, 0x1FFF)
        self._restart_communication()

    def _restart_communication(self) -> None:
        self.nmt_state = INITIALISING
        self._last_sync_ns = None
        self.process_data.stop()
        self._pdo_changed()
        self._communication_changed()
        self._send(0x700 + self.node_id, b"\0")
        self.nmt_state = PRE_OPERATIONAL
        self._heartbeat_changed()

    def _enter(self, state: int) -> None:
        if state == self.nmt_state:
            return
        was = self.nmt_state
        self.nmt_state = state
        if was == OPERATIONAL:
            self.process_data.stop()
            if self.state is PowerState.ENABLED:
                # Cyclic modes live on PDOs; leaving operational ends them like a broken connection.
                self._connection_lost(emergency.CONNECTION_ABORTED, state)
        if state == OPERATIONAL:
            self._last_sync_ns = None
            self._latch()
            self.process_data.start(self._now_ns)
            self.routes_changed()

    def _connection_lost(self, code: int, detail: int) -> None:
        """6007h and 1029h: what the drive does when its host is gone."""
        self.emergency.report(code, detail)
        self._run_to(self._now_ns)
        option = self._values.get(key(0x6007), 0)
        if option == 1:
            self.fault(code)
        elif option == 2:
            if self.state in _POWERED:
                self._go(PowerState.SWITCH_ON_DISABLED)
        elif option == 3 and self.state is PowerState.ENABLED:
            self._quick_stop()
        behaviour = self._values.get(key(0x1029, 1), 0)
        if code == emergency.HEARTBEAT_LOST and self.nmt_state == OPERATIONAL and behaviour != 1:
            self.nmt_state = PRE_OPERATIONAL if behaviour == 0 else STOPPED
            self.process_data.stop()

    def _sync_lost(self) -> None:
        self.emergency.report(emergency.SYNC_LOST)
        if self._values[key(0x2010, 2)] == 2:
            self._run_to(self._now_ns)
            self.fault(emergency.SYNC_LOST)

    def _send_emergency(self, data: bytes) -> None:
        self._changed = True
        if self.nmt_state in (OPERATIONAL, PRE_OPERATIONAL):
            self._send(self._values[key(0x1014)] & 0x7FF, data)

    def warn(self, code: int, now_ns: int) -> None:
        """The drive finds something wrong that does not stop it."""
        self._arrive(now_ns)
        self.emergency.report(code)
        self._settle()

    def fail(self, code: int, now_ns: int) -> None:
        """The drive finds something wrong that stops it."""
        self._arrive(now_ns)
        self.fault(code)
        self._settle()

    def block_brake(self, blocked: bool, now_ns: int) -> None:
        """The brake's coil breaks: it stays closed, whatever the drive says; or it is mended."""
        self._arrive(now_ns)
        self._brake_blocked = blocked
        self._apply_brake()

    # -- power state machine -------------------------------------------------------------------------------------------

    def fault(self, code: int) -> None:
        """Transition 13: something is wrong; the fault reaction (605Eh) runs where the motor has power."""
        self.emergency.report(code)
        if self.state in (PowerState.FAULT, PowerState.FAULT_REACTION):
            return
        option = self._values[key(0x605E)]
        if self.state in _POWERED and option and self.axis.powered:
            self.state = PowerState.FAULT_REACTION
            self._after_ramp = PowerState.FAULT
            self._ramp(option)
        else:
            self._power_off()
            self.state = PowerState.FAULT
        self._schedule()

    def _commanded(self) -> None:
        """Controlword, mode, outputs or set-points may have been written; physics has caught up."""
        values = self._values
        controlword = values[_K6040]
        if controlword != self._controlword:
            self._follow_controlword(controlword)
        mode = values[_K6060]
        if mode != values[_K6061] and (mode in MODES or mode == 0):
            values[_K6061] = mode
            self._changed = True
            self.axis.set_mode(mode)
        if values[_K60FE] != self._outputs:
            self._outputs = values[_K60FE]
            self._apply_brake()
        self.axis.take_set_points()

    def _follow_controlword(self, controlword: int) -> None:
        rising = controlword & ~self._controlword
        self._controlword = controlword
        self._changed = True
        if rising & FAULT_RESET:
            self._reset_fault()
        while (step := next_state(self.state, controlword)) is not None:
            transition, target = step
            if not self._may(transition):
                break
            before = self.state
            self._take(transition, target)
            if self.state is before:
                break
        if self.state is PowerState.ENABLED and self._after_ramp is None:
            self._follow_halt(bool(controlword & HALT))
        self._schedule()

    def _may(self, transition: int) -> bool:
        if transition in (4, 16) and any(consumer.lost for consumer in self._consumers):
            return False  # no power while the host's heartbeat is missing
        return not (transition == 16 and self._values[key(0x605A)] not in (5, 6, 7))

    def _take(self, transition: int, target: PowerState) -> None:
        if transition in (5, 8):
            # Leaving "enabled" in good order; the option says whether a ramp comes first.
            option = self._values[key(0x605C if transition == 5 else 0x605B)]
            if option and not self.axis.at_rest:
                self._after_ramp = target
                self._ramp(1)
                return
            self._go(target)
        elif transition == 11:
            self._quick_stop()
        elif transition == 4:
            self.state = target
            self._power_on()
        elif transition == 16:
            self.state = target
            self._after_ramp = None
            self.axis.resume()
        else:
            self._go(target)

    def _go(self, target: PowerState) -> None:
        """Enter a state without motor power."""
        if self.axis.powered:
            self._power_off()
        self.state = target
        self._schedule()

    def _quick_stop(self) -> None:
        option = self._values[key(0x605A)]
        if option == 0:
            self._go(PowerState.SWITCH_ON_DISABLED)
            return
        self.state = PowerState.QUICK_STOP_ACTIVE
        self._after_ramp = PowerState.SWITCH_ON_DISABLED if option < 5 else PowerState.QUICK_STOP_ACTIVE
        self._ramp(option if option < 5 else option - 4)
        self._schedule()

    def _ramp(self, option: int) -> None:
        """1: profile deceleration, 2: quick-stop deceleration, 3 and 4: as fast as the torque limit lets."""
        objects = {1: 0x6084, 2: 0x6085}
        self._halted = False
        self.axis.start_ramp(self._values[key(objects[option])] if option in objects else None)

    def _ramp_ended(self) -> None:
        self.axis.end_ramp()
        self._changed = True
        target, self._after_ramp = self._after_ramp, None
        if target in (None, PowerState.QUICK_STOP_ACTIVE):
            return  # halted, or held in quick-stop-active
        self._go(target)
        if target is PowerState.SWITCHED_ON or target is PowerState.READY:
            # What the controlword asked for meanwhile.
            self._controlword = ~self._values[_K6040] & FAULT_RESET
            self._follow_controlword(self._values[_K6040])

    def _follow_halt(self, halt: bool) -> None:
        if halt and not self._halted:
            self._ramp(self._values[key(0x605D)])
            self._halted = True
        elif not halt and self._halted:
            self._halted = False
            self.axis.resume()

    def _reset_fault(self) -> None:
        """Transition 15; in other states warnings are forgotten."""
        if self.state is PowerState.FAULT_REACTION:
            return
        if self.state is PowerState.FAULT:
            self.state = PowerState.SWITCH_ON_DISABLED
        missing = any(consumer.lost for consumer in self._consumers)
        for code in self.emergency.present:
            if not (missing and code == emergency.HEARTBEAT_LOST):
                self.emergency.clear(code)

    def _power_on(self) -> None:
        self._halted = False
        self._after_ramp = None
        self.axis.switch(True)
        self._apply_brake()
        self._schedule()

    def _power_off(self) -> None:
        self._after_ramp = None
        self._halted = False
        self.axis.switch(False)
        self._apply_brake()

    def _brake_wanted(self, powered: bool) -> bool:
        """The drive works the brake with its power, unless the host masked the output to work it itself."""
        if self._values.get(key(0x60FE, 2), 0) & _OUTPUT_BRAKE:
            return bool(self._values[_K60FE] & _OUTPUT_BRAKE)
        return not powered

    def _apply_brake(self) -> None:
        self._plant.brake(self._brake_blocked or self._brake_wanted(self.axis.powered))

    # -- readings ------------------------------------------------------------------------------------------------------

    def _latch(self) -> None:
        values = self._values
        self.axis.latch()
        inputs = _INTERLOCK_CLOSED if self.interlock_closed else 0
        if self._brake_wanted(self.axis.powered):
            inputs |= _BRAKE_ENGAGED
        status = self.statusword()
        if status != values[_K6041] or inputs != values[_K60FD]:
            values[_K6041], values[_K60FD] = status, inputs
            self._changed = True

    def statusword(self) -> int:
        """6041h."""
        axis = self.axis
        word = self.state.value | 0x0010  # voltage enabled
        if self.emergency.present and self.state is not PowerState.FAULT:
            word |= 0x0080
        if self.nmt_state != STOPPED:
            word |= 0x0200
        if self.state is PowerState.ENABLED:
            mode = axis.mode
            if self._halted:
                word |= 0x0400 if not axis.ramping else 0
            elif mode and not axis.ramping:
                word |= 0x1000
            if axis.internal_limit or axis.saturated:
                word |= 0x0800
            if mode == CSP and axis.following_error:
                word |= 0x2000
        return word

    @property
    def sync_period_ns(self) -> int:
        """1006h as time."""
        return self.dictionary.number(key(0x1006)) * 1000

    def write(self, index: int, subindex: int, value: int) -> None:
        """Write an object from inside, now, as an SDO download would.

        Raises:
            SdoAbort: refused.
        """
        entry = self.dictionary.entry(key(index, subindex))
        self._run_to(self._now_ns)
        self.dictionary.download(entry.key, encode(entry, value))
        self._settle()

    # -- configuration -------------------------------------------------------------------------------------------------

    def _refresh(self) -> None:
        """Before an upload: the values of this moment."""
        self._latch()

    def _pdo_changed(self) -> None:
        self.process_data.recompile(self._now_ns)
        if self.nmt_state == OPERATIONAL:
            self.process_data.start(self._now_ns)
        self.routes_changed()

    def _communication_changed(self) -> None:
        number = self.dictionary.number
        period_ns = number(key(0x1006)) * 1000
        self._sync_window_ns = period_ns * number(key(0x2010, 1)) // 10 if number(key(0x2010, 2)) else 0
        self._sync_length = 1 if number(key(0x1019)) > 1 else 0
        known = {(consumer.node, consumer.timeout_ns): consumer for consumer in self._consumers}
        wanted: list[_Consumer] = []
        for sub in (1, 2):
            entry = number(key(0x1016, sub))
            node, timeout_ns = entry >> 16 & 0x7F, (entry & 0xFFFF) * _MS
            if node and timeout_ns:
                wanted.append(known.get((node, timeout_ns)) or _Consumer(node, timeout_ns))
        self._consumers = wanted
        self.routes_changed()
        self._schedule()

    def _heartbeat_changed(self) -> None:
        period_ns = self.dictionary.number(key(0x1017)) * _MS
        self._heartbeat_ns = self._now_ns + period_ns if period_ns else NEVER_NS
        self._schedule()

    def _hand_changed(self) -> None:
        if self._hold_hand is not None:
            grip, centre, amplitude, frequency = (self._values[key(0x2040, sub)] for sub in (1, 2, 3, 4))
            self._hold_hand(bool(grip), centre * 1e-6, amplitude * 1e-6, frequency * 1e-3)

    def _guard_objects(self) -> None:
        dictionary, number = self.dictionary, self.dictionary.number
        guards, effects = dictionary.guards, dictionary.effects
        dictionary.before_upload = self._refresh

        def one_of(*allowed: int) -> Callable[[int], None]:
            def guard(value: int) -> None:
                if value not in allowed:
                    raise SdoAbort(INVALID_VALUE)

            return guard

        def while_off(value: int) -> None:
            if self.axis.powered:
                raise SdoAbort(DEVICE_STATE)

        def velocity_unit(value: int) -> None:
            while_off(value)
            if value not in VELOCITY_UNITS:
                raise SdoAbort(INVALID_VALUE)

        def sync_cob_id(value: int) -> None:
            if value != 0x80 and not 0x81 <= value <= 0xFF:
                raise SdoAbort(INVALID_VALUE)

        def sync_counter(value: int) -> None:
            if number(key(0x1006)):
                raise SdoAbort(DEVICE_STATE)
            if value == 1:
                raise SdoAbort(INVALID_VALUE)

        def consumer(own: Key) -> Callable[[int], None]:
            def guard(value: int) -> None:
                node = value >> 16
                if node > 127:
                    raise SdoAbort(INVALID_VALUE)
                others = (number(key(0x1016, sub)) for sub in (1, 2) if key(0x1016, sub) != own)
                if node and value & 0xFFFF and any(other >> 16 == node and other & 0xFFFF for other in others):
                    raise SdoAbort(INCOMPATIBLE)

            return guard

        def signature(expected: int) -> Callable[[int], None]:
            def guard(value: int) -> None:
                if value != expected:
                    raise SdoAbort(CANNOT_STORE)

            return guard

        def store() -> None:
            self._values[key(0x1010, 1)] = 1
            dictionary.store()

        def restore() -> None:
            self._values[key(0x1011, 1)] = 1
            dictionary.forget()

        def clear_history() -> None:
            for sub in range(1, 9):
                self._values[key(0x1003, sub)] = 0

        guards[key(0x1003)] = one_of(0)
        effects[key(0x1003)] = clear_history
        guards[key(0x1005)] = sync_cob_id
        guards[key(0x1019)] = sync_counter
        effects[key(0x1019)] = self._sync_counter_changed
        for address in (key(0x1005), key(0x1006), key(0x2010, 1), key(0x2010, 2)):
            effects[address] = self._communication_changed
        for sub in (1, 2):
            guards[key(0x1016, sub)] = consumer(key(0x1016, sub))
            effects[key(0x1016, sub)] = self._communication_changed
        effects[key(0x1017)] = self._heartbeat_changed
        guards[key(0x1010, 1)], effects[key(0x1010, 1)] = signature(_SAVE), store
        guards[key(0x1011, 1)], effects[key(0x1011, 1)] = signature(_LOAD), restore

        guards[_K6060] = one_of(0, *MODES)
        guards[key(0x60A9)] = velocity_unit
        units = [key(0x608F, 1), key(0x608F, 2), key(0x6091, 1), key(0x6091, 2), key(0x6092, 1), key(0x6092, 2)]
        for address in (*units, key(0x6076), key(0x60C2, 1), key(0x60C2, 2), key(0x6080)):
            guards[address] = while_off
        for address in (*units, key(0x6076), key(0x60A9), key(0x60C2, 1), key(0x60C2, 2), key(0x6080), key(0x6072)):
            effects[address] = self.axis.units_changed
        for address in (key(0x2020, 1), key(0x2020, 2), key(0x2021, 1), key(0x2021, 2), key(0x2022, 2)):
            effects[address] = self.axis.units_changed
        for address in (_K6040, _K6060, _K60FE, key(0x6071), key(0x607A), key(0x60FF)):
            effects[address] = self._commanded
        for address in (key(0x60B0), key(0x60B1), key(0x60B2), key(0x607D, 1), key(0x607D, 2)):
            effects[address] = self._commanded
        effects[key(0x60FE, 2)] = self._apply_brake
        for sub in (1, 2, 3, 4):
            effects[key(0x2040, sub)] = self._hand_changed
        effects[key(0x2041)] = lambda: self._plant.mount_payload(bool(self._values[key(0x2041)]))

    def _sync_counter_changed(self) -> None:
        self._communication_changed()
        self._pdo_changed()


def _ignore(when_ns: int) -> None:
    """Nobody waits."""


def _do_nothing() -> None:
    """Nobody listens."""
