"""The parameters of a fit on other records: held, but for those that vary by experiment and are not known there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from casadi_engine.errors import EstimationError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.estimation.known_starts import found_from_known
from casadi_engine.estimation.summary import with_error
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.experiment import given_records
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

# Fewest records whose values tell how much a parameter scatters from one record to the next.
_TELL = 3


def scatter_of(fit: Fit, name: str) -> tuple[float, float] | None:
    """(mean, standard deviation) that a fit expects of a parameter that varies by experiment in a record it has not
    seen: the scatter between its records and the mean square of their errors together; None with fewer than three."""
    own = [one for key, one in fit.estimates.items() if key.startswith(f"{name}@")]
    values = np.array([one.value for one in own])
    errors = np.array([one.stderr for one in own if one.stderr is not None])
    if len(values) < _TELL or len(errors) < _TELL:
        return None
    spread = math.sqrt(float(values.var(ddof=1)) + float(np.mean(errors**2)))
    return (float(values.mean()), spread) if spread > 0 else None


def freed_for(fit: Fit, record: str) -> tuple[str, ...]:
    """Free parameters that vary by experiment and have no value of their own in a record of this name."""
    return tuple(n for n in fit.averaged_for(record) if fit.parameters[n].varies_by_experiment)


def parameters_for(fit: Fit, record: str) -> Parameters:
    """A fit's set for a record: what it knows is fixed; what varies by experiment and is not known there is free, from
    the records' mean, with their scatter as its prior where at least three records tell it."""
    parameters, values, freed = fit.parameters.copy(), fit.values_for(record), freed_for(fit, record)
    for name in parameters:
        own = parameters[name]
        if own.tie is not None:
            continue
        if name not in freed:
            own.set(values[name], min=min(own.min, values[name]), max=max(own.max, values[name]))
            parameters.fix(name)
            continue
        prior = scatter_of(fit, name)
        if prior is not None:
            own.set(prior=prior)
    return parameters


def held_on(fit: Fit, data: Any, *, noise: Noise, method: str, loss: Any = "square") -> Fit:
    """A Fit of other records with the fit's parameters, initial states found; see ``parameters_for``."""
    records = given_records(data)
    if not records:
        raise EstimationError(
            "there are no fresh data to judge",
            seen="an empty sequence",
            allowed="one Experiment or several",
            cure="give validate(fit, record), or leave the data out to test the fit on its own",
        )
    alike: dict[Any, list[Experiment]] = {}
    for record in records:
        known = any(key.partition("@")[2] == record.name for key in fit.values)
        alike.setdefault(record.name if known else None, []).append(record)
    found = []
    for group in alike.values():
        find = partial(
            estimate, fit.model, group, parameters=parameters_for(fit, group[0].name), noise=noise, method=method,
            loss=loss, progress=False,
        )  # fmt: skip
        found.append(found_from_known(fit, find, [record.name for record in group]))
    return found[0] if len(found) == 1 else _together(found, [record.name for record in records])


def _together(fits: Sequence[Fit], order: Sequence[str]) -> Fit:
    """One Fit of records that were fitted apart, for each has parameters of its own."""
    joined: dict[str, Any] = {}
    for part in ("traces", "drives", "fit_percent", "initial", "states_at_start", "integration"):
        both = {name: value for one in fits for name, value in getattr(one, part).items()}
        joined[part] = {name: both[name] for name in order if name in both}
    records = {record.name: record for one in fits for record in one.data}
    estimates: dict[str, Any] = {}
    for one in fits:
        for name, own in one.estimates.items():
            if "@" in name or all(other.estimates.get(name) == own for other in fits):
                estimates[name] = own
            else:
                estimates |= {f"{name}@{record.name}": own for record in one.data}
    share = np.array([one.n for one in fits], dtype=float)
    noise = {
        name: (math.sqrt(float(np.average([one.noise[name][0] ** 2 for one in fits], weights=share))), free)
        for name, (_, free) in fits[0].noise.items()
    }
    return replace(
        next((one for one in fits if not one.converged), fits[0]),
        data=tuple(records[name] for name in order),
        estimates=estimates,
        noise=noise,
        cost=sum(one.cost for one in fits),
        n=sum(one.n for one in fits),
        dof=sum(one.dof for one in fits),
        nodes=sum(one.nodes for one in fits),
        iterations=sum(one.iterations for one in fits),
        messages=tuple(dict.fromkeys(text for one in fits for text in one.messages)),
        **joined,
    )


def what_was_freed(fit: Fit, held: Fit) -> tuple[str, ...]:
    """In words: which parameters that vary by experiment were found on the fresh records, and from what."""
    said = []
    for record in held.data:
        for name in freed_for(fit, record.name):
            one = held.estimates.get(f"{name}@{record.name}", held.estimates.get(name))
            if one is None:
                continue
            prior = scatter_of(fit, name)
            known = (
                f"from the scatter of the fit's records, {prior[0]:.4g} ± {prior[1]:.2g}, and these data"
                if prior is not None
                else "on these data alone: the fit has fewer than three records, which tell no scatter"
            )
            bound = f", at its {'lower' if one.at_bound == 'min' else 'upper'} bound" if one.at_bound else ""
            said.append(
                f"{name} varies by experiment and was estimated on {record.name}, {known}: "
                f"{with_error(one.value, one.stderr)} {one.unit}{bound}"
            )
    return tuple(said)
