"""Records of a task: inputs of a manoeuvre, noise of a sensor, and the model that a user has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

import casadi_engine as ce
from hidden_terms.kind import Kind, Task, start_values, true_values

# Coefficient of coloured noise; steps of an encoder and the noise beneath them, in standard deviations of the noise.
_COLOUR, _STEP, _BENEATH = 0.8, 3.0, 0.5


@dataclass(frozen=True)
class Case:
    """What `repair` is given, and what is true of it.

    model, parameters, data, fresh, effects : for `ce.repair`
    values : true parameters and amplitudes; sigma : of the noise by output; clean : noise-free fresh outputs
    states : (N, n) noise-free states of `data`, for rivals that are given them
    """

    model: Any
    parameters: Any
    data: Any
    fresh: Any
    effects: Any
    values: Mapping[str, float]
    sigma: Mapping[str, float]
    clean: Mapping[str, np.ndarray]
    states: np.ndarray


def case_of(kind: Kind, task: Task) -> Case:
    """Simulate, add noise, and write the model down."""
    model = kind.model(task.outputs)
    free = [one.name for one in model.declarations if one.vary]
    values = true_values(kind, task, free)
    runs = [kind.manoeuvres[name](task.rng(f"manoeuvre {k}")) for k, name in enumerate(task.pair)]
    values["event"] = runs[0].event
    courses = [kind.course(values, run) for run in runs]
    sigma = {name: float(np.std(courses[0][name])) * 10 ** (-task.snr / 20) for name in task.outputs}
    records = []
    for k, (run, course) in enumerate(zip(runs, courses, strict=True)):
        rng = task.rng(f"noise {k}")
        measured = {name: noisy(course[name], sigma[name], task.noise, rng) for name in task.outputs}
        # an input may itself be measured in the course: the crank angle of an engine
        channels = {key: course.get(key, given) for key, given in run.inputs.items()} | measured
        units = {name: kind.units[name] for name in channels}
        name = ("found_on", "fresh")[k]
        records.append(ce.Experiment.from_arrays(name, time=run.time, units=units, **channels))
    model = with_terms(kind, model, task.declared, values)
    parameters = model.parameters()
    for name, value in start_values(kind, task, free).items():
        parameters[name].set(value)
    effects = None if kind.effects is None else list(kind.effects())
    states = courses[0]["states"][:, : len(model.states)]
    clean = {name: courses[1][name] for name in task.outputs}
    return Case(model, parameters, records[0], records[1], effects, values, sigma, clean, states)


def with_terms(
    kind: Kind, model: Any, names: tuple[str, ...], values: Mapping[str, float], *, sharp: bool = False
) -> Any:
    """The model with true terms, starting at half their true size."""
    for name in names:
        one = kind.terms[name]
        nuisance = {
            key: values["event"] if value == "event" else value for key, value in one.nuisance.items()
        }
        start = {one.effect.amplitude.name: 0.5 * values[name], **nuisance}
        model = model.with_effect(one.effect, at=one.at, values=start, sharp=sharp)
    return model


def noisy(clean: np.ndarray, sigma: float, noise: str, rng: np.random.Generator) -> np.ndarray:
    """What a sensor shows, with a standard deviation of about `sigma` off the truth."""
    e = rng.standard_normal(len(clean) + 200)
    if noise == "white":
        return clean + sigma * e[200:]
    if noise == "coloured":
        return clean + sigma * np.sqrt(1 - _COLOUR**2) * lfilter([1.0], [1.0, -_COLOUR], e)[200:]
    step = _STEP * sigma
    return step * np.round((clean + _BENEATH * sigma * e[200:]) / step)


# ---- inputs as a person applies them


def levels(rng: np.random.Generator, count: int, hold: int, low: float, high: float) -> np.ndarray:
    """Levels between `low` and `high`, each held for `hold` samples, with a ramp of one sample between them."""
    return np.repeat(rng.uniform(low, high, count // hold + 1), hold)[:count]


def sines(rng: np.random.Generator, time: np.ndarray, size: float, hertz: tuple[float, ...]) -> np.ndarray:
    """A sum of sines with phases by chance, `size` its largest value."""
    found = sum(np.sin(2 * np.pi * f * time + rng.uniform(0, 2 * np.pi)) for f in hertz)
    return size * found / np.abs(found).max()
