"""What a posterior foretells of a record: the outputs of its draws, simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import PosteriorError
from casadi_engine.estimation.options import check_level, whole
from casadi_engine.estimation.simulate import simulate
from casadi_engine.experiment import Experiment

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
    units : output -> its unit
    """

    record: str
    time: Array
    runs: Mapping[str, Array]
    sigma: Mapping[str, Array]
    measured: Mapping[str, Array]
    units: Mapping[str, str]

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
            noisy = several[:, at] + sigma * random.standard_normal(len(several))
            ends[:, at] = np.quantile(noisy, [(1 - level) / 2, (1 + level) / 2])
        return ends[0], ends[1]


def predictive(post: Posterior, data: Any = None, *, draws: int = 60, seed: int = 0) -> Predictive:
    """Simulate a record with draws of the parameters, each from the initial states that suit the measured outputs best.

    data : an Experiment (default: the first of the fit's records); draws : number of draws; seed : of their choice

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
    count = min(whole("draws", draws, 2), len(post.values))
    chosen = np.random.default_rng(whole("seed", seed, 0)).choice(len(post.values), count, replace=False)
    fit, outputs = post.fit, [out.name for out in post.fit.model.outputs]
    runs: dict[str, list[Array]] = {name: [] for name in outputs}
    sigma: dict[str, list[float]] = {name: [] for name in outputs}
    for k in chosen:
        found = simulate(fit.model, record, parameters=_parameters(post, int(k), record.name))
        for name in outputs:
            runs[name].append(found[name].values)
            own = f"sigma({name})"
            sigma[name].append(float(post[own][k]) if own in post.names else fit.noise[name][0])
    time = found[outputs[0]].time
    measured = {
        name: np.interp(time, record[name].time, np.where(record[name].mask, record[name].values, np.nan))
        for name in outputs
        if name in record
    }
    return Predictive(
        record.name,
        time,
        {name: np.array(rows) for name, rows in runs.items()},
        {name: np.array(rows) for name, rows in sigma.items()},
        measured,
        {out.name: out.unit for out in fit.model.outputs},
    )


def _parameters(post: Posterior, k: int, record: str) -> dict[str, float]:
    """Name -> value of the model's parameters at a draw, ties kept."""
    own = post.fit.parameters.copy()
    for name, value in zip(post.names, post.values[k], strict=True):
        plain, _, where = name.partition("@")
        if plain in own and (not where or where == record):
            parameter = own[plain]
            parameter.set(float(np.clip(value, parameter.min, parameter.max)))
    values = own.as_dict()
    return {name: values[name] for name in post.fit.model.parameter_names}
