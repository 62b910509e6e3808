"""compare: which of several models the records ask for, by the evidence of their posteriors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_engine.errors import PosteriorError
from casadi_engine.posterior.result import Posterior


@dataclass(frozen=True)
class Comparison:
    """Models of the same records by their evidence.

    log_evidence, error : name -> log evidence and its standard error; probability : name -> that of the model, if all
    were as probable before the records were seen. The best one is the first
    root : of the likelihood of white noise, by which all count coloured noise alike: that of the one that leaves least
    """

    log_evidence: Mapping[str, float]
    error: Mapping[str, float]
    probability: Mapping[str, float]
    root: float = 1.0

    def __str__(self) -> str:
        best = next(iter(self.log_evidence.values()))
        wide = max(len("model"), *(len(name) for name in self.log_evidence))
        lines = [f"{'model':{wide}s}  log evidence      below the best  probability"]
        for name, own in self.log_evidence.items():
            error = f"± {self.error[name]:.2g}"
            share = 100 * self.probability[name]
            probable = f"{share:10.3g} %" if share >= 1e-3 or share == 0 else "   < 0.001 %"
            lines.append(f"{name:{wide}s}  {own:12.2f} {error:7s}  {best - own:10.2f}  {probable}")
        if self.root != 1.0:
            lines.append(
                "the residual of the model that fits best is not the white noise that is counted with: the log "
                f"likelihood is divided by {self.root:.3g}, for all models"
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        return {
            "log_evidence": dict(self.log_evidence),
            "error": dict(self.error),
            "probability": dict(self.probability),
            "likelihood_root": self.root,
        }


def compare(posteriors: Mapping[str, Posterior]) -> Comparison:
    """Compare models of the same records by the evidence of their posteriors; name -> Posterior.

    The evidence falls with the width of the priors: bounds that are far too wide count against a parameter. ``ce.plot``
    draws what is returned.

    Raises PosteriorError for fewer than two, for what is no posterior, or for posteriors of different records.

    Does a run-up of two seconds ask for a damper?

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> noise = 0.02 * np.random.default_rng(1).standard_normal(200)
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)) + noise)
    >>> made = {}
    >>> for name, most in (("damped", 2.0), ("hardly damped", 0.01)):
    ...     pars = ce.one_inertia().parameters()
    ...     _ = pars["J_eng"].set(0.5, min=0.05, max=5), pars["C_eng"].set(most / 2, min=0, max=most)
    ...     fit = ce.estimate(ce.one_inertia(), exp, parameters=pars, noise=ce.Noise(omega=0.02), progress=False)
    ...     made[name] = ce.posterior(fit)
    >>> [f"{name} {share:.3f}" for name, share in compare(made).probability.items()]
    ['damped 1.000', 'hardly damped 0.000']
    """
    other = [
        f"{name}: a {type(one).__name__}"
        for name, one in (posteriors.items() if isinstance(posteriors, Mapping) else ())
        if not isinstance(one, Posterior)
    ]
    if other:
        raise PosteriorError(
            "what is compared is no posterior",
            seen=", ".join(other),
            allowed="name -> Posterior",
            cure="draw it from the fit, ce.posterior(fit)",
        )
    kinds = isinstance(posteriors, Mapping)
    if not kinds or len(posteriors) < 2:
        raise PosteriorError(
            "there is nothing to compare",
            seen=f"{len(posteriors)} posteriors" if kinds else type(posteriors).__name__,
            allowed="name -> Posterior, two or more",
            cure='give compare({"two masses": one, "seven": other})',
        )
    first, *others = posteriors.items()
    for name, post in others:
        if not _alike(first[1], post):
            raise PosteriorError(
                "posteriors of different records cannot be compared",
                seen=f"{first[0]}: {_records(first[1])}; {name}: {_records(post)}",
                allowed="fits of the same samples of the same outputs",
                cure="fit every model to the same records",
            )
    root = max(posteriors.values(), key=lambda post: float(post.log_likelihood.max())).root
    evidence = {name: post.evidence_at(root) for name, post in posteriors.items()}
    order = sorted(posteriors, key=lambda name: -evidence[name])
    logs = np.array([evidence[name] for name in order])
    share = np.exp(logs - logs.max())
    return Comparison(
        dict(zip(order, logs.tolist(), strict=True)),
        {name: posteriors[name].log_evidence_error for name in order},
        dict(zip(order, (share / share.sum()).tolist(), strict=True)),
        root,
    )


def _alike(one: Posterior, other: Posterior) -> bool:
    """True if both explain the same numbers."""
    traces, others = one.fit.traces, other.fit.traces
    if list(traces) != list(others) or any(list(traces[name]) != list(others[name]) for name in traces):
        return False
    return all(
        np.array_equal(trace.measured, others[record][output].measured, equal_nan=True)
        for record, outputs in traces.items()
        for output, trace in outputs.items()
    )


def _records(post: Posterior) -> str:
    outputs = sorted({output for own in post.fit.traces.values() for output in own})
    return f"{', '.join(post.fit.traces)} ({', '.join(outputs)}, {post.fit.n} samples)"
