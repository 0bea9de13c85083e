"""The plant channel as a linear problem: residual = nuisance + columns of effects, weighted by what noise may explain.

Everything passes the one low-pass, is thinned, and is reduced to normal equations per log and block of time, so that
thousands of models are scored on held-out blocks without touching the samples again. *Nuisance* columns are what a
nominal model may be wrong about within its stated tolerances: they may take what they can inside hard bounds, never
more; without bounds, gravity and payload errors tie with them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.actuation import noise_rms
from frictid_hil.gap.generic import families
from frictid_hil.gap.residuals import LowPass, Recording, first_slide, rms, slip_state
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.inverse import Shape, View

FOLDS = 4
BLOCKS_PER_FOLD = 2
MODEL_FLOOR = 0.003
"""Torque that any model of friction may be wrong by, as a share of its Coulomb level."""
STUCK_FLOOR = 0.01
"""The same while the slip spring is winding."""
TIMING_S = 1.2e-4
"""Uncertainty of when a torque was sampled."""

Group = tuple[str, int]
"""(effect or family, shape's index)."""
EDGE_ROWS = 3
"""Thinned rows left out at either end of a log, where the filter has seen too little."""
ACTIVE_SET_STEPS = 20
"""Bounds are taken and let go so many times at most; a handful of nuisances settles in a few."""
FAMILY = "family "
"""Prefix of the generic families' names."""


@dataclass(frozen=True, slots=True)
class Nuisance:
    """A column that the nominal model's tolerance allows: its name, standard deviation and hard bound (shares)."""

    name: str
    deviation: float
    bound: float


NUISANCES = (
    Nuisance("inertia", 0.004, 0.0088),
    Nuisance("gravity", 0.004, 0.0088),
    Nuisance("coulomb", 0.004, 0.0088),
    Nuisance("rate", 0.008, 0.0176),
    Nuisance("payload inertia", 0.006, 0.0132),
    Nuisance("payload gravity", 0.006, 0.0132),
    Nuisance("timing", 1.5e-4, 3.3e-4),
    Nuisance("presliding stiffness", 0.02, 0.044),
    Nuisance("offset", 1.0, 2.2),
)


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations of some rows: X'X, X'y, y'y and their number."""

    gram: Array
    right: Array
    square: float
    rows: float

    def __add__(self, other: Normal) -> Normal:
        return Normal(
            self.gram + other.gram, self.right + other.right, self.square + other.square, self.rows + other.rows
        )

    def __sub__(self, other: Normal) -> Normal:
        return Normal(
            self.gram - other.gram, self.right - other.right, self.square - other.square, self.rows - other.rows
        )

    def misfit(self, columns: Sequence[int], weights: Array) -> float:
        """Sum of squares left by given coefficients."""
        at = np.asarray(columns)
        inner = self.gram[np.ix_(at, at)]
        return float(self.square - 2.0 * weights @ self.right[at] + weights @ inner @ weights)


class Evidence:
    """Scores of models of the plant channel.

    A model is a sequence of groups; nuisance columns are always in. Scores are log-likelihoods of held-out blocks of
    the identification logs (squares over variance, halved, correlation of neighbours allowed for).
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        encoder_step_rad: float,
        library: Sequence[str],
        noise_nm: float | None,
        *,
        tolerance_factor: float = 1.0,
        offset_nm: float = 0.0,
        late_s: float = 0.0,
        echoes_nm: Mapping[str, Array] | None = None,
    ) -> None:
        self.recordings = [r for r in recordings if r.view is not None and r.plant_nm is not None]
        views = [r.view for r in self.recordings if r.view is not None]
        self.low_pass = LowPass.at(1.0 / self.recordings[0].step_s)
        self.groups: dict[Group, tuple[int, ...]] = {}
        self._grid: dict[str, tuple[Shape, ...]] = {}
        parts: list[list[Array]] = [self._thin(_nuisance(views, offset_nm / tolerance_factor))]
        width = parts[0][0].shape[1]
        self._nuisances = tuple(range(width))
        for name, form in ((n, e.inverse) for n, e in all_effects().items() if n in library):
            if form is None:
                continue
            self._grid[name] = form.grid_for(views)
            for index, shape in enumerate(self._grid[name]):
                columns = self._thin(form.regressors(views, shape))
                # A column of nothing: the nominal joint lacks what this effect acts on.
                if not any(np.any(np.abs(part) > 1e-12) for part in columns):
                    continue
                parts.append(columns)
                count = parts[-1][0].shape[1]
                self.groups[name, index] = tuple(range(width, width + count))
                width += count
        for name, columns in families(views).items():
            parts.append(self._thin(columns))
            count = columns[0].shape[1]
            self.groups[FAMILY + name, 0] = tuple(range(width, width + count))
            width += count
        self._prior = np.array([1.0 / (tolerance_factor * n.deviation) ** 2 for n in NUISANCES])
        self._bound = tolerance_factor * np.array([n.bound for n in NUISANCES])
        if late_s > 0.0:
            # A drive whose torque is late reports it at a time known no better than that, or than half a sample.
            late_s = max(late_s, 0.5 * self.recordings[0].step_s)
            timing = [n.name for n in NUISANCES].index("timing")
            self._prior[timing] = min(self._prior[timing], late_s**-2)
            self._bound[timing] = max(self._bound[timing], 1.5 * late_s)
        self._views = views
        self._refined: dict[Group, dict[str, float]] = {}
        self._weigh(parts, encoder_step_rad, noise_nm, echoes_nm or {})
        self._reduce()

    def _thin(self, columns: Sequence[Array]) -> list[Array]:
        return [self.low_pass.thinned(part) for part in columns]

    def _weigh(
        self,
        parts: list[list[Array]],
        encoder_step_rad: float,
        noise_nm: float | None,
        echoes_nm: Mapping[str, Array],
    ) -> None:
        stride = self.low_pass.stride
        self.deviation_nm: list[Array] = []
        self.thin: list[tuple[Array, Array]] = []
        for k, recording in enumerate(self.recordings):
            view, residual = recording.view, recording.plant_nm
            assert view is not None and residual is not None
            table = np.concatenate([part[k] for part in parts] + self._thin([residual[:, None]]), axis=1)
            deviation = deviation_nm(recording, view, self.low_pass, encoder_step_rad, noise_nm)
            echo_nm = echoes_nm.get(recording.experiment.name)
            deviation = (deviation if echo_nm is None else np.hypot(deviation, echo_nm))[::stride]
            keep = slice(EDGE_ROWS, max(EDGE_ROWS + 1, table.shape[0] - EDGE_ROWS))
            self.deviation_nm.append(deviation[: table.shape[0]][keep])
            table = table[keep] / self.deviation_nm[-1][:, None]
            self.thin.append((table[:, :-1], table[:, -1]))

    @property
    def noise_nm(self) -> list[Array]:
        """Standard deviation that noise and any model's limits leave, per log, thinned, N m."""
        return self.deviation_nm

    def _reduce(self) -> None:
        stride = self.low_pass.stride
        independent = min(1.0, 2.0 * self.low_pass.cutoff_hz * stride / self.low_pass.rate_hz)
        by_fold: list[Normal | None] = [None] * FOLDS
        self.validation: dict[str, Normal] = {}
        for recording, (columns, residual) in zip(self.recordings, self.thin, strict=True):
            edges = np.linspace(0, residual.size, FOLDS * BLOCKS_PER_FOLD + 1).astype(int)
            for block in range(FOLDS * BLOCKS_PER_FOLD):
                rows = slice(edges[block], edges[block + 1])
                x, y = columns[rows], residual[rows]
                normal = Normal(
                    x.T @ x * independent, x.T @ y * independent, float(y @ y) * independent, y.size * independent
                )
                if recording.experiment.validation:
                    name = recording.experiment.name
                    self.validation[name] = self.validation[name] + normal if name in self.validation else normal
                else:
                    sofar = by_fold[block % FOLDS]
                    by_fold[block % FOLDS] = normal if sofar is None else sofar + normal
        self._folds = [f for f in by_fold if f is not None]
        self.fitted: Normal | None = sum(self._folds[1:], self._folds[0]) if self._folds else None
        self._rest = [self.fitted - fold for fold in self._folds] if self.fitted is not None else []

    def refine(self, effect: str, shape: dict[str, float]) -> Group:
        """Add one more shape of an effect, between the points of its grid; its group."""
        form = all_effects()[effect].inverse
        assert form is not None
        columns = self._thin(form.regressors(self._views, shape))
        for k, (table, residual) in enumerate(self.thin):
            added = columns[k][EDGE_ROWS : EDGE_ROWS + residual.size] / self.deviation_nm[k][:, None]
            self.thin[k] = (np.concatenate([table, added], axis=1), residual)
        width = self.thin[0][0].shape[1]
        group = (effect, len(self._grid[effect]) + len(self._refined))
        self.groups[group] = tuple(range(width - columns[0].shape[1], width))
        self._refined[group] = shape
        self._reduce()
        return group

    def probes(self, effect: str) -> tuple[Shape, ...]:
        """The effect's own grid for this joint; empty where the effect is not in the library."""
        return self._grid.get(effect, ())

    def shape(self, group: Group) -> dict[str, float]:
        """Nonlinear parameters of a group."""
        if group in self._refined:
            return self._refined[group]
        return dict(self._grid[group[0]][group[1]])

    def parameters(self, model: Sequence[Group]) -> dict[str, dict[str, float]]:
        """The effects' own parameters, fitted on all identification logs."""
        weights = self.coefficients(model)
        at = self._prior.size
        result = {}
        for group in model:
            form = all_effects()[group[0]].inverse
            assert form is not None
            count = len(self.groups[group])
            result[group[0]] = form.parameters(self.shape(group), weights[at : at + count])
            at += count
        return result

    def columns(self, model: Sequence[Group]) -> list[int]:
        """Column numbers of a model, nuisances first."""
        return [*self._nuisances, *(c for group in model for c in self.groups[group])]

    def score(self, model: Sequence[Group]) -> float:
        """Held-out log-likelihood of a model."""
        columns = self.columns(model)
        squares = 0.0
        for rest, fold in zip(self._rest, self._folds, strict=True):
            squares += fold.misfit(columns, self._solve(rest, columns))
        weights = self.coefficients(model)
        tolerance = float(np.sum(self._prior * weights[: self._prior.size] ** 2))
        return -0.5 * squares - 0.5 * tolerance

    def coefficients(self, model: Sequence[Group]) -> Array:
        """Coefficients fitted on all identification logs, nuisances first."""
        assert self.fitted is not None
        return self._solve(self.fitted, self.columns(model))

    def covariance(self, model: Sequence[Group]) -> Array:
        """Covariance of those coefficients, scaled by the misfit where that is more than noise."""
        assert self.fitted is not None
        columns = self.columns(model)
        inner = self.fitted.gram[np.ix_(columns, columns)].copy()
        inner[np.diag_indices(self._prior.size)] += self._prior
        inverse: Array = np.linalg.pinv(inner, hermitian=True)
        return inverse * max(1.0, self.misfit_ratio(model))

    def misfit_ratio(self, model: Sequence[Group]) -> float:
        """Held-out squares per row: 1 where noise and tolerances explain what is left."""
        assert self.fitted is not None
        return max(1e-9, -2.0 * self.score(model) / self.fitted.rows)

    def judged(self, model: Sequence[Group]) -> dict[str, float]:
        """Squares per row on each validation log, which no fit has seen."""
        columns, weights = self.columns(model), self.coefficients(model)
        return {name: normal.misfit(columns, weights) / normal.rows for name, normal in self.validation.items()}

    def explained_nm(self, index: int, model: Sequence[Group]) -> tuple[Array, Array]:
        """(what effects leave of recording ``index``, what there was), thinned and low-passed, N m.

        Nuisances are fitted beside the effects but not taken off: the gap of a nominal joint includes its tolerances.
        """
        x, y = self.thin[index]
        scale = self.deviation_nm[index]
        columns = self.columns(model)[self._prior.size :]
        weights = self.coefficients(model)[self._prior.size :]
        return (y - x[:, columns] @ weights) * scale, y * scale

    def judged_rows(self, model: Sequence[Group]) -> Array:
        """What model and tolerances leave of the validation logs (else of all), over noise, shape (m,)."""
        columns, weights = self.columns(model), self.coefficients(model)
        return np.concatenate([self.thin[k][1] - self.thin[k][0][:, columns] @ weights for k in self._judged()])

    def _judged(self) -> list[int]:
        chosen = [k for k, r in enumerate(self.recordings) if r.experiment.validation]
        return chosen or list(range(len(self.recordings)))

    def judged_nm(self, model: Sequence[Group]) -> float:
        """RMS that effects leave on the validation logs (on all where there are none), N m."""
        return rms(np.concatenate([self.explained_nm(k, model)[0] for k in self._judged()]))

    def shapes(self, effect: str) -> list[Group]:
        """All groups of one effect."""
        return [group for group in self.groups if group[0] == effect]

    def best_shape(self, effect: str, given: Sequence[Group] = ()) -> tuple[float, Group]:
        """(score, group) of the best shape of an effect beside given groups, among those that make physical sense."""
        ranked = sorted(((self.score([*given, group]), group) for group in self.shapes(effect)), reverse=True)
        for score, group in ranked[:5]:
            if self.sensible([*given, group]):
                return score, group
        # None does: then the effect explains nothing.
        return self.score(given), ranked[0][1]

    def sensible(self, model: Sequence[Group]) -> bool:
        """Whether the last group's first coefficient lies in its physical range."""
        form = all_effects()[model[-1][0]].inverse
        if form is None:
            return True
        low, high = form.first_coefficient
        first = self.coefficients(model)[-len(self.groups[model[-1]])]
        return bool(low <= first <= high)

    def _solve(self, normal: Normal, columns: Sequence[int]) -> Array:
        """Coefficients under the nuisances' priors and hard bounds (an active set)."""
        at = np.asarray(columns)
        bounded = self._prior.size
        inner = normal.gram[np.ix_(at, at)].copy()
        right = normal.right[at]
        diagonal = np.arange(at.size)
        inner[diagonal[:bounded], diagonal[:bounded]] += self._prior
        inner[diagonal[bounded:], diagonal[bounded:]] *= 1.0 + 1e-9
        inner[diagonal, diagonal] += 1e-12
        weights: Array = np.linalg.solve(inner, right)
        bound = self._bound
        if not np.any(np.abs(weights[:bounded]) > bound):
            return weights
        fixed = np.zeros(at.size, dtype=bool)
        for _ in range(ACTIVE_SET_STEPS):
            over = np.zeros(at.size, dtype=bool)
            over[:bounded] = ~fixed[:bounded] & (np.abs(weights[:bounded]) > bound * (1.0 + 1e-9))
            if over.any():
                weights[over] = np.sign(weights[over]) * bound[over[:bounded]]
                fixed |= over
            else:
                # A bound that pulls inwards was taken too early: scales that trade against each other do that.
                slope = inner @ weights - right
                inwards = fixed & (slope * weights > 1e-9 * np.abs(right).max() * np.abs(weights))
                if not inwards.any():
                    break
                fixed &= ~inwards
            free = ~fixed
            target = right[free] - inner[np.ix_(free, fixed)] @ weights[fixed]
            weights[free] = np.linalg.solve(inner[np.ix_(free, free)], target)
        weights[:bounded] = np.clip(weights[:bounded], -bound, bound)
        return weights


def deviation_nm(
    recording: Recording, view: View, low_pass: LowPass, encoder_step_rad: float, noise_nm: float | None
) -> Array:
    """Standard deviation that noise and the limits of any model give the low-passed plant residual, shape (n,)."""
    torque = recording.experiment.torque_nm
    assert torque is not None
    white = noise_nm
    if white is None:
        white = noise_rms(torque if recording.actuation_nm is None else recording.actuation_nm[2:])
    inertia = view.motor_inertia_kg_m2 + view.link_inertia_kg_m2 + view.payload_inertia_kg_m2
    encoder = inertia * encoder_step_rad / math.sqrt(12.0) * acceleration_gain(low_pass)
    stuck = np.clip(low_pass((np.abs(view.slip) < 0.999).astype(np.float64)), 0.0, 1.0)
    winding = 0.2 * (view.stiffness_nm_per_rad * encoder_step_rad) ** 2 / 12.0 + (STUCK_FLOOR * view.coulomb_nm) ** 2
    timing = TIMING_S * low_pass(np.gradient(view.torque_nm, view.step_s))
    variance = (white * low_pass.white_gain) ** 2 + encoder**2 + (MODEL_FLOOR * view.coulomb_nm) ** 2
    deviation: Array = np.sqrt(np.maximum(variance + timing**2 + stuck * winding, 1e-18))
    held = first_slide(view.position_rad, 3.0 * view.coulomb_nm / view.stiffness_nm_per_rad)
    deviation[:held] = np.hypot(deviation[:held], 0.3 * view.coulomb_nm)
    return deviation


def acceleration_gain(low_pass: LowPass) -> float:
    """RMS of the low-passed second difference quotient of white noise of unit RMS, 1/s^2."""
    b, a = signal.butter(4, low_pass.cutoff_hz / (0.5 * low_pass.rate_hz))
    frequency, response = signal.freqz(b, a, worN=2048)
    differenced = (2.0 - 2.0 * np.cos(frequency)) ** 2
    return float(np.sqrt(np.mean(np.abs(response) ** 4 * differenced)) * low_pass.rate_hz**2)


def _nuisance(views: Sequence[View], offset_nm: float) -> list[Array]:
    columns = []
    for v in views:
        stiffer = slip_state(v.position_rad, 1.05 * v.stiffness_nm_per_rad / v.coulomb_nm)
        columns.append(
            np.stack(
                [
                    (v.motor_inertia_kg_m2 + v.link_inertia_kg_m2) * v.acceleration_rad_s2,
                    v.gravity_nm if v.motor_inertia_kg_m2 + v.link_inertia_kg_m2 > 0.0 else v.load_nm,
                    v.coulomb_nm * v.slip,
                    v.rate_nm,
                    v.payload_inertia_kg_m2 * v.acceleration_rad_s2,
                    v.payload_gravity_nm,
                    np.gradient(v.torque_nm, v.step_s),
                    v.coulomb_nm * (stiffer - v.slip) / 0.05,
                    np.full(v.slip.size, offset_nm),
                ],
                axis=1,
            )
        )
    return columns


def gains(evidence: Evidence, models: Mapping[str, Sequence[Group]]) -> dict[str, float]:
    """Score of each model over the bare nominal one."""
    bare = evidence.score([])
    return {name: evidence.score(model) - bare for name, model in models.items()}
