"""Monte Carlo: a fit repeated on records that its own model makes, with fresh noise: what are its errors worth?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError, SimulationError
from casadi_engine.estimation.batch import check_options
from casadi_engine.estimation.estimate import estimate
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.options import whole
from casadi_engine.estimation.simulate import simulate
from casadi_engine.estimation.study import study
from casadi_engine.experiment import Experiment
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

Array = NDArray[np.float64]

# A record whose inputs are among its outputs is simulated until it is made of itself, to this share.
_SETTLED, _ROUNDS = 1e-11, 60
_NORMAL_95 = 1.959964


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Repeated fits of records whose truth is known.

    names : free parameters; truth : (n,); values, stderr : (count, n), NaN where a fit claims no error
    status : of every fit
    """

    names: tuple[str, ...]
    truth: Array
    values: Array
    stderr: Array
    status: tuple[str, ...]

    @property
    def converged(self) -> NDArray[np.bool_]:
        """(count,) True for the fits that met their tolerance; the others do not count below."""
        return np.array([status == "converged" for status in self.status])

    @property
    def coverage(self) -> dict[str, float]:
        """Share of the fits with a standard error whose 95 % interval holds the truth."""
        error, claimed = np.abs(self.values - self.truth), self.stderr
        return {
            name: float(np.mean(error[good, k] <= _NORMAL_95 * claimed[good, k]))
            if good.any()
            else float("nan")
            for k, name in enumerate(self.names)
            for good in [self.converged & np.isfinite(claimed[:, k])]
        }

    @property
    def rmse(self) -> dict[str, float]:
        """Root of the mean squared error, in the parameters' units."""
        error = (self.values - self.truth)[self.converged]
        return dict(zip(self.names, np.sqrt(np.mean(error**2, axis=0)).tolist(), strict=True))

    @property
    def claimed(self) -> dict[str, float]:
        """Root of the mean squared standard error, in the parameters' units."""
        with np.errstate(invalid="ignore"):
            square = np.nanmean(self.stderr[self.converged] ** 2, axis=0)
        return dict(zip(self.names, np.sqrt(square).tolist(), strict=True))

    def __str__(self) -> str:
        head = f"{int(self.converged.sum())} of {len(self.status)} fits converged"
        wide = max(len("parameter"), *(len(name) for name in self.names)) if self.names else 0
        lines = [head, f"{'parameter':<{wide}}  coverage of 95 %  error / claimed error"]
        for name in self.names:
            share = self.rmse[name] / self.claimed[name]
            lines.append(f"{name:<{wide}}  {100 * self.coverage[name]:14.1f} %  {share:21.3f}")
        return "\n".join(lines)


def monte_carlo(
    fit: Fit,
    *,
    count: int,
    seed: int = 0,
    jobs: int | None = 1,
    checkpoint: Path | str | None = None,
    watch: Callable[[int, int], Any] | None = None,
    **options: Any,
) -> MonteCarlo:
    """Fit ``count`` records that are simulated at a fit's estimates, with noise drawn at its levels.

    Missing samples stay missing; a channel that is input and output at once (the measured speed in the reciprocating
    torque) carries its noise into the input, as it does in the fit.

    seed : of the noise; jobs, checkpoint, watch : see `study`
    options : of `estimate` that the fit does not tell (``initial``) or that are to be others
    Raises EstimationError for a fit that did not converge or that is a predictor's, and what `study` raises.
    """
    count, seed = whole("count", count, 1), whole("seed", seed, 0)
    _check(fit)
    check_options(options, without=("jobs",))
    pieces = [{"seed": seed, "draw": k} for k in range(count)]
    setting = {
        "values": fit.values,
        "noise": {name: list(level) for name, level in fit.noise.items()},
        "records": [[record.name, record.samples] for record in fit.data],
        "parameters": fit.parameters.to_dict(),
        "options": {key: _said(value) for key, value in {**fit.options, **options}.items()},
    }
    rows = study(
        partial(_refit, fit, options),
        pieces,
        name=f"monte carlo of {fit.model.name}",
        setting=setting,
        jobs=jobs,
        checkpoint=checkpoint,
        watch=watch,
    )
    return MonteCarlo(
        fit.free,
        np.array([fit.values[name] for name in fit.free]),
        np.array([row["values"] for row in rows], dtype=float).reshape(count, -1),
        np.array([row["stderr"] for row in rows], dtype=float).reshape(count, -1),
        tuple(row["status"] for row in rows),
    )


def redrawn(fit: Fit, rng: np.random.Generator) -> list[Experiment]:
    """The fit's records with simulated outputs and fresh noise at the fit's levels."""
    return [_redrawn(fit, record, rng) for record in fit.data]


def _said(value: Any) -> Any:
    """What an option is, for the checkpoint: the text of a parameter set does not tell its bounds and priors."""
    return value.to_dict() if isinstance(value, Parameters) else repr(value)


def _refit(fit: Fit, options: Mapping[str, Any], piece: Mapping[str, int]) -> dict[str, Any]:
    data = redrawn(fit, np.random.default_rng([piece["seed"], piece["draw"]]))
    settings = {
        key: fit.options[key] for key in ("interval", "ties", "method", "max_iterations", "tolerance")
    }
    levels: dict[str, Any] = {
        name: "estimate" if estimated else sigma for name, (sigma, estimated) in fit.noise.items()
    }
    found = estimate(
        fit.model,
        data,
        **{
            "parameters": fit.parameters.copy(),
            "noise": Noise(**levels),
            "progress": False,
            **settings,
            **options,
        },
    )
    return {
        "status": found.status,
        "values": [found.values[name] for name in found.free],
        "stderr": [found.stderr[name] for name in found.free],
    }


def _check(fit: Fit) -> None:
    if not isinstance(fit, Fit):
        raise EstimationError(
            "Monte Carlo needs a fit",
            seen=repr(fit),
            allowed="a Fit",
            cure="give what ce.estimate returned",
        )
    if not fit.converged:
        raise EstimationError(
            "Monte Carlo needs a fit that converged",
            seen=fit.status,
            allowed='status "converged"',
            cure="repeat the fit with other starts or more iterations",
        )
    if fit.innovations is not None or fit.gain is not None:
        raise EstimationError(
            "Monte Carlo draws measurement noise alone, and this fit is a predictor's",
            seen=f"a {fit.innovations.kind if fit.innovations else 'stated'} predictor",
            allowed="a fit of the simulation error (no gain, no process noise)",
            cure="leave gain and process out of the noise",
        )


def _redrawn(fit: Fit, record: Experiment, rng: np.random.Generator) -> Experiment:
    traces = fit.traces[record.name]
    noise = {
        name: fit.noise[name][0] * rng.standard_normal(len(trace.time)) for name, trace in traces.items()
    }
    fed_back = [name for name in traces if name in {variable.name for variable in fit.model.inputs}]
    made = _with_outputs(record, fit, {name: trace.simulated for name, trace in traces.items()}, noise)
    if not fed_back:
        return made
    values = {
        name: fit.values.get(f"{name}@{record.name}", fit.values.get(name, np.nan))
        for name in fit.model.parameter_names
    }
    states = dict(
        zip((s.name for s in fit.model.states), fit.states_at_start[record.name].tolist(), strict=True)
    )
    for _ in range(_ROUNDS):
        run = simulate(fit.model, made, parameters=values, initial=states, method=fit.options["method"])
        fresh = {
            name: np.interp(trace.time, run[name].time, run[name].values) for name, trace in traces.items()
        }
        new = _with_outputs(made, fit, fresh, noise)
        change = max(float(np.abs(new[name].values - made[name].values).max()) for name in fed_back)
        made = new
        if change <= _SETTLED * max(float(np.abs(made[name].values).max()) for name in fed_back):
            return made
    raise SimulationError(
        "the measured outputs that are inputs too do not settle when simulated with noise",
        seen=f"a change of {change:.2g} after {_ROUNDS} rounds",
        allowed="a model in which they act weakly",
        cure="take another form of the model, without measured outputs among its inputs",
    )


def _with_outputs(
    record: Experiment, fit: Fit, outputs: Mapping[str, Array], noise: Mapping[str, Array]
) -> Experiment:
    """The record with these outputs and this noise, (N,) each, where it has valid samples."""
    for name, values in outputs.items():
        channel, there = record[name], fit.traces[record.name][name].mask
        seen = np.where(there, values + noise[name], np.nan)
        record = record.with_channel(replace(channel, values=seen, mask=there & channel.mask))
    return record
