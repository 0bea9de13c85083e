"""The motion side of a drive: units, set-points between SYNCs, ramps, limits and supervision of one motor.

The axis stands between the object dictionary (integers in drive units) and the plant (joint side, rad and N m), and
lives in integer nanoseconds of run time. It runs the plant lazily: ``catch_up`` brings the physics to now whenever
someone looks or commands something new, so that a joint holding still costs nothing between its reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

from frictid_drivers.virtual import emergency
from frictid_drivers.virtual.object_dictionary import ObjectDictionary
from frictid_drivers.virtual.objects import Key, key
from frictid_hil.simulation.servo_loop import ServoLoop

IP, CSP, CSV, CST = 7, 8, 9, 10
MODES = (IP, CSP, CSV, CST)
SUPPORTED_MODES = 1 << CSP - 1 | 1 << CSV - 1 | 1 << CST - 1

_NS = 1e-9
_RAMP_STEP_NS = 1_000_000
_STANDSTILL_RAD_S = 0.005
_SETTLE_NS = 500_000_000
_RPM = 2.0 * math.pi / 60.0
_I16, _I32 = 1 << 15, 1 << 31

_K6062, _K6064, _K606C = key(0x6062), key(0x6064), key(0x606C)
_K6071, _K6074, _K6077 = key(0x6071), key(0x6074), key(0x6077)
_K607A, _K60B0, _K60B1, _K60B2 = key(0x607A), key(0x60B0), key(0x60B1), key(0x60B2)
_K60F4, _K60FF = key(0x60F4), key(0x60FF)
_K2030, _K2031 = key(0x2030), key(0x2031)
_K6065, _K6066 = key(0x6065), key(0x6066)
_K607D_MIN, _K607D_MAX = key(0x607D, 1), key(0x607D, 2)

VELOCITY_UNITS = {(prefix % 256) << 24 | 0x00B44700: 10.0**prefix * _RPM for prefix in range(-6, 1)}
"""60A9h values that are understood, and what one unit is in rad/s: rpm, and its decimal parts down to 1e-6 rpm."""


class Axis:
    """One motor."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        plant: ServoLoop,
        *,
        gear_ratio: float,  # motor revolutions per joint revolution, as built
        increments_per_revolution: float,  # encoder increments per joint revolution, as built
        direction: int,
        torque_step: int = 1,  # smallest step of the reported torque, per mille
    ) -> None:
        self._manner = dictionary.manner
        self._values = cast("dict[Key, int]", dictionary.values)
        self._plant = plant
        self._gear_ratio = gear_ratio
        self._increments_per_rad = increments_per_revolution / (2.0 * math.pi)
        self._direction = direction
        self._torque_step = torque_step
        self.now_ns = 0  # run time that the plant has reached
        self.alarm = 0  # EMCY code of what supervision found, 0 for nothing; the node clears it
        self.internal_limit = False  # a set-point was cut by a limit (statusword bit 11)
        self.following_error = False  # outside the window right now (statusword bit 13)
        self.encoder_stuck = False  # report the last position for ever (a fault to play)
        # Brings this axis and those that can only move on with it to a run time, or as far towards it as their commands
        # go on unbroken; None where it is alone.
        self.company: Callable[[int], None] | None = None
        self.powered = False
        self.mode = 0
        self._stopped = False  # by a ramp: the host's set-points do not count until ``resume``
        self._ramp: _Ramp | None = None
        self._torque_filtered = 0.0
        self._latched_ns = 0
        self._outside_since_ns: int | None = None
        self._clear_set_points(0.0)
        self.units_changed()

    # -- units ---------------------------------------------------------------------------------------------------------

    def units_changed(self) -> None:
        """Objects that decide units or limits were written; take them over."""
        number = self._values
        encoder = number[key(0x608F, 1)] / number[key(0x608F, 2)]
        gear = number[key(0x6091, 1)] / number[key(0x6091, 2)]
        feed = number[key(0x6092, 1)] / number[key(0x6092, 2)]
        self._units_per_increment = feed / (encoder * gear)
        if self._manner.position_units_per_rad is not None:
            self._units_per_increment = self._manner.position_units_per_rad / self._increments_per_rad
        if abs(self._units_per_increment - 1.0) < 1e-12:
            self._units_per_increment = 1.0
        units_per_rad = self._increments_per_rad * self._units_per_increment * self._direction
        self._rad_per_unit = 1.0 / units_per_rad
        # Velocity is of the shaft behind the gear that the drive knows of; a further gear is the host's business.
        further_gear = self._gear_ratio / gear
        unit_rad_s = VELOCITY_UNITS[number[key(0x60A9)]]
        self._rad_s_per_unit = (self._manner.velocity_unit_rad_s or unit_rad_s / further_gear) * self._direction
        self._nm_per_mille = number[key(0x6076)] * 1e-6 * self._gear_ratio * self._direction
        self._speed_limit_rad_s = number[key(0x6080)] * _RPM / self._gear_ratio
        self.max_torque_per_mille = number[key(0x6072)]
        self._torque_limit_nm = abs(self._nm_per_mille) * self.max_torque_per_mille
        self._interpolation_ns = round(number[key(0x60C2, 1)] * 10.0 ** (number[key(0x60C2, 2)] + 9))
        self._torque_filter_s = number[key(0x2022, 2)] * 1e-6
        # The drive's own helpers, in SI on the joint side; all zero unless somebody switched them on.
        self._own_coulomb_nm = number[key(0x2020, 1)] * abs(self._nm_per_mille)
        self._own_viscous = number[key(0x2020, 2)] * abs(self._nm_per_mille) / self._speed_limit_rad_s
        self._own_inertia_kg_m2 = number[key(0x2021, 2)] * 1e-6 * self._gear_ratio**2
        self._own_anything = bool(self._own_coulomb_nm or self._own_viscous or self._own_inertia_kg_m2)
        self._plant.limits(self._torque_limit_nm)

    # -- power ---------------------------------------------------------------------------------------------------------

    def switch(self, on: bool) -> None:
        """Power stage; the caller has caught up. Commands start from where the joint is."""
        if on != self.powered:
            self.powered = on
            self._ramp = None
            self._outside_since_ns = None
            self.following_error = self.internal_limit = False
            if on:
                # In this order: the loops start with the torque that holds the joint.
                self._stopped = False
                self._clear_set_points(self._plant.measured_position_rad)
                self._plant.set_mode(self.mode or CSP)
            self._plant.power(on)

    def resume(self) -> None:
        """Follow the host's set-points again, starting from here and at rest."""
        self._ramp = None
        self._stopped = False
        self._start_from_here()

    def set_mode(self, mode: int) -> None:
        """Change the mode displayed in 6061h; commands start from where the joint is."""
        if mode != self.mode:
            self.mode = mode
            # While a stop is under way or held, the new mode waits for ``resume``.
            if not self._stopped:
                self._start_from_here()

    def _start_from_here(self) -> None:
        self._clear_set_points(self._plant.measured_position_rad)
        # Without a mode the joint is held where it is. Passing through torque mode makes the position loop let go of
        # its old target.
        self._plant.set_mode(CST)
        self._plant.set_mode(self.mode or CSP)

    def _clear_set_points(self, position_rad: float) -> None:
        self._position_rad = self._from_rad = self._to_rad = position_rad
        self._from_ns = self._to_ns = self.now_ns
        self._velocity_rad_s = self._demand_rad_s = self._demand_rad_s2 = self._torque_nm = self._offset_nm = 0.0

    # -- set-points ----------------------------------------------------------------------------------------------------

    def take_set_points(self) -> None:
        """The host's set-points count from now on; the caller has caught up."""
        if self._stopped or not self.powered:
            return
        values = self._values
        mode = self.mode
        self.internal_limit = False
        if mode == CSP:
            units = values[_K607A] + values[_K60B0]
            low, high = values[_K607D_MIN], values[_K607D_MAX]
            if not low <= units <= high and low < high:
                units = low if units < low else high
                self.internal_limit = True
            target_rad = units * self._rad_per_unit
            self._from_rad, self._from_ns = self._position_rad, self.now_ns
            self._to_ns = self.now_ns + self._interpolation_ns
            step_rad = target_rad - self._from_rad
            reach_rad = self._speed_limit_rad_s * self._interpolation_ns * _NS
            if abs(step_rad) > reach_rad:
                step_rad = math.copysign(reach_rad, step_rad)
                self.internal_limit = True
            self._to_rad = self._from_rad + step_rad
            previous_rad_s, self._demand_rad_s = self._demand_rad_s, step_rad / (self._interpolation_ns * _NS)
            self._demand_rad_s2 = (self._demand_rad_s - previous_rad_s) / (self._interpolation_ns * _NS)
            self._offset_nm = self._limited(values[_K60B2] * self._nm_per_mille)
        elif mode == CSV:
            velocity_rad_s = (values[_K60FF] + values[_K60B1]) * self._rad_s_per_unit
            if abs(velocity_rad_s) > self._speed_limit_rad_s:
                velocity_rad_s = math.copysign(self._speed_limit_rad_s, velocity_rad_s)
                self.internal_limit = True
            self._velocity_rad_s = self._demand_rad_s = velocity_rad_s
            self._offset_nm = self._limited(values[_K60B2] * self._nm_per_mille)
        elif mode == CST:
            self._torque_nm = self._limited((values[_K6071] + values[_K60B2]) * self._nm_per_mille)
            self._offset_nm = 0.0

    def _limited(self, torque_nm: float) -> float:
        if abs(torque_nm) > self._torque_limit_nm:
            self.internal_limit = True
            return math.copysign(self._torque_limit_nm, torque_nm)
        return torque_nm

    # -- ramps ---------------------------------------------------------------------------------------------------------

    @property
    def ramping(self) -> bool:
        """Decelerating, or waiting for standstill after it."""
        return self._ramp is not None

    @property
    def ramp_done(self) -> bool:
        """The ramp has ended and the joint stands, or had its time to."""
        return self._ramp is not None and self._ramp.done

    def start_ramp(self, deceleration_units: int | None) -> None:
        """Come to rest from here: at a deceleration in drive units, or as fast as the torque limit lets (None)."""
        plant, values = self._plant, self._values
        velocity_rad_s = plant.velocity_rad_s
        position_rad = plant.measured_position_rad
        if self.mode == CSP and not self._stopped:
            # Keep the small lag of the loop, so that braking starts without a jerk; forget a large one.
            lag_rad = self._position_rad - position_rad
            if abs(lag_rad / self._rad_per_unit) <= values[_K6065]:
                position_rad = self._position_rad
            else:
                plant.set_mode(CST)
        if deceleration_units is None:
            # Speed command zero: the inner loop brakes with all the torque it has.
            plant.set_mode(CSV)
            rate_rad_s2 = math.inf
        else:
            plant.set_mode(CSP)
            rate_rad_s2 = max(1e-6, deceleration_units * abs(self._rad_s_per_unit))
        self._clear_set_points(position_rad)
        self._stopped = True
        self._ramp = _Ramp(self.now_ns, position_rad, velocity_rad_s, rate_rad_s2)

    def end_ramp(self) -> None:
        """Hold position where the ramp ended."""
        ramp = self._ramp
        self._ramp = None
        if ramp is not None and ramp.rate_rad_s2 == math.inf:
            self._clear_set_points(self._plant.measured_position_rad)
            self._plant.set_mode(CSP)
        self._demand_rad_s = self._demand_rad_s2 = self._velocity_rad_s = 0.0

    # -- time ----------------------------------------------------------------------------------------------------------

    def catch_up(self, now_ns: int) -> None:
        """Run the plant to ``now_ns`` and supervise it."""
        if now_ns <= self.now_ns:
            return
        while self.now_ns < now_ns:
            if self.company is not None:
                self.company(now_ns)
                continue
            end_ns = self.unbroken_until_ns(now_ns)
            position_rad, velocity_rad_s, torque_nm, offset_nm = self.command_until(end_ns)
            self._plant.advance(
                (end_ns - self.now_ns) * _NS,
                position_rad=position_rad,
                velocity_rad_s=velocity_rad_s,
                torque_nm=torque_nm,
                torque_offset_nm=offset_nm,
            )
            self.arrive(end_ns)
        self.supervise()

    def unbroken_until_ns(self, now_ns: int) -> int:
        """How far towards ``now_ns`` the command goes on as it does: a straight line, or standing still."""
        if self._ramp is not None:
            return min(now_ns, self.now_ns + _RAMP_STEP_NS)
        return min(now_ns, self._to_ns) if self._on_the_way else now_ns

    @property
    def _on_the_way(self) -> bool:
        """Between two set-points of position."""
        return self.now_ns < self._to_ns and self.mode == CSP and self.powered and not self._stopped

    def command_until(self, end_ns: int) -> tuple[float, float, float, float]:
        """What the plant is told for the time up to ``end_ns``: position, velocity, torque, torque offset."""
        ramp = self._ramp
        if ramp is not None:
            if ramp.rate_rad_s2 == math.inf:
                self._velocity_rad_s = 0.0
            else:
                self._position_rad, self._demand_rad_s = ramp.at(end_ns)
        elif self._on_the_way:
            if end_ns < self._to_ns:
                share = (end_ns - self._from_ns) / (self._to_ns - self._from_ns)
                self._position_rad = self._from_rad + share * (self._to_rad - self._from_rad)
            else:
                self._position_rad = self._to_rad
        elif self.mode == CSP and not self._stopped:
            self._demand_rad_s = self._demand_rad_s2 = 0.0
        if self._own_anything:
            velocity_rad_s, torque_nm, offset_nm = self._helped(self._velocity_rad_s, self._torque_nm, self._offset_nm)
            return self._position_rad, velocity_rad_s, torque_nm, offset_nm
        return self._position_rad, self._velocity_rad_s, self._torque_nm, self._offset_nm

    def arrive(self, end_ns: int) -> None:
        """The plant has run to ``end_ns``."""
        self.now_ns = end_ns
        ramp = self._ramp
        if ramp is not None:
            at_rest = abs(self._plant.velocity_rad_s) < _STANDSTILL_RAD_S
            ramp.done = ramp.done or (end_ns >= ramp.end_ns and (at_rest or end_ns >= ramp.end_ns + _SETTLE_NS))

    def _helped(self, velocity_rad_s: float, torque_nm: float, offset_nm: float) -> tuple[float, float, float]:
        """Set-points with the drive's own friction compensation and feed-forward (2020h, 2021h)."""
        in_torque = self.mode == CST and not self._stopped
        speed = self._plant.velocity_rad_s if in_torque else self._demand_rad_s
        own_nm = self._own_viscous * speed + self._own_inertia_kg_m2 * self._demand_rad_s2
        if abs(speed) > _STANDSTILL_RAD_S:
            own_nm += math.copysign(self._own_coulomb_nm, speed)
        if in_torque:
            return velocity_rad_s, torque_nm + own_nm, offset_nm
        return velocity_rad_s, torque_nm, offset_nm + own_nm

    def supervise(self) -> None:
        """Look for overspeed, following error and limits while there is power; ``alarm`` tells."""
        if not self.powered:
            return
        plant, values = self._plant, self._values
        if abs(plant.velocity_rad_s) > self._speed_limit_rad_s * 1.1:
            self.alarm = self.alarm or emergency.OVERSPEED
        if self._stopped or not self.mode:
            self.following_error = False
        elif self.mode == CSP:
            error_units = abs((self._position_rad - plant.measured_position_rad) / self._rad_per_unit)
            self.following_error = error_units > values[_K6065]
            if self.following_error:
                since_ns = self._outside_since_ns = self._outside_since_ns or self.now_ns
                if self.now_ns - since_ns >= values[_K6066] * 1_000_000:
                    self.alarm = self.alarm or emergency.FOLLOWING_ERROR
        else:
            units = self._position_units()
            outward = plant.velocity_rad_s / self._rad_s_per_unit
            low, high = values[_K607D_MIN], values[_K607D_MAX]
            if low < high and ((units > high and outward > 0) or (units < low and outward < 0)):
                self.alarm = self.alarm or emergency.POSITION_LIMIT
        if not self.following_error:
            self._outside_since_ns = None

    # -- readings ------------------------------------------------------------------------------------------------------

    def _position_units(self) -> int:
        increments = self._direction * self._plant.position_counts
        if self._units_per_increment != 1.0:
            increments = round(increments * self._units_per_increment)
        return (increments + _I32) % (2 * _I32) - _I32

    def _filtered(self, torque_nm: float, time_constants: float) -> float:
        """Mean of the low-pass's output since the last latch: late by its time constant and half that time."""
        if time_constants <= 0.0:
            return self._torque_filtered
        ahead = self._torque_filtered - torque_nm
        self._torque_filtered = torque_nm + ahead * math.exp(-time_constants)
        return torque_nm - ahead * math.expm1(-time_constants) / time_constants

    def latch(self) -> None:
        """Put the actual values of this moment into the object dictionary; the caller has caught up."""
        plant, values = self._plant, self._values
        torque_nm = plant.torque_nm
        if self._torque_filter_s > 0.0:
            torque_nm = self._filtered(torque_nm, (self.now_ns - self._latched_ns) * _NS / self._torque_filter_s)
        self._latched_ns = self.now_ns
        if not self.encoder_stuck:
            values[_K6064] = self._position_units()
        values[_K606C] = 0 if self.encoder_stuck else _clipped(plant.velocity_rad_s / self._rad_s_per_unit, _I32)
        step = self._torque_step
        values[_K6077] = _clipped(torque_nm / (self._nm_per_mille * step), _I16 // step) * step
        values[_K6074] = _clipped((self._torque_nm + self._offset_nm) / self._nm_per_mille, _I16)
        demand = _clipped(self._position_rad / self._rad_per_unit, _I32) if self.powered else values[_K6064]
        values[_K6062] = demand
        values[_K60F4] = _clipped(demand - values[_K6064], _I32)
        values[_K2030] = _clipped(plant.external_torque_nm * 1000.0, _I32)
        values[_K2031] = _clipped(plant.temperature_c * 10.0, _I16)

    @property
    def at_rest(self) -> bool:
        """Practically no speed."""
        return abs(self._plant.velocity_rad_s) < _STANDSTILL_RAD_S


class _Ramp:
    """Constant deceleration from a speed to rest."""

    def __init__(self, start_ns: int, from_rad: float, from_rad_s: float, rate_rad_s2: float) -> None:
        self._start_ns, self._from_rad, self._from_rad_s = start_ns, from_rad, from_rad_s
        self.rate_rad_s2 = rate_rad_s2
        self.end_ns = start_ns + round(abs(from_rad_s) / rate_rad_s2 / _NS)
        self.done = False

    def at(self, now_ns: int) -> tuple[float, float]:
        """Position and velocity commanded."""
        time_s = (min(now_ns, self.end_ns) - self._start_ns) * _NS
        slowdown = math.copysign(self.rate_rad_s2, self._from_rad_s)
        velocity_rad_s = self._from_rad_s - slowdown * time_s if now_ns < self.end_ns else 0.0
        return self._from_rad + self._from_rad_s * time_s - 0.5 * slowdown * time_s * time_s, velocity_rad_s


def _clipped(value: float, limit: int) -> int:
    return max(-limit, min(limit - 1, round(value))) if math.isfinite(value) else 0
