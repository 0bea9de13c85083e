"""Servo power of the whole arm: on once it may be, off once it stands.

Stock host control switches all axes at once. Power that goes off while an axis still moves drops it into its brake, so
its standstill is looked for first - in the positions, which every controller reports.
"""

from __future__ import annotations

import contextlib
from typing import Final

from frictid_drivers.motoman.host_control import HostControl
from frictid_hil.errors import FrictidError, HardwareError

_ON_WITHIN_S: Final = 5.0
_AT_REST_WITHIN_S: Final = 1.0
_STILL_PULSES: Final = 2
_URGENT_S: Final = 0.5


class ServoPower:
    """Switches it.

    Attributes:
        ours: we switched it on and have not switched it off yet.
    """

    def __init__(self, host: HostControl) -> None:
        self._host = host
        self.ours = False

    def on(self) -> None:
        """Release a command hold that was left behind, switch servo power on, and see that it is.

        Raises:
            ControllerError: refused, by name.
            HardwareError: ordered, but not seen.
        """
        status = self._host.status()
        if "command hold" in status.conditions:
            self._host.order("HOLD 0")
        self.ours = True
        if status.servo_on:
            return
        self._host.order("SVON 1")
        until_s = self._host.port.now_s() + _ON_WITHIN_S
        while not self._host.status().servo_on:
            if self._host.port.now_s() > until_s:
                raise HardwareError(
                    f"servo power is not on {_ON_WITHIN_S:g} s after it was ordered",
                    where="controller",
                    next_step="look at the pendant: safety circuit, e-stops, alarms",
                )

    def off(self, *, urgent: bool = False) -> None:
        """Wait for standstill, a second at most, then switch it off.

        Args:
            urgent: something failed: half a second per command, and power goes off also where the arm cannot be seen.
        """
        within_s = _URGENT_S if urgent else None
        with contextlib.suppress(FrictidError) if urgent else contextlib.nullcontext():
            self._await_rest(within_s)
        self._host.order("SVON 0", within_s=within_s)
        self.ours = False

    def _await_rest(self, within_s: float | None) -> None:
        until_s = self._host.port.now_s() + _AT_REST_WITHIN_S
        before = self._host.pulses(within_s=within_s)
        while self._host.port.now_s() < until_s:
            here = self._host.pulses(within_s=within_s)
            if max(abs(a - b) for a, b in zip(here, before, strict=True)) <= _STILL_PULSES:
                return
            before = here
