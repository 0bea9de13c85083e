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
from frictid_drivers.virtual.axis import Axis
from frictid_drivers.virtual.emergency import Emergency
from frictid_drivers.virtual.object_dictionary import ObjectDictionary, encode
from frictid_drivers.virtual.object_rules import COMMANDS, HAND, NETWORK, UNITS, install_rules
from frictid_drivers.virtual.objects import OBJECTS, STANDARD, Key, Manner, Record, Value, key
from frictid_drivers.virtual.pdo import NEVER_NS, ProcessData, ReceivePdo
from frictid_drivers.virtual.power_stage import PowerStage, PowerState
from frictid_drivers.virtual.sdo_server import SdoServer
from frictid_hil.simulation.servo_loop import ServoLoop

INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
_NMT_STATES = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}  # by the command that leads there

_MS = 1_000_000
_SUPERVISION_NS = 10 * _MS
_RAMP_TICK_NS = 1 * _MS

Send = Callable[[int, bytes], None]


@dataclass(slots=True)
class Consumer:
    """One node listened for."""

    node: int
    timeout_ns: int
    deadline_ns: int | None = None  # when it counts as lost; None until it was heard
    lost: bool = False  # it fell silent and has not been heard again


class HeartbeatWatch:
    """All nodes listened for (1016h): armed by the first heartbeat, lost when none came in time."""

    def __init__(self) -> None:
        self.consumers: list[Consumer] = []

    def configure(self, entries: Iterable[int]) -> None:
        """Take over the entries of 1016h; one that stays the same keeps its state."""
        known = {(consumer.node, consumer.timeout_ns): consumer for consumer in self.consumers}
        wanted = [(entry >> 16 & 0x7F, (entry & 0xFFFF) * _MS) for entry in entries]
        self.consumers = [known.get(one) or Consumer(*one) for one in wanted if all(one)]

    @property
    def any_lost(self) -> bool:
        """Somebody is missing."""
        return any(consumer.lost for consumer in self.consumers)

    @property
    def deadlines_ns(self) -> list[int]:
        """When those that were heard count as lost."""
        return [consumer.deadline_ns for consumer in self.consumers if consumer.deadline_ns is not None]

    def newly_lost(self, now_ns: int) -> list[int]:
        """Nodes whose time has run out; each is told once."""
        late = [one for one in self.consumers if one.deadline_ns is not None and now_ns >= one.deadline_ns]
        for consumer in late:
            consumer.deadline_ns = None
            consumer.lost = True
        return [consumer.node for consumer in late]


class Servo:
    """One node."""

    def __init__(
        self,
        node_id: int,
        plant: ServoLoop,
        send: Send,
        *,
        gear_ratio: float = 1.0,
        increments_per_revolution: float = 131_072.0,  # encoder increments per joint revolution, as built
        direction: int = 1,
        torque_step: int = 1,  # smallest step of the reported torque, per mille
        overrides: Mapping[Key, Value] | None = None,
        records: Iterable[Record] = OBJECTS,
        missing: Iterable[int] = (),  # indices of objects that it does not have
        manner: Manner = STANDARD,
        # Called as (held, centre_rad, amplitude_rad, frequency_hz) when the simulated hand (2040h) changes.
        hold_hand: Callable[[bool, float, float, float], None] | None = None,
    ) -> None:
        self.node_id = node_id
        self.dictionary = ObjectDictionary(node_id, overrides, missing=missing, records=records, manner=manner)
        self._values = cast("dict[Key, int]", self.dictionary.values)
        self._plant = plant
        self._send = send
        self._hold_hand = hold_hand or (lambda held, centre_rad, amplitude_rad, frequency_hz: None)
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
        self._watch = HeartbeatWatch()
        self.process_data = ProcessData(self.dictionary, send, self._pdo_changed)
        self._sdo = SdoServer(self.dictionary)
        self.nmt_state = INITIALISING
        self.power = PowerStage(self.dictionary, self.axis, plant, self.emergency, lambda: self._watch.any_lost)
        self.next_event_ns = NEVER_NS  # call ``on_time`` at this run time
        self.wake: Callable[[int], None] = lambda at_ns: None  # told when an earlier event appeared
        self.routes_changed: Callable[[], None] = lambda: None  # told when COB-IDs changed
        self._last_sync_ns: int | None = None
        self._heartbeat_ns = NEVER_NS
        self._sync_window_ns = 0
        self._sync_length = 0
        self.dictionary.before_upload = self._latch
        install_rules(self.dictionary, lambda: self.axis.powered)
        self.dictionary.effects.update(
            {
                key(0x1017): self._heartbeat_changed,
                key(0x1019): self._counter_changed,
                key(0x2023): self._pdo_changed,
                key(0x2041): lambda: self._plant.mount_payload(bool(self._values[key(0x2041)])),
                key(0x60FE, 2): self.power.apply_brake,
                **dict.fromkeys(NETWORK, self._network_changed),
                **dict.fromkeys(HAND, self._hand_changed),
                **dict.fromkeys(UNITS, self.axis.units_changed),
                **dict.fromkeys(COMMANDS, self.power.follow_commands),
            }
        )

    @property
    def state(self) -> PowerState:
        """Of the power stage."""
        return self.power.state

    # -- frames --------------------------------------------------------------------------------------------------------

    def routes(self) -> dict[int, Callable[[bytes, int], None]]:
        """Who handles which COB-ID; NMT (000h) aside, which is ``receive_nmt``."""
        found: dict[int, Callable[[bytes, int], None]] = {}
        for pdo in reversed(self.process_data.receive):
            found[pdo.cob_id] = self._rpdo_handler(pdo)
        for consumer in self._watch.consumers:
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
        if command in _NMT_STATES:
            self._enter(_NMT_STATES[command])
        elif command == 0x81:
            self.boot(now_ns)
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
            self.power.changed = True  # from here on SYNC is supervised
        self._last_sync_ns = now_ns
        if emergency.SYNC_LOST in self.emergency.present and self.state is not PowerState.FAULT:
            self.emergency.clear(emergency.SYNC_LOST)
        if len(data) != self._sync_length:
            self.emergency.report(emergency.SYNC_LENGTH, len(data))
        process_data = self.process_data
        due = process_data.due_on_sync(data[0] if data else None)
        pending = process_data.pending
        if due or pending or process_data.live:
            self.power.run_to(now_ns)
            self._latch()
            process_data.send_due(due)
        if process_data.acyclic:
            self._latch()
            process_data.send_acyclic(now_ns)
        if pending:
            process_data.apply_pending()
            self.power.follow_commands()
        if self.power.changed or process_data.live:
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
                self.power.follow_commands()
                self._settle()

        return receive

    def receive_remote(self, cob_id: int, now_ns: int) -> None:
        """A remote frame: TPDOs that allow it are sent."""
        self._arrive(now_ns)
        self.process_data.answer_remote(cob_id, now_ns)

    def _heartbeat_handler(self, consumer: Consumer) -> Callable[[bytes, int], None]:
        def receive(data: bytes, now_ns: int) -> None:
            first = consumer.deadline_ns is None
            consumer.deadline_ns = now_ns + consumer.timeout_ns
            if first:
                consumer.lost = False
                self._arrive(now_ns)
                if self.state is not PowerState.FAULT and not self._watch.any_lost:
                    self.emergency.clear(emergency.HEARTBEAT_LOST)
                self._settle()

        return receive

    # -- time ----------------------------------------------------------------------------------------------------------

    def on_time(self, now_ns: int) -> None:
        """Do what is due at ``now_ns``."""
        self._now_ns = now_ns
        if now_ns >= self._heartbeat_ns:
            self._heartbeat_ns += self._values[key(0x1017)] * _MS
            self._send(0x700 + self.node_id, bytes([self.nmt_state]))
        for node in self._watch.newly_lost(now_ns):
            self._connection_lost(emergency.HEARTBEAT_LOST, node)
        if now_ns >= self._sync_deadline_ns():
            self._sync_lost()
        if now_ns >= self._tick_due_ns():
            self.power.run_to(now_ns)
            self.power.changed = self.power.changed or self.process_data.live
        if self.power.changed or now_ns >= self.process_data.next_timer_ns:
            self.power.run_to(now_ns)
            self._settle()
        else:
            self._schedule()

    def _tick_due_ns(self) -> int:
        """When the powered motor is looked at next."""
        if not self.axis.powered:
            return NEVER_NS
        return self.axis.now_ns + (_RAMP_TICK_NS if self.axis.ramping else _SUPERVISION_NS)

    def _sync_deadline_ns(self) -> int:
        if (
            not self._sync_window_ns
            or self._last_sync_ns is None
            or self.state is not PowerState.ENABLED
            or self.nmt_state != OPERATIONAL
            or emergency.SYNC_LOST in self.emergency.present
        ):
            return NEVER_NS
        # One nanosecond past the window: a gap of exactly twice the period is still on time.
        return self._last_sync_ns + self._sync_window_ns + 1

    def _schedule(self) -> None:
        timers_ns = (self._heartbeat_ns, self._sync_deadline_ns(), self._tick_due_ns(), self.process_data.next_timer_ns)
        self.next_event_ns = max(min(*timers_ns, *self._watch.deadlines_ns), self._now_ns + 1)
        self.wake(self.next_event_ns)

    def _arrive(self, now_ns: int) -> None:
        """Something slow arrives: let physics catch up first, so that it acts from now on."""
        self._now_ns = now_ns
        self.power.run_to(now_ns)

    def _settle(self) -> None:
        """After anything out of the ordinary: tell the bus what changed, and when to come back."""
        self.power.changed = False
        if self.process_data.event_driven:
            self._latch()
            self.process_data.send_events(self._now_ns)
        self._schedule()

    def _latch(self) -> None:
        self.power.latch(remote=self.nmt_state != STOPPED)

    # -- NMT -----------------------------------------------------------------------------------------------------------

    def boot(self, now_ns: int) -> None:
        """Power-on or reset: initialise, without motor power, say boot-up, wait in pre-operational."""
        self._now_ns = now_ns
        self.power.run_to(now_ns)
        self.dictionary.reset()
        self._sdo.reset()
        self.emergency.present = ()
        self.power.boot()
        self._restart_communication()
        self._settle()

    def _reset_communication(self) -> None:
        if self.axis.powered:
            self._connection_lost(emergency.CONNECTION_ABORTED, 0)
        self.dictionary.reset(0x1000, 0x1FFF)
        self._restart_communication()
        self.emergency.clear(emergency.HEARTBEAT_LOST)

    def _restart_communication(self) -> None:
        self.nmt_state = INITIALISING
        self._last_sync_ns = None
        self.process_data.stop()
        self._pdo_changed()
        self._network_changed()
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
        self.power.run_to(self._now_ns)
        option = self._values[key(0x6007)]
        if option == 1:
            self.power.fault(code)
        elif option == 2:
            self.power.disable_voltage()
        elif option == 3 and self.state is PowerState.ENABLED:
            self.power.quick_stop()
        behaviour = self._values[key(0x1029, 1)]
        if code == emergency.HEARTBEAT_LOST and self.nmt_state == OPERATIONAL and behaviour != 1:
            self.nmt_state = PRE_OPERATIONAL if behaviour == 0 else STOPPED
            self.process_data.stop()

    def _sync_lost(self) -> None:
        self.emergency.report(emergency.SYNC_LOST)
        if self._values[key(0x2010, 2)] == 2:
            self.power.run_to(self._now_ns)
            self.power.fault(emergency.SYNC_LOST)

    def _send_emergency(self, data: bytes) -> None:
        self.power.changed = True
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
        self.power.fault(code)
        self._settle()

    def block_brake(self, blocked: bool, now_ns: int) -> None:
        """The brake's coil breaks: it stays closed, whatever the drive says; or it is mended."""
        self._arrive(now_ns)
        self.power.block_brake(blocked)

    @property
    def sync_period_ns(self) -> int:
        """1006h as time."""
        return self.dictionary.number(key(0x1006)) * 1000

    def write(self, index: int, subindex: int, value: int, now_ns: int) -> None:
        """Write an object from inside, as an SDO download would; ``SdoAbort`` where refused."""
        entry = self.dictionary.entry(key(index, subindex))
        self._arrive(now_ns)
        self.dictionary.download(entry.key, encode(entry, value))
        self._settle()

    # -- configuration -------------------------------------------------------------------------------------------------

    def _pdo_changed(self) -> None:
        self.process_data.recompile(self._now_ns)
        if self.nmt_state == OPERATIONAL:
            self.process_data.start(self._now_ns)
        self.routes_changed()

    def _network_changed(self) -> None:
        number = self.dictionary.number
        self._sync_window_ns = self.sync_period_ns * number(key(0x2010, 1)) // 10 if number(key(0x2010, 2)) else 0
        self._sync_length = 1 if number(key(0x1019)) > 1 else 0
        self._watch.configure(number(key(0x1016, sub)) for sub in (1, 2))
        self.routes_changed()

    def _counter_changed(self) -> None:
        self._network_changed()
        self._pdo_changed()

    def _heartbeat_changed(self) -> None:
        period_ns = self.dictionary.number(key(0x1017)) * _MS
        self._heartbeat_ns = self._now_ns + period_ns if period_ns else NEVER_NS

    def _hand_changed(self) -> None:
        grip, centre, amplitude, frequency = (self._values[key(0x2040, sub)] for sub in (1, 2, 3, 4))
        self._hold_hand(bool(grip), centre * 1e-6, amplitude * 1e-6, frequency * 1e-3)
