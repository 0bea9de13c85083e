"""Which of the three layers this controller can do, found out by asking it; every refusal is kept as a reason.

A. host control     status, pulses, servo power, hold; no torque: nothing can be identified
B. batch            a job at a time, 9600 baud and up
C. streaming        every tick, 115200 baud and up
"""

from __future__ import annotations

from dataclasses import dataclass, field

from frictid_drivers.motoman.batch import BatchClient, BatchHello
from frictid_drivers.motoman.controller_errors import ControllerError
from frictid_drivers.motoman.host_control import PROFILES, HostControl, ServoPower
from frictid_drivers.motoman.port import BytePort, Sink
from frictid_drivers.motoman.settings import SerialOptions
from frictid_drivers.motoman.stream import StreamSession
from frictid_drivers.motoman.stream_frames import Welcome, feedback_bytes, set_point_bytes
from frictid_hil.errors import HardwareError, PlanRefused

STREAM_PARITY = "N"
_BITS_PER_BYTE = 10
_USABLE_SHARE = 0.9  # of a tick may be spent on either direction's frames


@dataclass(frozen=True, slots=True)
class Reach:
    """What the controller can do."""

    reasons: dict[str, str] = field(default_factory=dict)  # why each better layer is not available, by its name
    welcome: Welcome | None = None  # of the streaming application, all axes; None where there is none
    batch: BatchHello | None = None  # of the batch application; None where there is none

    @property
    def application(self) -> Welcome | BatchHello | None:
        """The better one of them."""
        return self.welcome or self.batch

    @property
    def layer(self) -> str:
        """The one to use: host, batch or stream."""
        if self.welcome is not None:
            return "stream"
        return "host" if self.batch is None else "batch"


class Line:
    """One port, open at the speed of host control with its ``parity``: in host control or in a stream."""

    def __init__(self, port: BytePort, options: SerialOptions, parity: str, tick_us: int, sink: Sink) -> None:
        self.port = port
        self.host = HostControl(port, PROFILES[options.controller], options.link, reply_s=options.reply_s, sink=sink)
        self.batch = BatchClient(self.host)
        self.power = ServoPower(self.host)
        self._options, self._parity, self._tick_us = options, parity, tick_us
        self._session_number = int(port.now_s() * 10.0) % 255

    def begin_stream(self, axis_mask: int) -> StreamSession:
        """FSTREAM, the other speed, HELLO; ``ControllerError`` where refused, ``LinkError`` without a HELLO."""
        options = self._options
        self.host.order(f"FSTREAM 1,{options.stream_baud},{self._tick_us},{axis_mask}")
        self.host.leave()
        self.port.set_line(options.stream_baud, STREAM_PARITY)
        session = StreamSession(self.host, lead_ticks=options.lead_ticks, silence_s=options.silence_ms * 1e-3)
        self._session_number = self._session_number % 255 + 1
        try:
            session.begin(self._session_number, axis_mask)
        except HardwareError:
            self.end_stream(session)
            raise
        return session

    def end_stream(self, session: StreamSession) -> None:
        """STOP, and back to the host control's speed."""
        session.halt(leave=True)
        self.port.set_line(self._options.baud, self._parity)


def find_layer(line: Line, options: SerialOptions, axis_mask: int) -> Reach:
    """Ask for streaming, then for batch; ``HardwareError`` where the robot file insists on one that is not there."""
    reasons: dict[str, str] = {}
    welcome: Welcome | None = None
    hello: BatchHello | None = None
    insisted = f"the robot file says layer: {options.layer}"
    if options.layer not in ("auto", "stream"):
        reasons["stream"] = insisted
    elif not options.stream_baud:
        reasons["stream"] = "no `stream_baud` in the robot file: not a gateway port"
    else:
        try:
            session = line.begin_stream(axis_mask)
            line.end_stream(session)
            welcome = session.welcome
        except ControllerError as refused:
            reasons["stream"] = f"the controller answers {refused.what}"
    if options.layer == "host":
        reasons["batch"] = insisted
    else:
        try:
            hello = line.batch.hello()
        except ControllerError as refused:
            reasons["batch"] = f"the controller answers {refused.what}"
    reach = Reach(reasons, welcome, hello)
    if options.layer not in ("auto", reach.layer):
        raise HardwareError(
            f"the robot file insists on layer {options.layer}: {reasons[options.layer]}",
            where="options.layer",
            next_step="install the controller application, or say `layer: auto`",
        )
    return reach


def streamed_mask(all_axes: int, active_axes: int, baud: int, tick_us: int) -> int:
    """All axes where their frames fit into a tick, else the active ones; ``PlanRefused`` where not even those fit."""
    for mask in (all_axes, active_axes):
        if busy_share(mask.bit_count(), baud, tick_us) <= _USABLE_SHARE:
            return mask
    raise PlanRefused(
        f"{active_axes.bit_count()} joints do not fit into a tick of {tick_us / 1000:g} ms at {baud} baud",
        next_step="one joint at a time at 115200, six from about 250000 on",
    )


def busy_share(axes: int, baud: int, tick_us: int) -> float:
    """Part of a tick that the busier direction needs."""
    most = max(feedback_bytes(axes), set_point_bytes(axes, torque=True))
    return most * _BITS_PER_BYTE / baud / (tick_us * 1e-6)
