"""A geared joint written a second time, sharing nothing with the product's simulation but the numbers of a robot file.

Where the product's own plant has an elasto-plastic spring, a saturating viscosity and one inertia, solved by an
implicit midpoint rule, this one has

    two inertias        motor and link on a spring (60 Hz) with gravity and the person on the link
    LuGre friction      z' = v - sigma0 |v| z / g(v),  f = sigma0 z + sigma1 z' + a |v|^0.7 sgn v, on the motor
    static friction     g(v) = Fc (1 + 0.25 exp(-|v / vs|)), vs = 3 deg/s, 4 % more forward than backward
    ripple              1 and 3 times per motor revolution
    integrator          the classical Runge-Kutta rule of fourth order, 0.1 ms

and a drive with the same loops, encoder, noise and cycle of delay. It stands behind the simulated bus in the place of
``ServoLoop``.
"""

from __future__ import annotations

import math
import random

from frictid_hil.simulation.joint import CoulombViscous, HandImpedance, JointModel

_SUBSTEP_S = 1e-4
_LINK_HZ = 60.0
_STATIC_SHARE, _STATIC_RAD_S = 0.25, math.radians(3.0)
_ASYMMETRY = 0.02
_POWER = 0.7
_RIPPLE_SHARE = 0.025
POSITION, TORQUE = 8, 10

State = tuple[float, float, float, float, float]
"""Motor position, motor velocity, link position, link velocity, bristle."""


class OtherPlant:
    """One joint under its drive; arguments as those of ``ServoLoop``.

    Args:
        model: numbers of the robot file; its effects are not looked at.
        period_s: of the drive's control loop.
        seed: of the noise on the reported torque.
        position_rad: where the joint stands at first, unpowered, brake engaged.
    """

    def __init__(self, model: JointModel, *, period_s: float = 0.001, seed: int = 0, position_rad: float = 0.0) -> None:
        friction = model.friction
        assert isinstance(friction, CoulombViscous)
        self._model = model
        self._period_s = period_s
        self._noise = random.Random(seed)
        share = model.motor_inertia_share
        self._motor, self._link = share * model.inertia_kg_m2, (1.0 - share) * model.inertia_kg_m2
        self._spring = self._link * (2 * math.pi * _LINK_HZ) ** 2
        self._spring_damping = 4e-4 * self._spring
        self._coulomb, self._viscous = friction.coulomb_nm, friction.viscous_nm_s_per_rad
        self._bristle = model.presliding_stiffness_nm_per_rad
        self._bristle_damping = 0.6 * math.sqrt(self._bristle * self._motor)
        self._hand: HandImpedance | None = None
        self._hand_at = (0.0, 0.0, 0.0)
        self._hand_time_s = 0.0
        self._limit_nm = model.drive.torque_limit_nm
        self._mode = POSITION
        self._powered, self._braked = False, True
        self._step_rad = model.encoder.step_rad(model.gear_ratio) or 1e-6
        twist = self._gravity(position_rad) / self._spring
        self._state: State = (position_rad, 0.0, position_rad - twist, 0.0, 0.0)
        self._target = position_rad
        self._integral = 0.0
        self._waiting_nm = 0.0
        self._applied_nm = 0.0
        self._reported_nm = 0.0
        self._external_nm = 0.0
        self.saturated = False
        self._counts = round(position_rad / self._step_rad)
        self._velocity = 0.0

    # -- what the drive's firmware asks for ----------------------------------------------------------------------------

    @property
    def model(self) -> JointModel:
        """Numbers of the robot file."""
        return self._model

    @property
    def position_counts(self) -> int:
        """Encoder counts, zero at joint position 0."""
        return self._counts

    @property
    def measured_position_rad(self) -> float:
        """The encoder's position."""
        return self._counts * self._step_rad

    @property
    def velocity_rad_s(self) -> float:
        """The drive's own estimate."""
        return self._velocity

    @property
    def true_velocity_rad_s(self) -> float:
        """Of the motor, which no drive sees."""
        return self._state[1]

    @property
    def torque_nm(self) -> float:
        """Mean over the last ``advance``, with noise."""
        return self._reported_nm

    @property
    def temperature_c(self) -> float:
        """At the gear."""
        return 25.0

    @property
    def external_torque_nm(self) -> float:
        """What a person applies to the link."""
        return self._external_nm

    def power(self, on: bool) -> None:
        """Switch the power stage; it begins with the torque that holds the joint."""
        if on and not self._powered:
            self._target = self.measured_position_rad
            self._integral = self._waiting_nm = self._gravity(self._state[2])
        self._powered = on

    def brake(self, engaged: bool) -> None:
        """Close or open the holding brake."""
        self._braked = engaged

    def set_mode(self, mode: int) -> None:
        """Position or torque, without a jump of torque."""
        if mode != self._mode:
            self._mode = mode
            self._target, self._integral = self.measured_position_rad, self._applied_nm

    def limits(self, torque_nm: float) -> None:
        """Lower the torque limit."""
        self._limit_nm = min(max(torque_nm, 0.0), self._model.drive.torque_limit_nm)

    def mount_payload(self, on: bool) -> None:
        """Nothing can be mounted."""

    def hold_hand(
        self,
        hand: HandImpedance | None,
        *,
        centre_rad: float = 0.0,
        amplitude_rad: float = 0.0,
        frequency_hz: float = 0.0,
    ) -> None:
        """Let a person guide the link; None lets go."""
        self._hand, self._hand_at, self._hand_time_s = hand, (centre_rad, amplitude_rad, frequency_hz), 0.0

    def advance(
        self,
        duration_s: float,
        *,
        position_rad: float | None = None,
        velocity_rad_s: float = 0.0,
        torque_nm: float = 0.0,
        torque_offset_nm: float = 0.0,
    ) -> None:
        """Let time pass, one control period after the other."""
        if duration_s <= 0.0:
            return
        periods = max(1, round(duration_s / self._period_s))
        step_s = duration_s / periods
        begin = self._target
        slope = 0.0 if position_rad is None else (position_rad - begin) / duration_s
        total_nm = 0.0
        for k in range(periods):
            if self._mode == POSITION:
                self._target = begin + slope * step_s * (k + 1)
                command_nm = self._position_loop(slope, step_s)
            else:
                command_nm = torque_nm
            limit = self._limit_nm
            wanted_nm = command_nm + torque_offset_nm
            self.saturated = abs(wanted_nm) > limit
            # What was decided in the last period is in force in this one.
            self._applied_nm, self._waiting_nm = self._waiting_nm, min(limit, max(-limit, wanted_nm))
            self._run(step_s, self._applied_nm if self._powered else 0.0)
            total_nm += self._applied_nm
        drive = self._model.drive
        noise_nm = self._noise.gauss(0.0, drive.torque_noise_per_mille * 1e-3 * drive.rated_torque_nm)
        self._reported_nm = total_nm / periods + noise_nm

    # -- the drive's loop ----------------------------------------------------------------------------------------------

    def _position_loop(self, command_rad_s: float, step_s: float) -> float:
        gains = self._model.servo
        error = self._target - self.measured_position_rad
        if not self.saturated:
            self._integral += gains.ki_nm_per_rad_s * error * step_s
        return self._integral + gains.kp_nm_per_rad * error + gains.kd_nm_s_per_rad * (command_rad_s - self._velocity)

    # -- physics -------------------------------------------------------------------------------------------------------

    def _gravity(self, link_rad: float) -> float:
        model = self._model
        return model.gravity_cos_nm * math.cos(link_rad) + model.gravity_sin_nm * math.sin(link_rad)

    def _person(self, link_rad: float, link_rad_s: float, time_s: float) -> float:
        if self._hand is None:
            return 0.0
        centre, amplitude, frequency = self._hand_at
        omega = 2 * math.pi * frequency
        where, speed = centre + amplitude * math.sin(omega * time_s), omega * amplitude * math.cos(omega * time_s)
        hand = self._hand
        return hand.stiffness_nm_per_rad * (where - link_rad) + hand.damping_nm_s_per_rad * (speed - link_rad_s)

    def _rates(self, state: State, torque_nm: float, time_s: float) -> State:
        motor, motor_v, link, link_v, bristle = state
        speed = abs(motor_v)
        level = self._coulomb * (1.0 + _STATIC_SHARE * math.exp(-speed / _STATIC_RAD_S))
        level *= 1.0 + (_ASYMMETRY if motor_v > 0.0 else -_ASYMMETRY)
        bristle_rate = motor_v - self._bristle * speed / level * bristle
        friction = self._bristle * bristle + self._bristle_damping * bristle_rate
        friction += math.copysign(self._viscous * speed**_POWER, motor_v)
        turn = motor * self._model.gear_ratio
        ripple = _RIPPLE_SHARE * self._coulomb * (math.sin(turn) + 0.5 * math.sin(3.0 * turn + 1.0))
        through = self._spring * (motor - link) + self._spring_damping * (motor_v - link_v)
        return (
            motor_v,
            (torque_nm - friction - ripple - through) / self._motor,
            link_v,
            (through - self._gravity(link) + self._person(link, link_v, time_s)) / self._link,
            bristle_rate,
        )

    def _run(self, duration_s: float, torque_nm: float) -> None:
        steps = max(1, math.ceil(duration_s / _SUBSTEP_S - 1e-6))
        h = duration_s / steps
        state, time_s = self._state, self._hand_time_s
        if self._braked:
            state = (state[0], 0.0, state[2], 0.0, state[4])
        else:
            for _ in range(steps):
                state = self._runge_kutta(state, torque_nm, time_s, h)
                time_s += h
        self._state = state
        self._hand_time_s += duration_s
        self._external_nm = self._person(state[2], state[3], self._hand_time_s)
        counts = math.floor(state[0] / self._step_rad + 0.5)
        moved_rad_s = (counts - self._counts) * self._step_rad / duration_s
        self._counts = counts
        blend = duration_s / (duration_s + self._model.drive.velocity_filter_s)
        self._velocity += blend * (moved_rad_s - self._velocity)

    def _runge_kutta(self, s: State, torque_nm: float, t: float, h: float) -> State:
        a = self._rates(s, torque_nm, t)
        b = self._rates(_moved(s, a, 0.5 * h), torque_nm, t + 0.5 * h)
        c = self._rates(_moved(s, b, 0.5 * h), torque_nm, t + 0.5 * h)
        d = self._rates(_moved(s, c, h), torque_nm, t + h)
        w = h / 6.0
        return (
            s[0] + w * (a[0] + 2 * b[0] + 2 * c[0] + d[0]),
            s[1] + w * (a[1] + 2 * b[1] + 2 * c[1] + d[1]),
            s[2] + w * (a[2] + 2 * b[2] + 2 * c[2] + d[2]),
            s[3] + w * (a[3] + 2 * b[3] + 2 * c[3] + d[3]),
            s[4] + w * (a[4] + 2 * b[4] + 2 * c[4] + d[4]),
        )


def _moved(s: State, r: State, h: float) -> State:
    return (s[0] + h * r[0], s[1] + h * r[1], s[2] + h * r[2], s[3] + h * r[3], s[4] + h * r[4])
