"""The equation error of a null model with all states measured, and the columns of candidates in it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

import casadi_engine as ce
from hidden_terms.kind import Kind, Task
from hidden_terms.records import Case, noisy

# Smoothing of states and their rates: samples of a window, order of its polynomial. The best one is taken for each
# state, known from the truth.
_WINDOWS, _ORDER = (5, 7, 11, 15, 25, 41), 3
_DEGREE = 3
# A feature stands for a term if they correlate by this much.
_SAME = 0.99


@dataclass(frozen=True)
class EquationError:
    """Equations one below the other, each divided by the standard deviation of what the null model leaves of it.

    target (M,), nuisance (M, free parameters), candidates : name -> columns (M,), by nuisance value
    residual, rates (N, n) : unweighted equation error and derivatives; features (N, F) of unit size, for PySINDy
    forcing : name -> columns (N, n) unweighted; null (N, n) : the null model's rates; slopes : (N, n) of parameters
    window : mean samples of the smoothing
    """

    target: np.ndarray
    nuisance: np.ndarray
    candidates: Mapping[str, Sequence[np.ndarray]]
    residual: np.ndarray
    rates: np.ndarray
    features: np.ndarray
    forcing: Mapping[str, Sequence[np.ndarray]]
    null: np.ndarray
    slopes: Sequence[np.ndarray]
    window: float

    @property
    def count(self) -> float:
        """Effective samples: smoothed rates are alike over half a window."""
        return len(self.target) / (self.window / 2)

    def left(self, target: np.ndarray, base: np.ndarray) -> np.ndarray:
        if not base.shape[1]:
            return target
        return target - base @ np.linalg.lstsq(base, target, rcond=None)[0]

    def gain(self, left: np.ndarray, base: np.ndarray, column: np.ndarray) -> float:
        """Sum of squares that is left with one more column."""
        own = self.left(column, base)
        size = float(own @ own)
        if size < 1e-6 * float(column @ column) or size == 0:
            return float(left @ left)
        return float(left @ left) - float(own @ left) ** 2 / size

    def bic_of(self, squares: float, terms: int) -> float:
        return self.count * math.log(squares / len(self.target)) + terms * math.log(self.count)

    def bic(self, left: np.ndarray, terms: int) -> float:
        return self.bic_of(float(left @ left), terms)

    def features_of(self, kind: Kind, task: Task, case: Case) -> np.ndarray | None:
        """(n, F) the features that stand for the hidden terms; None where one has none."""
        found = np.zeros((self.rates.shape[1], self.features.shape[1]), bool)
        for name in task.deleted:
            hit = False
            for column in self.forcing.get(name, ()):
                own = self._same(column)
                if own is not None:
                    found |= own
                    hit = True
                    break
            if not hit:
                return None
        return found

    def _same(self, column: np.ndarray) -> np.ndarray | None:
        """Where a forcing (N, n) is a single feature in each equation that it enters; None where it is not."""
        found = np.zeros((column.shape[1], self.features.shape[1]), bool)
        for k in range(column.shape[1]):
            size = np.linalg.norm(column[:, k])
            if size < 1e-12:
                continue
            alike = np.abs(column[:, k] @ self.features) / size / np.linalg.norm(self.features, axis=0)
            if alike.max() < _SAME:
                return None
            found[k, int(alike.argmax())] = True
        return found if found.any() else None

    def needed(self, share: float, residual: bool) -> np.ndarray:
        """(n, F) the features that the null model's own terms need: they are no wrong names."""
        found = np.zeros((self.rates.shape[1], self.features.shape[1]), bool)
        columns = [*self.slopes] if residual else [*self.slopes, self.null]
        for column in columns:
            for k in range(column.shape[1]):
                size = np.linalg.norm(column[:, k])
                if size > 1e-12:
                    fitted = np.linalg.lstsq(self.features, column[:, k] / size, rcond=None)[0]
                    found[k] |= np.abs(fitted) * math.sqrt(len(column)) > share
        return found


def equation_error(case: Case, task: Task) -> EquationError:
    """States with the task's noise, smoothed; what the null model, fitted to the record, leaves of their rates."""
    fit = ce.estimate(case.model, case.data, parameters=case.parameters, progress=False)
    model, time = case.model, case.data[task.outputs[0]].time
    step = float(np.median(np.diff(time)))
    rng = task.rng("states")
    smooth, rates, windows = np.empty_like(case.states), np.empty_like(case.states), []
    for k, clean in enumerate(case.states.T):
        sigma = max(float(np.std(clean)), 1e-12) * 10 ** (-task.snr / 20)
        measured, true = noisy(clean, sigma, task.noise, rng), CubicSpline(time, clean)(time, 1)
        tried = {w: savgol_filter(measured, w, _ORDER, deriv=1, delta=step) for w in _WINDOWS}
        best = min(tried, key=lambda w: float(np.mean((tried[w] - true) ** 2)))
        smooth[:, k], rates[:, k] = savgol_filter(measured, best, _ORDER), tried[best]
        windows.append(best)
    inputs = np.column_stack(
        [np.interp(time, case.data[one.name].time, case.data[one.name].values) for one in model.inputs]
    )
    numbers = np.array(model.parameter_vector(fit.parameters), float).ravel()
    found = _evaluated(model, case, fit, smooth, inputs, time, numbers)
    residual = rates - found["null"]
    free = [one.name for one in model.declarations if case.parameters[one.name].vary]
    rows = [k for k, one in enumerate(model.declarations) if one.name in free]
    fixed = {one.name: k for k, one in enumerate(model.declarations) if one.name not in free}
    slopes = [found["slopes"][k] for k in rows]
    forcing = dict(found["forcing"])
    for name, k in fixed.items():
        if not name.endswith(".width"):
            forcing[f"parameter_{name}.wrong_value"] = [found["slopes"][k]]
    size = residual.std(axis=0) + 1e-12 * (np.abs(rates).max() + 1)

    def stacked(column: np.ndarray) -> np.ndarray:
        return (column / size).T.ravel()

    used = {
        name: [stacked(one) for one in columns if np.abs(one).max() > 0] for name, columns in forcing.items()
    }
    base = np.column_stack([stacked(one) for one in slopes]) if slopes else np.zeros((residual.size, 0))
    base = base / (np.linalg.norm(base, axis=0) + 1e-300)
    candidates = {name: columns for name, columns in used.items() if columns}
    features = _features(np.column_stack([smooth, inputs]), smooth.shape[1])
    window = float(np.mean(windows))
    target, null = stacked(residual), found["null"]
    return EquationError(target, base, candidates, residual, rates, features, forcing, null, slopes, window)


def _evaluated(
    model: Any, case: Case, fit: Any, x: np.ndarray, u: np.ndarray, time: np.ndarray, numbers: np.ndarray
) -> dict[str, Any]:
    """The null model's rates, their slopes by every parameter, and what every candidate adds, (N, n) each."""
    effects = ce.effects.library() if case.effects is None else case.effects
    known = [one for one in effects if not any(grid.whole for grid in one.nuisance.values())]
    made = ce.effects.candidates(model, known, case.data, parameters=fit.parameters)
    usable = [one for one in made if not one.states]
    slope = ca.jacobian(model.closed_ode, model.p)
    columns = [model.closed_ode, slope, *(one.ode for one in usable)]
    symbols = [model.x, model.u, model.t, model.p]
    f = ca.Function("f", symbols, [ca.densify(ca.horzcat(*columns))]).map(len(time))
    n = x.shape[1]
    values = np.array(f(x.T, u.T, time[None], np.tile(numbers[:, None], len(time))))
    table = np.nan_to_num(values.T.reshape(len(time), -1, n))
    count = model.p.numel()
    forcing: dict[str, list[np.ndarray]] = {}
    for k, one in enumerate(usable):
        forcing.setdefault(one.key, []).append(table[:, 1 + count + k])
    return {"null": table[:, 0], "slopes": [table[:, 1 + k] for k in range(count)], "forcing": forcing}


def _features(signals: np.ndarray, states: int) -> np.ndarray:
    """Polynomials of all signals to the third degree, sign and x|x| of states; each of unit size."""
    z = signals / (np.abs(signals).max(axis=0) + 1e-300)
    made = [np.ones(len(z))]
    for degree in range(1, _DEGREE + 1):
        for which in combinations_with_replacement(range(z.shape[1] if degree == 1 else states), degree):
            made.append(np.prod(z[:, which], axis=1))
    made += [np.sign(z[:, k]) for k in range(states)]
    made += [z[:, k] * np.abs(z[:, k]) for k in range(states)]
    table = np.column_stack(made)
    return table / (np.sqrt((table**2).mean(axis=0)) + 1e-300)
