"""A simulated drive around one simulated joint, in joint-side numbers: its loops, its brake and its sensors, no bus.

A reading is latched at the end of every ``advance``; the torque is the mean of what was applied during it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from frictid_hil.errors import UsageError
from frictid_hil.simulation import packing, plant
from frictid_hil.simulation.compose import kernel
from frictid_hil.simulation.joint import HandImpedance, JointModel
from frictid_hil.simulation.replay import SUBSTEP_S

_NOISE_BLOCK = 4096


class _Read:
    """A number that was read at the end of the last ``advance``."""

    def __init__(self, slot: int) -> None:
        self._slot = slot

    def __get__(self, loop: ServoLoop, owner: type[ServoLoop]) -> float:
        return loop._row[self._slot]


class ServoLoop:
    """One joint under its drive; at first unpowered, brake engaged, where its encoder reads ``position_rad``.

    The seed is that of the noise on the reported torque, the period that of the drive's control loop.
    """

    measured_position_rad = _Read(plant.READ_POSITION)  # the encoder's
    position_rad = _Read(plant.READ_TRUE_POSITION)  # of the link
    true_velocity_rad_s = _Read(plant.READ_TRUE_VELOCITY)  # of the link
    velocity_rad_s = _Read(plant.READ_VELOCITY)  # the drive's own estimate
    external_torque_nm = _Read(plant.READ_EXTERNAL)  # what a person applies to the link
    temperature_c = _Read(plant.READ_TEMPERATURE)  # at the gear

    def __init__(self, model: JointModel, *, period_s: float = 0.001, seed: int = 0, position_rad: float = 0.0) -> None:
        self.model = model
        self._kernel = kernel()
        self._parameters = packing.parameters(model)
        self._state = packing.state()
        self._step_rad = model.encoder.step_rad(model.gear_ratio)
        self.mode = plant.POSITION_MODE  # as ``set_mode`` has set it
        self._target_rad = position_rad
        self._noise_nm = model.drive.torque_noise_per_mille * 1e-3 * model.drive.rated_torque_nm
        self._random = np.random.default_rng(seed)
        self._noise: list[float] = []
        self._torque_noise_nm = 0.0
        self.period_s = period_s
        self._kernel.place(self._parameters, self._state, float(position_rad))
        self._parameters[plant.POWERED] = 0.0
        self._parameters[plant.BRAKED] = 1.0
        self.substeps, self.step_s = 1, period_s  # of one control period
        self.commands = np.zeros((0, plant.COMMANDS))  # what the coming control periods are told, one a row
        self.readings = np.zeros((0, plant.READINGS))  # what they read
        self._row = [0.0] * plant.READINGS
        self._row[plant.READ_POSITION] = self._state[plant.MEASURED]
        self._row[plant.READ_TRUE_POSITION] = self._state[plant.LINK_POSITION]
        self._row[plant.READ_TEMPERATURE] = 25.0

    @property
    def period_s(self) -> float:
        """Period of the control loop; may be set between two calls of ``advance``."""
        return self._period_s

    @period_s.setter
    def period_s(self, period_s: float) -> None:
        if not (math.isfinite(period_s) and period_s > 0):
            raise UsageError(f"a control period must be positive, got {period_s} s")
        self._period_s = period_s
        self._duration_s = math.nan

    def power(self, on: bool) -> None:
        """Switch the power stage; switched on, the loop starts with the torque that holds the joint."""
        was_on = self._parameters[plant.POWERED] != 0.0
        self._parameters[plant.POWERED] = float(on)
        if on and not was_on:
            self._take_over(self._kernel.holding_torque(self._parameters, self._state))

    def brake(self, engaged: bool) -> None:
        """Close or open the holding brake."""
        self._parameters[plant.BRAKED] = float(engaged)

    def set_mode(self, mode: int) -> None:
        """8 position, 9 velocity, 10 torque (CiA-402, 6060), without a jump of torque; ``UsageError`` for others."""
        if mode not in (plant.POSITION_MODE, plant.VELOCITY_MODE, plant.TORQUE_MODE):
            raise UsageError(f"no such mode: {mode}; there are 8 (position), 9 (velocity), 10 (torque)")
        if mode != self.mode:
            self.mode = mode
            self._take_over(self._row[plant.READ_TORQUE])

    def limits(self, torque_nm: float) -> None:
        """Lower the torque limit; never above what the drive can give."""
        self._parameters[plant.TORQUE_LIMIT] = min(max(torque_nm, 0.0), self.model.drive.torque_limit_nm)

    def mount_payload(self, on: bool) -> None:
        """Mount or take off the payload, if the joint has one."""
        packing.mount(self._parameters, self.model, on)

    def hold_hand(
        self,
        hand: HandImpedance | None,
        *,
        centre_rad: float = 0.0,
        amplitude_rad: float = 0.0,
        frequency_hz: float = 0.0,
    ) -> None:
        """Let a person guide the link along centre + amplitude * sin(2 pi frequency t), t from now; None lets go."""
        vector = self._parameters
        self._state[plant.TIME] = 0.0
        vector[plant.HAND_STIFFNESS] = 0.0 if hand is None else hand.stiffness_nm_per_rad
        vector[plant.HAND_DAMPING] = 0.0 if hand is None else hand.damping_nm_s_per_rad
        vector[plant.HAND_CENTRE] = centre_rad
        vector[plant.HAND_AMPLITUDE] = amplitude_rad
        vector[plant.HAND_FREQUENCY] = frequency_hz

    def advance(
        self,
        duration_s: float,  # divided into control periods as near to ``period_s`` as goes; 0 or less: nothing happens
        *,
        position_rad: float | None = None,  # target at the end, approached linearly; None keeps it
        velocity_rad_s: float = 0.0,  # target in velocity mode
        torque_nm: float = 0.0,  # target in torque mode
        torque_offset_nm: float = 0.0,  # added in every mode
    ) -> None:
        """Let time pass."""
        if duration_s <= 0.0:
            return
        self.command(duration_s, position_rad, velocity_rad_s, torque_nm, torque_offset_nm)
        self._kernel.run(
            self._parameters, self._state, self.commands, self.readings, self.mode, self.substeps, self.step_s
        )
        self.read()

    def command(
        self,
        duration_s: float,
        position_rad: float | None,
        velocity_rad_s: float,
        torque_nm: float,
        torque_offset_nm: float,
    ) -> None:
        """The first part of ``advance``: what every control period is told (``commands``)."""
        if not abs(duration_s - self._duration_s) <= 1e-12:
            self._prepare(duration_s)
        if position_rad is None:
            position_rad = self._target_rad
        commands = self.commands
        if self.mode == plant.POSITION_MODE:
            velocity_rad_s = (position_rad - self._target_rad) / duration_s
            self._target_rad = position_rad
            if len(commands) > 1:
                commands[:, 0] = position_rad + (self._ramp - 1.0) * (velocity_rad_s * duration_s)
                commands[:, 1:] = velocity_rad_s, torque_nm, torque_offset_nm
        elif len(commands) > 1:
            commands[:] = position_rad, velocity_rad_s, torque_nm, torque_offset_nm
        if len(commands) == 1:
            row = commands[0]
            row[0] = position_rad
            row[1] = velocity_rad_s
            row[2] = torque_nm
            row[3] = torque_offset_nm

    def read(self) -> None:
        """The last part of ``advance``: latch what the control periods have read (``readings``)."""
        self._row = self.readings[-1].tolist()
        if len(self.readings) > 1:
            self._row[plant.READ_TORQUE] = float(self.readings[:, plant.READ_TORQUE].mean())
        if not self._noise:
            self._noise = (self._random.standard_normal(_NOISE_BLOCK) * self._noise_nm).tolist()
        self._torque_noise_nm = self._noise.pop()

    @staticmethod
    def shared_rows(joints: Sequence[ServoLoop]) -> tuple[packing.Vector, packing.Vector]:
        """Let the joints' parameters and states live in the rows of two matrices, shapes (n, ...), for an arm."""
        parameters = np.zeros((len(joints), max(joint._parameters.size for joint in joints)))
        states = np.zeros((len(joints), joints[0]._state.size))
        for joint, row, state in zip(joints, parameters, states, strict=True):
            row[: joint._parameters.size] = joint._parameters
            state[:] = joint._state
            joint._parameters, joint._state = row, state
        return parameters, states

    def place_again(self) -> None:
        """Relax where the encoder stands, with the parameters of now."""
        self._kernel.place(self._parameters, self._state, float(self._row[plant.READ_POSITION]))

    @property
    def position_counts(self) -> int:
        """Encoder counts, zero at joint position 0; micro-radians where the encoder is continuous."""
        return round(self._row[plant.READ_POSITION] / (self._step_rad or 1e-6))

    @property
    def torque_nm(self) -> float:
        """Torque as reported: mean of the last ``advance``, with noise, not rounded to the drive's steps."""
        return self._row[plant.READ_TORQUE] + self._torque_noise_nm

    @property
    def following_error_rad(self) -> float:
        """Last position target minus encoder position; 0 outside position mode."""
        return self._target_rad - self._row[plant.READ_POSITION] if self.mode == plant.POSITION_MODE else 0.0

    @property
    def saturated(self) -> bool:
        """The torque limit was active at the end of the last ``advance``."""
        return self._row[plant.READ_SATURATED] != 0.0

    def _take_over(self, torque_nm: float) -> None:
        """Continue from here with this torque."""
        self._target_rad = self._row[plant.READ_POSITION]
        self._state[plant.INTEGRAL] = torque_nm

    def _prepare(self, duration_s: float) -> None:
        """Sizes of one call of the kernel for this duration."""
        periods = max(1, round(duration_s / self._period_s))
        self.substeps = max(1, math.ceil(duration_s / periods / SUBSTEP_S - 1e-6))
        self.step_s = duration_s / periods / self.substeps
        self._ramp = np.arange(1, periods + 1) / periods
        self.commands = np.zeros((periods, plant.COMMANDS))
        self.readings = np.zeros((periods, plant.READINGS))
        self._duration_s = duration_s
