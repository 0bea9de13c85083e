"""The actuation channel: effects of the drive, each fitted as the drive would do it.

Between the controller's demand and the reported torque there is nothing but the drive, so a candidate predicts the
reported torque sample by sample. Candidates are added one by one while the prediction gets much better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import optimize

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Controller
from frictid_hil.gap.residuals import LowPass, Recording, demand_of, rms, settled
from frictid_hil.simulation.drive_form import ActuationForm, DriveView
from frictid_hil.simulation.effects import all_effects

BLOCK_S = 0.1
"""Length of the blocks that a log is cut into where it must be fitted and judged at once.

Several times what the low-pass smears, and short enough that a peak of the demand reaches into two of them.
"""
CLEARED = 0.7
"""Share of one log's low-passed squares that a candidate may leave to be taken though all logs show it little."""


def _forms() -> dict[str, ActuationForm]:
    """Every effect's form in this channel, in the order in which they act."""
    forms = {name: effect.actuation for name, effect in all_effects().items() if effect.actuation is not None}
    return dict(sorted(forms.items(), key=lambda item: item[1].order))


def velocity_lag_s(effects: Mapping[str, Mapping[str, float]]) -> float:
    """Time constant by which effects let the controller's velocity lag."""
    return sum(
        effects[name].get(form.parameter, 0.0)
        for name, form in _forms().items()
        if form.torque is None and name in effects
    )


def late_s(effects: Mapping[str, Mapping[str, float]]) -> float:
    """Time by which effects let the torque come late."""
    return sum(
        effects[name].get(form.parameter, 0.0) for name, form in _forms().items() if form.late and name in effects
    )


@dataclass(frozen=True, slots=True)
class Drive:
    """What stands between demand and reported torque: parameters by effect."""

    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def velocity_lag_s(self) -> float:
        """Extra lag of the velocity that the controller sees."""
        return velocity_lag_s(self.effects)

    @property
    def late_s(self) -> float:
        """Time by which the torque comes late."""
        return late_s(self.effects)

    def reported(self, demand_nm: Array, step_s: float, limit_nm: float) -> Array:
        """Torque reported for a demand in force from each sample on: the mean over the step before, shape (n,)."""
        torque = np.concatenate([demand_nm[:1], demand_nm[:-1]])
        for name, form in _forms().items():
            if name in self.effects and form.torque is not None:
                values = self.effects[name]
                value = values[form.parameter]
                if value != all_effects()[name].off[form.parameter]:
                    detail = (values.get(form.detail, form.details[0]),) if form.detail else ()
                    torque = form.torque(torque, value, step_s, limit_nm, *detail)
        return torque

    def with_effect(self, name: str, value: float) -> Drive:
        """The drive with one effect set."""
        return Drive({**self.effects, name: {**self.effects.get(name, {}), _forms()[name].parameter: value}})

    def with_detail(self, name: str, value: float) -> Drive:
        """The drive with one effect's detail set."""
        return Drive({**self.effects, name: {**self.effects[name], _forms()[name].detail: value}})


@dataclass(frozen=True, slots=True)
class ActuationFit:
    """What the actuation channel says.

    Attributes:
        nominal: the drive that the nominal joint believes in.
        drive: the fitted one.
        found: effect name -> score gained on the identification logs when it was taken in, in the order of taking.
        rivals: effect name -> the same for the candidates not taken, relative to what was taken in their place.
        ratio: by log name, low-passed residual over what white noise of its high frequencies would leave.
        before_ratio: the same without the found effects.
        intervals: effect name -> half width of a 95 % interval of its parameter.
        motion_ratio: what is left while the demand changes fast over what is left while it rests; noise gives 1.
        judged_in_blocks: effects that show in no identification log; fitted on every other block of the validation
            logs, judged on the blocks between.
        shows_in: effect name -> logs in which it clears the low-passed residual, judged on blocks that did not fit it.
    """

    nominal: Drive
    drive: Drive
    found: Mapping[str, float]
    rivals: Mapping[str, float] = field(default_factory=dict)
    ratio: Mapping[str, float] = field(default_factory=dict)
    before_ratio: Mapping[str, float] = field(default_factory=dict)
    intervals: Mapping[str, float] = field(default_factory=dict)
    motion_ratio: float = 1.0
    judged_in_blocks: tuple[str, ...] = ()
    shows_in: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def residual(self, recording: Recording, controller: Controller) -> Array:
        """A of one recording with the fitted drive."""
        return residual(recording, controller, self.drive)


def residual(recording: Recording, controller: Controller, drive: Drive) -> Array:
    """Reported torque minus what controller and drive predict, N m, shape (n,)."""
    assert recording.experiment.torque_nm is not None
    demand = demand_of(controller, recording.experiment, recording.step_s, drive.velocity_lag_s)
    predicted = drive.reported(demand, recording.step_s, controller.torque_limit_nm)
    return settled(recording.experiment.torque_nm - predicted, recording.step_s)


def noise_rms(values: Array) -> float:
    """RMS of the white part, from third-order differences of what is already nearly free of motion."""
    if values.size < 8:
        return 0.0
    return float(np.std(np.diff(values, 2)) / math.sqrt(6.0))


def fit_actuation(
    recordings: Sequence[Recording],
    controller: Controller,
    nominal: Drive,
    library: Sequence[str],
    seen: Mapping[str, float],
    least_gain: float = 25.0,
    least_share: float = 0.04,
) -> ActuationFit:
    """Explain the actuation residual of the identification logs by as few effects as it takes.

    Args:
        recordings: all logs of the set.
        controller: the nominal one.
        nominal: the drive the nominal joint believes in.
        library: names of the effects that may be used.
        seen: effect name -> value found in the kinematic channel; the controller may see the motion so, too.
        least_gain: score below which a candidate is not taken.
        least_share: share of the residual's squares that a candidate must remove.
    """
    logs = [r for r in recordings if r.actuation_nm is not None]
    fitted = [r for r in logs if not r.experiment.validation]
    demands: dict[tuple[str, float], Array] = {}

    def demand(recording: Recording, lag_s: float) -> Array:
        key = (recording.experiment.name, lag_s)
        if key not in demands:
            demands[key] = demand_of(controller, recording.experiment, recording.step_s, lag_s)
        return demands[key]

    def left(drive: Drive, recording: Recording) -> Array:
        assert recording.experiment.torque_nm is not None
        demanded = demand(recording, drive.velocity_lag_s)
        predicted = drive.reported(demanded, recording.step_s, controller.torque_limit_nm)
        return settled(recording.experiment.torque_nm - predicted, recording.step_s)

    def squares(drive: Drive) -> float:
        return float(sum(np.sum(left(drive, r) ** 2) for r in fitted))

    def clears(before: Drive, after: Drive) -> bool:
        # What shows in few logs or few rows (clipping) drowns in the white noise of all of them.
        for r in fitted:
            low_pass = LowPass.at(1.0 / r.step_s)
            if rms(low_pass(left(after, r))) ** 2 < CLEARED * rms(low_pass(left(before, r))) ** 2:
                return True
        return False

    rows = sum(r.experiment.position_rad.size for r in fitted)
    drive, found, rivals = nominal, dict[str, float](), dict[str, float]()
    current = squares(nominal)
    for _ in range(3):
        tried: dict[str, tuple[float, Drive]] = {}
        views = [_view(r, controller, demand(r, drive.velocity_lag_s)) for r in fitted]
        for name, form in _forms().items():
            if name in found or name not in library:
                continue
            candidate = _best(name, drive, squares, form.guesses(views, seen.get(name)))
            if candidate is not None:
                tried[name] = candidate
        if not tried:
            break
        name, (least, best) = min(tried.items(), key=lambda item: item[1][0])
        gain = 0.5 * rows * math.log(current / max(least, 1e-300))
        if gain < least_gain or (least > (1.0 - least_share) * current and not clears(drive, best)):
            break
        if not found:
            rivals = {other: 0.5 * rows * math.log(current / value) / gain for other, (value, _) in tried.items()}
        found[name] = gain
        drive, current = _detailed(name, best, least, squares)
    in_blocks: tuple[str, ...] = ()
    hidden = _in_validation_alone(logs, drive, controller, [n for n in library if n not in found], seen, demand, left)
    if hidden is not None:
        name, found[name], drive = hidden
        in_blocks = (name,)
        current = squares(drive)
    views = [_view(r, controller, demand(r, drive.velocity_lag_s)) for r in logs]
    shows_in = {
        name: _shows_in(name, drive, logs, _near(drive, name, _forms()[name].guesses(views, seen.get(name))), left)
        for name in found
    }
    gain_of_noise = {r.experiment.name: LowPass.at(1.0 / r.step_s) for r in logs}

    def ratios(which: Drive) -> dict[str, float]:
        out = {}
        for r in logs:
            low_pass = gain_of_noise[r.experiment.name]
            rest = left(which, r)[2:]
            floor = low_pass.white_gain * noise_rms(rest)
            out[r.experiment.name] = rms(low_pass(rest)) / floor if floor > 0.0 else math.inf
        return out

    return ActuationFit(
        nominal,
        drive,
        found,
        {k: v for k, v in rivals.items() if k not in found},
        ratios(drive),
        ratios(nominal),
        _intervals(drive, [name for name in found if name not in in_blocks], squares, current, rows),
        _motion_ratio([(demand(r, drive.velocity_lag_s), left(drive, r), r.step_s) for r in logs]),
        in_blocks,
        shows_in,
    )


def _near(drive: Drive, name: str, guesses: Array) -> Array:
    """The guesses around the value that was found, so that few need to be tried again."""
    if guesses.size <= 3:
        return guesses
    value = drive.effects[name][_forms()[name].parameter]
    at = int(np.clip(np.searchsorted(guesses, value), 1, guesses.size - 2))
    return guesses[at - 1 : at + 2]


def _motion_ratio(channels: Sequence[tuple[Array, Array, float]]) -> float:
    """RMS left in the fastest seventh of the demand over that in its slowest third, all logs together.

    The noise of a torque sensor does not care how fast the demand changes; a command path that loses some does.
    """
    rates, rests = [], []
    for demand_nm, rest_nm, step_s in channels:
        low_pass = LowPass.at(1.0 / step_s)
        rates.append(np.abs(low_pass(np.gradient(low_pass(demand_nm), step_s)))[5:-5])
        rests.append(rest_nm[5:-5])
    rate, rest = np.concatenate(rates), np.concatenate(rests)
    slow, fast = np.quantile(rate, [0.3, 0.85])
    quiet = rms(rest[rate <= slow])
    return rms(rest[rate >= fast]) / quiet if quiet > 0.0 else 1.0


def _in_validation_alone(
    logs: Sequence[Recording],
    drive: Drive,
    controller: Controller,
    names: Sequence[str],
    seen: Mapping[str, float],
    demand: Callable[[Recording, float], Array],
    left: Callable[[Drive, Recording], Array],
) -> tuple[str, float, Drive] | None:
    """(effect, its score on blocks not fitted, drive) of an effect that shows in validation logs alone, if there is.

    A demand that no identification log reached says nothing about a limit there; one block in two of the validation
    logs is fitted, and the others must confirm it.
    """
    judged = [r for r in logs if r.experiment.validation]
    if not judged:
        return None
    left_of = {r.experiment.name: r for r in judged}
    views = [_view(r, controller, demand(r, drive.velocity_lag_s)) for r in judged]
    before = _by_block(judged, drive, left)
    tried = []
    for name, form in _forms().items():
        if name not in names:
            continue
        candidate = _best(
            name,
            drive,
            lambda which: sum(even for even, _ in _by_block(judged, which, left).values()),
            form.guesses(views, seen.get(name)),
        )
        if candidate is None:
            continue
        after = _by_block(judged, candidate[1], left)
        cleared = [n for n in left_of if all(new < CLEARED * old for new, old in zip(after[n], before[n], strict=True))]
        if cleared:
            tried.append((sum(odd for _, odd in after.values()), name, candidate[1]))
    if not tried:
        return None
    _, name, best = min(tried, key=lambda t: t[0])
    best, _ = _detailed(name, best, math.inf, lambda w: sum(even for even, _ in _by_block(judged, w, left).values()))
    least = sum(odd for _, odd in _by_block(judged, best, left).values())
    rows = sum(r.experiment.position_rad.size for r in judged) // 2
    unseen = sum(odd for _, odd in before.values())
    return name, 0.5 * rows * math.log(unseen / max(least, 1e-300)), best


def _by_block(
    logs: Sequence[Recording], drive: Drive, left: Callable[[Drive, Recording], Array]
) -> dict[str, tuple[float, float]]:
    """By log: low-passed squares that a drive leaves in (every other block, the blocks between)."""
    out = {}
    for r in logs:
        squares = LowPass.at(1.0 / r.step_s)(left(drive, r)) ** 2
        odd = (np.arange(squares.size) * r.step_s / BLOCK_S).astype(int) % 2 == 1
        out[r.experiment.name] = (float(np.sum(squares[~odd])), float(np.sum(squares[odd])))
    return out


def _shows_in(
    name: str,
    drive: Drive,
    logs: Sequence[Recording],
    guesses: Array,
    left: Callable[[Drive, Recording], Array],
) -> tuple[str, ...]:
    """Logs whose residual one effect clears, its value fitted on every other block and judged on those between."""
    without = Drive({n: v for n, v in drive.effects.items() if n != name})
    candidate = _best(name, drive, lambda which: sum(e for e, _ in _by_block(logs, which, left).values()), guesses)
    if candidate is None:
        return ()
    before, after = _by_block(logs, without, left), _by_block(logs, candidate[1], left)
    return tuple(n for n in before if after[n][1] < CLEARED * before[n][1])


def _view(recording: Recording, controller: Controller, demand_nm: Array) -> DriveView:
    torque = recording.experiment.torque_nm
    assert torque is not None
    return DriveView(recording.step_s, controller.torque_limit_nm, demand_nm, torque)


def _best(name: str, drive: Drive, squares: Callable[[Drive], float], grid: Array) -> tuple[float, Drive] | None:
    """(squares left, drive) of the best value of one effect; None where it cannot show."""
    if grid.size == 0:
        return None
    costs = [squares(drive.with_effect(name, float(value))) for value in grid]
    k = int(np.argmin(costs))
    if grid.size == 1:
        return costs[0], drive.with_effect(name, float(grid[0]))
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
    off = all_effects()[name].off[_forms()[name].parameter]
    if k == 0 and off < low:
        low = off
    found = optimize.minimize_scalar(
        lambda value: squares(drive.with_effect(name, float(value))),
        bounds=(low, high),
        method="bounded",
        options={"maxiter": 14},
    )
    value, cost = (float(found.x), float(found.fun)) if found.fun < costs[k] else (float(grid[k]), costs[k])
    return cost, drive.with_effect(name, value)


def _detailed(name: str, drive: Drive, least: float, squares: Callable[[Drive], float]) -> tuple[Drive, float]:
    """(the drive with the best detail of one effect, its value fitted again, squares left)."""
    form = _forms()[name]
    value = drive.effects[name][form.parameter]
    around = value * np.linspace(0.97, 1.09, 7)
    for detail in form.details:
        candidate = _best(name, drive.with_effect(name, value).with_detail(name, detail), squares, around)
        if candidate is not None and candidate[0] < least:
            least, drive = candidate
    return drive, least


def structured_share(recordings: Sequence[Recording], controller: Controller, drive: Drive) -> float:
    """Share of what the drive leaves of the actuation channel that follows command and motion, held out.

    Noise follows neither. What does is a fault of the command path that no effect describes (a wrong gain, say).
    """
    logs = [r for r in recordings if r.actuation_nm is not None]
    fit, judge = [], []
    for recording in logs:
        e = recording.experiment
        assert e.position_command_rad is not None
        low_pass = LowPass.at(1.0 / recording.step_s)
        error = e.position_command_rad - e.position_rad
        velocity = np.gradient(e.position_rad, recording.step_s)
        demand = demand_of(controller, e, recording.step_s, drive.velocity_lag_s)
        columns = np.stack(
            [
                error,
                np.cumsum(error) * recording.step_s,
                np.gradient(e.position_command_rad, recording.step_s),
                velocity,
                np.sign(velocity),
                demand - demand[0],
                np.gradient(demand, recording.step_s),
                np.ones_like(error),
            ],
            axis=1,
        )
        table = low_pass(np.concatenate([columns, residual(recording, controller, drive)[:, None]], axis=1))[5:-5:4]
        half = table.shape[0] // 2
        fit.append(table[:half])
        judge.append(table[half:])
    explained = total = 0.0
    for one, other in ((fit, judge), (judge, fit)):
        known, unseen = np.concatenate(one), np.concatenate(other)
        scale = np.maximum(np.std(known[:, :-1], axis=0), 1e-12)
        scale[-1] = 1.0
        weights = np.linalg.lstsq(known[:, :-1] / scale, known[:, -1], rcond=None)[0]
        left = unseen[:, -1] - unseen[:, :-1] / scale @ weights
        total += float(np.sum(unseen[:, -1] ** 2))
        explained += float(np.sum(unseen[:, -1] ** 2) - np.sum(left**2))
    return max(0.0, explained / total) if total > 0.0 else 0.0


def _intervals(
    drive: Drive, found: Sequence[str], squares: Callable[[Drive], float], least: float, rows: int
) -> dict[str, float]:
    """95 % half widths from the curvature of the squares at the fit."""
    widths = {}
    for name in found:
        value = drive.effects[name][_forms()[name].parameter]
        h = 0.02 * value
        bend = squares(drive.with_effect(name, value + h)) + squares(drive.with_effect(name, value - h))
        bend -= 2.0 * least
        variance = least / rows
        widths[name] = 1.96 * math.sqrt(2.0 * variance * h * h / bend) if bend > 0.0 else math.inf
    return widths
