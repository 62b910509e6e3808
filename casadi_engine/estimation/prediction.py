"""Simulated outputs with their errors: a band from those of the parameters and initial states, and one with the noise.

The errors of a fit reach the outputs along their exact slopes (delta method). An initial state that was fitted to the
record moves with the parameters: for each value of these it is the one that explains the record best, and its own error
is added. From draws of a posterior the outputs are simulated one by one, and the bands are their quantiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.distributions import chi2_isf, f_isf
from casadi_engine.errors import SimulationError
from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.estimation.integration import SHIFT, shorten_steps
from casadi_engine.estimation.options import interval_length
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.share_noise import share_noises
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.experiment import Experiment
from casadi_engine.parameters import compile
from casadi_engine.simulation.discretisation import Method
from casadi_engine.simulation.grid import Grid, Measured, lay_grid
from casadi_engine.simulation.late_outputs import as_shown
from casadi_engine.simulation.propagator import switches_with_states
from casadi_engine.simulation.runge_kutta import Fineness

Array = NDArray[np.float64]

LEVEL = 0.95
# Draws of a posterior that are simulated, evenly taken from all.
DRAWS = 200
# How often steps are shortened for one draw, until the outputs are those of the equations within a share of the noise.
_SHORTENED = 8
# Share of the largest singular value below which a record says nothing of a combination of initial states.
_BLIND = 1e-9


@dataclass(frozen=True, eq=False)
class Band:
    """One simulated output with its errors, (N,) each, in its unit.

    time [s]; value : simulated; stderr : standard error of the value
    low, high : the 95 % band of what the model would give without errors of parameters and initial states
    low_noise, high_noise : the 95 % band of a new measurement, with the noise of the fit; sigma : of that noise, in the
        mean where it is a share of what the output shows
    """

    time: Array
    value: Array
    stderr: Array
    low: Array
    high: Array
    low_noise: Array
    high_noise: Array
    sigma: float
    unit: str


@dataclass(frozen=True, eq=False)
class Prediction:
    """A simulation with bands, as ``simulate(fit, data, band=True)`` returns it.

    simulated : what ``simulate`` returns without bands; data : the record; bands : output -> Band
    draws : how many draws of a posterior it was made of, 0 for the delta method
    messages : what the user should know; runs : output -> (draws, N) simulated with each of them
    """

    simulated: Experiment
    data: Experiment
    bands: Mapping[str, Band]
    draws: int = 0
    messages: tuple[str, ...] = ()
    runs: Mapping[str, Array] = field(default_factory=dict)

    def __getitem__(self, output: str) -> Band:
        if output in self.bands:
            return self.bands[output]
        raise SimulationError(
            "there is no band of this output",
            seen=repr(output),
            allowed=", ".join(self.bands),
            cure="name an output of the model",
        )

    def __str__(self) -> str:
        how = f"{self.draws} draws of the posterior" if self.draws else "errors of the fit along exact slopes"
        lines = [f"Prediction of {self.simulated.name} with 95 % bands, from {how}"]
        for name, band in self.bands.items():
            width = (band.high - band.low) / 2
            lines.append(
                f"  {name}: half width {np.median(width):.3g} (median), {width.max():.3g} (largest) {band.unit}; "
                f"with noise {np.median(band.high_noise - band.low_noise) / 2:.3g}"
            )
        lines += [f"Note: {message}" for message in self.messages]
        return "\n".join([*lines, "Next: ce.plot(prediction)"])


def check_band(model: Any, parameters: Any, band: Any = True) -> Fit | None:
    """The fit whose errors a band is made of: of a Fit, or of an object with ``fit`` and ``draws``; None for False."""
    if not isinstance(band, bool | np.bool_):
        raise SimulationError(
            "band is neither True nor False",
            seen=repr(band),
            allowed="True or False",
            cure="give band=True: the bands hold 95 %; those of a posterior's predictive take another level",
        )
    if not band:
        return None
    fit = getattr(model, "fit", model)
    if not isinstance(fit, Fit):
        raise SimulationError(
            "a band needs the errors of a fit",
            seen=type(model).__name__,
            allowed="a Fit, or a posterior",
            cure="give simulate(fit, data, band=True)",
        )
    if parameters is not None:
        raise SimulationError(
            "a band is about the parameters of the fit, not other ones",
            seen="parameters=",
            allowed="no parameters with band=True",
            cure="leave them out, or leave band out",
        )
    if fit.innovations is not None:
        raise SimulationError(
            "a band needs a fit of output error: process noise moves the simulation too",
            seen=f'a predictor by "{fit.innovations.kind}"',
            allowed="a fit whose noise is that of the measurement alone",
            cure="leave band out",
        )
    if fit is model and (not fit.converged or fit.undetermined):
        raise SimulationError(
            "the fit has no errors to make a band of",
            seen=fit.status if not fit.converged else f"the data do not determine {fit.undetermined[0].text}",
            allowed="a fit that converged and determines its parameters",
            cure="mend the fit first: print(fit) says how",
        )
    if fit is model and fit.doubted:
        raise SimulationError(
            "the errors of the fit are not known, and so is the band",
            seen=f"doubted: {', '.join(fit.doubted)}",
            allowed="a fit with standard errors or intervals, or a posterior",
            cure="take the posterior: ce.simulate(ce.posterior(fit), data, band=True)",
        )
    return fit


def with_band(
    model: Any,
    fit: Fit,
    data: Experiment,
    simulated: Experiment,
    grid: Grid,
    initial: Mapping[str, Any],
    method: Method,
) -> Prediction:
    """The prediction of a simulated record; initial : state -> number, or the Estimate that the record gave."""
    outputs = [out.name for out in fit.model.outputs]
    around = _Record(fit, data, grid, initial, method)
    messages = list(around.messages)
    if fit is model:
        if any(one.quadratic for one in fit.estimates.values()):
            messages.append("the errors of the fit are not symmetric, those of the band are taken to be")
        value, spread = around.delta()
        estimated = any(free for _, free in fit.noise.values()) and fit.dof > 0
        root = float(np.sqrt(f_isf(1 - LEVEL, 1, fit.dof) if estimated else chi2_isf(1 - LEVEL, 1)))
        parts = {
            "value": value,
            "stderr": spread,
            "low": value - root * spread,
            "high": value + root * spread,
        }
        wide = root * np.hypot(spread, around.noise(value))
        parts |= {"low_noise": value - wide, "high_noise": value + wide}
        count, runs = 0, {}
    else:
        drawn = around.drawn(model.draws)
        count, beyond = len(drawn), (1 - LEVEL) / 2
        runs = {name: drawn[:, k, :: grid.parts] for k, name in enumerate(outputs)}
        noise = np.random.default_rng(0).standard_normal(drawn.shape) * around.noise(drawn)
        parts = {"value": np.median(drawn, axis=0), "stderr": drawn.std(axis=0, ddof=1)}
        parts["low"], parts["high"] = np.quantile(drawn, [beyond, 1 - beyond], axis=0)
        parts["low_noise"], parts["high_noise"] = np.quantile(drawn + noise, [beyond, 1 - beyond], axis=0)
    bands = {
        name: Band(
            simulated[name].time, sigma=float(around.sigma[k]), unit=simulated[name].unit,
            **{key: part[k, :: grid.parts] for key, part in parts.items()},
        )
        for k, name in enumerate(outputs)
    }  # fmt: skip
    return Prediction(simulated, data, bands, count, tuple(messages), runs)


def _wider(fit: Fit, record: str, state: str) -> float:
    """By how much the error of a fitted state is larger than in white noise of the fit's levels: as the fit found it in
    its record, of a fresh one the most that it found in any."""
    own = fit.own_noise.get(f"{record}/{state}")
    known = [ratio for name, ratio in fit.own_noise.items() if name.rpartition("/")[2] == state]
    return own if own is not None else max(known, default=1.0)


class _Record:
    """A simulated record around the values of a fit: outputs and slopes at all times of the simulation."""

    def __init__(
        self, fit: Fit, data: Experiment, grid: Grid, initial: Mapping[str, Any], method: Method
    ) -> None:
        model = fit.model
        self.pmap = compile(fit.parameters, model.parameter_names, (data.name,))
        self.coordinates = Coordinates(self.pmap)
        known = fit.values_for(data.name)
        values = fit.values
        self.z = np.array([values.get(name, known[name.partition("@")[0]]) for name in self.pmap.free])
        self.v = self.coordinates.of(self.z)
        self.outputs = tuple(out.name for out in model.outputs)
        every = np.arange(grid.samples)
        whole = Measured(grid.time, np.zeros(grid.samples), every, every)
        grid = replace(grid, measured=dict.fromkeys(self.outputs, whole))
        local = self.coordinates.substitute(self.pmap.physical[data.name])
        length = interval_length("auto", grid, whole=switches_with_states(model))
        self.record = RecordTerm(
            model, data, self.coordinates.symbol, local, length=length, gain=None, method=method, grid=grid
        )
        # steps that the search found, where the record is one of its own
        fineness = fit.fineness.get(data.name)
        if isinstance(fineness, Fineness):
            self.record.step_in_places(anyway=True)
        self.record.as_fine_as(fineness)
        self.record.set_sigma(np.ones(len(self.outputs)))
        self.sigma = np.array([fit.noise.get(name, (np.nan, False))[0] for name in self.outputs])
        self.shares = share_noises(fit)
        # outputs are integrated to a share of this
        self._least = float(np.nanmin(self.sigma, initial=np.inf))
        free = [isinstance(initial[s.name], Estimate) and not initial[s.name].fixed for s in model.states]
        self.free = np.flatnonzero(free)
        self.wider = np.array([_wider(fit, data.name, model.states[k].name) for k in self.free])
        found = [initial[model.states[k].name].stderr for k in self.free]
        of_fit = fit.initial.get(data.name)
        is_own = of_fit is not None and all(of_fit.get(s.name) is initial[s.name] for s in model.states)
        self.found = np.array([0.0 if is_own or own is None else own for own in found])
        first = [getattr(initial[s.name], "value", initial[s.name]) for s in model.states]
        self.first = np.array(first, dtype=float) / self.record.scale
        self.rows = self._measured(data, grid.time)
        here = [k for k, name in enumerate(self.pmap.free) if name in fit.free]
        there = [fit.free.index(self.pmap.free[k]) for k in here]
        slope = self.coordinates.slope(self.v)
        self.covariance = np.zeros((len(self.z), len(self.z)))
        own = fit.covariance[np.ix_(there, there)] / np.outer(slope[here], slope[here])
        self.covariance[np.ix_(here, here)] = own
        own_record = next((r for r in fit.data if r.name == data.name), None)
        self.told: _Record = self  # the record that tells the initial states
        if len(self.free) and not self.rows and own_record is not None and own_record is not data:
            known_grid = lay_grid(model, own_record, outputs=self.outputs)
            self.told = _Record(fit, own_record, known_grid, initial, method)
        lost = [name for k, name in enumerate(self.pmap.free) if k not in here]
        said = [f"the error of {', '.join(lost)} is not in the band: the fit has none for this record"]
        self.messages = (
            *(said if lost else ()),
            *(
                f"the noise of {name} is about {100 * one.share:.2g} % of what it shows, and so is the band with noise"
                for name, one in self.shares.items()
            ),
        )

    def noise(self, shown: Array) -> Array:
        """Standard deviations (..., ny, N) of the noise where the outputs show this."""
        found = np.broadcast_to(self.sigma[:, None], shown.shape).copy()
        for k, name in enumerate(self.outputs):
            if name in self.shares:
                found[..., k, :] = self.shares[name].at(shown[..., k, :])
        return found

    def _measured(self, data: Experiment, time: Array) -> list[tuple[int, NDArray[np.intp], Array]]:
        """Number of the output, points of the simulation and values of what was measured there."""
        found = []
        for k, name in enumerate(self.outputs):
            if name not in data:
                continue
            channel = data[name]
            seen = channel.mask & (channel.time >= time[0] - 1e-9) & (channel.time <= time[-1] + 1e-9)
            if not seen.any():
                continue
            at = np.clip(np.searchsorted(time, channel.time[seen]), 1, len(time) - 1)
            at = at - (channel.time[seen] - time[at - 1] < time[at] - channel.time[seen])
            found.append((k, at, channel.values[seen]))
        return found

    def at(self, v: Array, first: Array) -> tuple[Array, Array]:
        """Outputs (ny, N) from parameters v and first state, and their slopes (nz + n, ny, N) in both."""
        record = self.record
        try:
            for _ in range(_SHORTENED):
                nodes = chained_nodes(record, v, first)
                if not shorten_steps([record], v, [nodes], shift=SHIFT * self._least):
                    break
            point = record.evaluate(v, nodes)
        except FloatingPointError as fault:
            if record.step_in_places():
                return self.at(v, first)
            raise SimulationError(
                "there are no slopes along the simulation, of which a band is made",
                seen=str(fault),
                allowed="a model that has derivatives at all its states",
                cure="leave band out, or keep laws such as roots and powers away from 0, as fmax(x, 1e-9)",
            ) from fault
        slopes = chained_slopes(record, point)
        whole = np.zeros((len(self.z) + record.n, len(self.outputs), record.grid.samples))
        entries = np.concatenate([record.active, len(self.z) + np.arange(record.n)])
        value = point.r
        for k, name in enumerate(self.outputs):
            for entry, row in zip(entries, slopes, strict=True):
                whole[entry, k] = record.observation.series(row, name)
        rows = np.array([record.observation.series(value, name) for name in self.outputs])
        return as_shown(record.model, record.grid, rows), as_shown(record.model, record.grid, whole)

    def seen(self, rows: Array) -> Array:
        """What the measurement sees of outputs or slopes (..., ny, N), in units of the noise: (..., K)."""
        return np.concatenate([rows[..., k, at] / self.sigma[k] for k, at, _ in self.rows], axis=-1)

    def states(self, slopes: Array) -> Array:
        """Pseudo-inverse (f, K) of what the measurement sees of the free initial states."""
        own = self.seen(slopes[len(self.z) + self.free]).T
        size = np.linalg.norm(own, axis=0)
        size[size == 0] = 1.0
        return np.asarray(np.linalg.pinv(own / size, rcond=_BLIND) / size[:, None])

    def spread(self, inverse: Array) -> Array:
        """(f, K) from white noise of the fit's levels to errors of the free initial states, of which ``inverse`` is the
        pseudo-inverse: larger as the fit found them in its records, and as their own fit to a fresh one found them."""
        white = np.maximum(np.linalg.norm(inverse, axis=1), 1e-300) * self.record.scale[self.free]
        return np.asarray(np.maximum(self.wider, self.found / white)[:, None] * inverse)

    def delta(self) -> tuple[Array, Array]:
        """Outputs (ny, N) and their standard errors."""
        value, slopes = self.at(self.v, self.first)
        turn, states = slopes[: len(self.z)].copy(), slopes[len(self.z) + self.free]
        variance = np.zeros_like(value)
        if len(self.free):
            told, known = self.told, slopes
            if told is not self:
                _, known = told.at(self.v, self.first)
            inverse = told.states(known)
            follow = (
                -inverse @ told.seen(known[: len(self.z)]).T
            )  # (f, nz): how fitted states move with parameters
            turn += np.einsum("fz,fyn->zyn", follow, states)
            spread = self.spread(inverse)
            own = spread @ spread.T
            variance += np.einsum("fyn,fg,gyn->yn", states, own, states, optimize=True)
        variance += np.einsum("zyn,zw,wyn->yn", turn, self.covariance, turn, optimize=True)
        return value, np.sqrt(np.maximum(variance, 0.0))

    def drawn(self, draws: Mapping[str, Array]) -> Array:
        """Outputs (S, ny, N) of draws, each with an initial state drawn from those that explain the record."""
        known = [name for name in self.pmap.free if name in draws]
        count = min((len(draws[name]) for name in known), default=0)
        if not count:
            raise SimulationError(
                "there are no draws of the model's parameters",
                seen=", ".join(draws) or "nothing",
                allowed=", ".join(self.pmap.free),
                cure="give the posterior of a fit of this model",
            )
        rng, found = np.random.default_rng(0), []
        for k in np.unique(np.linspace(0, count - 1, min(count, DRAWS)).astype(int)):
            z = np.array(
                [draws[n][k] if n in known else own for n, own in zip(self.pmap.free, self.z, strict=True)]
            )
            found.append(self._one(self.coordinates.of(z), rng))
        return np.array(found)

    def _one(self, v: Array, rng: np.random.Generator) -> Array:
        """Outputs (ny, N) at one draw of the parameters."""
        value, slopes = self.at(v, self.first)
        if not len(self.free) or not self.told.rows:
            return value
        told, seen, known = self.told, value, slopes
        if told is not self:
            seen, known = told.at(v, self.first)
        left = told.seen(seen) - np.concatenate([own / told.sigma[k] for k, _, own in told.rows])
        inverse = told.states(known)
        move = -inverse @ left - told.spread(inverse) @ rng.standard_normal(len(left))
        return np.asarray(value + np.einsum("f,fyn->yn", move, slopes[len(self.z) + self.free]))
