"""What a posterior foretells of a record: the outputs of its draws, simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import PosteriorError
from casadi_engine.estimation import Fit, Prediction
from casadi_engine.estimation.options import check_level, whole
from casadi_engine.estimation.prediction import DRAWS
from casadi_engine.estimation.share_noise import ShareNoise, share_noises
from casadi_engine.estimation.simulate import simulate
from casadi_engine.experiment import Experiment
from casadi_engine.model.arrival import arriving

if TYPE_CHECKING:
    from casadi_engine.posterior.result import Posterior

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Predictive:
    """Outputs of a record, simulated with draws of a posterior.

    Attributes
    ----------
    record : its name; time : (N,) s
    runs : output -> (draws, N) simulated, in the output's unit
    sigma : output -> (draws,) standard deviation of the noise
    measured : output -> (N,) where it was measured, else absent
    units : output -> its unit; shares : output -> its noise, of those of which it is a share of what they show
    """

    record: str
    time: Array
    runs: Mapping[str, Array]
    sigma: Mapping[str, Array]
    measured: Mapping[str, Array]
    units: Mapping[str, str]
    shares: Mapping[str, ShareNoise] = field(default_factory=dict)

    def __str__(self) -> str:
        """How wide the bands are, and how much of what was measured lies in those with noise."""
        draws = len(next(iter(self.runs.values()), ()))
        lines = [f"Prediction of {self.record} with 95 % bands, from {draws} draws of the posterior"]
        for name in self.runs:
            low, high = self.band(name)
            half = 0.5 * (high - low)
            text = f"  {name}: half width {np.median(half):.3g} (median), {half.max():.3g} (largest) {self.units[name]}"
            seen = self.measured.get(name)
            if seen is not None and np.isfinite(seen).any():
                low, high = self.band(name, noise=True)
                there = np.isfinite(seen)
                inside = np.mean((seen[there] >= low[there]) & (seen[there] <= high[there]))
                text += f"; with noise it holds {100 * inside:.0f} % of the samples"
            lines.append(text)
        return "\n".join([*lines, "Next: ce.plot(prediction)"])

    def band(self, output: str, level: float = 0.95, *, noise: bool = False) -> tuple[Array, Array]:
        """The lower and upper limit (N,) that hold the output with this probability at each time, in its unit.

        noise : of a measurement, with its noise, instead of the true output
        """
        if output not in self.runs:
            raise PosteriorError(
                "the prediction has no such output",
                seen=repr(output),
                allowed=", ".join(self.runs),
                cure="name an output of the model",
            )
        check_level(level, PosteriorError)
        runs = self.runs[output]
        if not noise:
            low, high = np.quantile(runs, [(1 - level) / 2, (1 + level) / 2], axis=0)
            return low, high
        random = np.random.default_rng(0)
        several = np.concatenate([runs] * max(1, 400 // len(runs)))
        sigma = np.resize(self.sigma[output], len(several))
        ends = np.empty((2, runs.shape[1]))
        for at in range(runs.shape[1]):  # one instant at a time: records are long
            wide = self.shares[output].at(several[:, at]) if output in self.shares else sigma
            noisy = several[:, at] + wide * random.standard_normal(len(several))
            ends[:, at] = np.quantile(noisy, [(1 - level) / 2, (1 + level) / 2])
        return ends[0], ends[1]


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Some draws of a posterior, in their order, as ``simulate`` takes them."""

    fit: Fit
    draws: Mapping[str, Array]


def predictive(
    post: Posterior,
    data: Any = None,
    *,
    draws: int = 60,
    seed: int = 0,
    initial: Mapping[str, float] | None = None,
) -> Predictive:
    """Simulate a record with draws of the parameters, each from initial states drawn from those that explain its
    measured outputs; where the fit held them, of its own record, from these.

    data : an Experiment (default: the first of the fit's records); draws : number of draws, 200 at most; seed : of
    their choice; initial : state -> value, all of them, of a record whose outputs were not measured

    Raises PosteriorError for what is no record, and what ``simulate`` raises.
    """
    record = post.fit.data[0] if data is None else data
    if not isinstance(record, Experiment):
        raise PosteriorError(
            "there is no record to predict",
            seen=type(record).__name__,
            allowed="an Experiment, or None for the fit's first record",
            cure="read one by read_experiment(path)",
        )
    record = arriving(post.fit.model, record)
    count = min(whole("draws", draws, 2), len(post.values), DRAWS)
    chosen = np.random.default_rng(whole("seed", seed, 0)).choice(len(post.values), count, replace=False)
    some = _Drawn(post.fit, {name: own[chosen] for name, own in post.draws.items()})
    found: Prediction = simulate(some, record, initial=initial, band=True)
    outputs = post.fit.model.outputs
    time = found.simulated[outputs[0].name].time
    measured = {
        out.name: np.interp(
            time, record[out.name].time, np.where(record[out.name].mask, record[out.name].values, np.nan)
        )
        for out in outputs
        if out.name in record
    }
    levels = {out.name: np.full(found.draws, post.fit.noise[out.name][0]) for out in outputs}
    levels |= {
        name: np.resize(post[own][chosen], found.draws)
        for name in levels
        if (own := f"sigma({name})") in post.names
    }
    units = {out.name: out.unit for out in outputs}
    return Predictive(record.name, time, found.runs, levels, measured, units, share_noises(post.fit))
