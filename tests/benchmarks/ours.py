"""The package under test, through its public names alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from cases import Case, Record
from chain import Array

import casadi_engine as ce

UNITS = {"theta": "rad", "T_load": "N m", "omega": "rad/s", **{f"p{c}": "Pa" for c in range(1, 13)}}
# The two-mass builder has names of its own.
TWO_MASS_NAMES = {"J1": "J_eng", "J2": "J_load", "K21": "K_el", "C21": "C_el", "C1": "C_eng"}


@cache
def _experiment(name: str, number: int, step: float) -> ce.Experiment:
    record = _RECORDS[number]
    channels, time = dict(record.channels), np.arange(record.samples) * step
    for array in (time, *channels.values()):  # the package shares what nobody can write into
        while array is not None:
            array.setflags(write=False)
            array = array.base
    return ce.Experiment.from_arrays(
        name,
        time=time,
        units={key: UNITS[key] for key in channels},
        **channels,
    )


_RECORDS: dict[int, Record] = {}


def experiments(case: Case) -> list[ce.Experiment]:
    """The records as the package reads them; built once, as reading is not part of any opponent's time."""
    for record in case.records:
        _RECORDS[id(record)] = record
    return [_experiment(record.name, id(record), case.step) for record in case.records]


def model_of(case: Case) -> tuple[ce.Model, dict[str, str]]:
    """The linear form of the case's chain, and its names of the case's parameters."""
    if case.shape.size == 2:
        return _model(0, None), TWO_MASS_NAMES
    return _model(len(case.shape.throws), case.offsets), {name: name for name in case.shape.names}


@cache
def _model(cylinders: int, offsets: tuple[float, ...] | None) -> ce.Model:
    """Of a crankshaft, or of two masses (0); built once: the opponents' equations are there before the clock starts."""
    if not cylinders:
        return ce.two_mass(reciprocating_speed="measured")
    options: dict[str, Any] = {} if offsets is None else {"firing_offsets": offsets}
    return ce.crankshaft(cylinders=cylinders, reciprocating_speed="measured", **options)


def parameters_of(case: Case, model: ce.Model, names: dict[str, str], start: Array) -> ce.Parameters:
    """The case's free parameters with starts, bounds and priors; ties; everything else fixed at the truth."""
    parameters = model.parameters()
    for name, value in zip(case.shape.names, case.truth, strict=True):
        parameters.fix(names[name], float(value))
    low, high = case.bounds
    for name, value, least, most in zip(case.free, start, low, high, strict=True):
        prior = {"prior": case.priors[name]} if name in case.priors else {}
        parameters[names[name]].set(float(value), min=float(least), max=float(most), vary=True, **prior)
    for leader, followers in case.ties.items():
        for name in followers:
            parameters[names[name]].set(min=-np.inf, max=np.inf, vary=True)
            parameters.tie(names[name], names[leader])
    return parameters


def estimate(case: Case, start: Array, mark: Callable[[], None] | None = None, **options: Any) -> ce.Fit:
    """One fit; `mark` is called at the solver's first iteration."""
    model, names = model_of(case)

    def watch(iteration: int, _cost: float, _fit: float) -> None:
        if iteration == 0 and mark is not None:
            mark()

    return ce.estimate(
        model,
        experiments(case),
        parameters=parameters_of(case, model, names, start),
        noise=ce.Noise(omega=case.sigma),
        progress=watch if mark is not None else False,
        **options,
    )


def values_of(case: Case, found: ce.Fit) -> Array:
    """The case's free values of a fit, in its order."""
    names = TWO_MASS_NAMES if case.shape.size == 2 else {name: name for name in case.shape.names}
    return np.array([found.values[names[name]] for name in case.free])


def fit(case: Case, start: Array, mark: Callable[[], None]) -> dict[str, Any]:
    """As the opponents; set-up is everything before the first iteration, the rest includes the covariance."""
    found = estimate(case, start, mark)
    return {"values": values_of(case, found), "iterations": found.iterations, "words": found.status}
