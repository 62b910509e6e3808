"""simulate: the outputs that a model gives for an experiment's inputs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Literal, overload

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.errors import SimulationError
from casadi_engine.estimation.estimate import estimate
from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.estimation.known_starts import found_from_known
from casadi_engine.estimation.loss import loss_of
from casadi_engine.estimation.options import as_number, begun_at, small
from casadi_engine.estimation.prediction import Prediction, check_band, with_band
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.experiment.channel import Step
from casadi_engine.model import Model
from casadi_engine.model.arrival import arriving, channel_unit
from casadi_engine.model.lags import lagged, with_nearest_lags
from casadi_engine.model.late_inputs import input_lags, late_inputs, read_late
from casadi_engine.parameters import Parameters, near_matches
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.discretisation import Method
from casadi_engine.simulation.grid import Grid, lay_grid
from casadi_engine.simulation.late_outputs import as_shown
from casadi_engine.simulation.values import simulated

Array = NDArray[np.float64]


@overload
def simulate(
    model: Model | Fit,
    data: Experiment,
    *,
    parameters: Parameters | Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    method: Method = "exact",
    tolerance: float = 1e-6,
    band: Literal[False] = False,
) -> Experiment: ...


@overload
def simulate(
    model: Any,
    data: Experiment,
    *,
    parameters: None = None,
    initial: Mapping[str, float] | None = None,
    method: Method = "exact",
    tolerance: float = 1e-6,
    band: Literal[True],
) -> Prediction: ...


@one_blas_thread
def simulate(
    model: Any,
    data: Experiment,
    *,
    parameters: Parameters | Mapping[str, float] | None = None,
    initial: Mapping[str, float] | None = None,
    method: Method = "exact",
    tolerance: float = 1e-6,
    band: bool = False,
) -> Experiment | Prediction:
    """Simulate a model over the time of an experiment; return its inputs with the simulated outputs beside them.

    model : the equations, or a Fit: its model at its parameters (a parameter that varies by experiment has the value
    of the
        record of that name, the records' mean in any other) and, for a record of the fit, from its initial states
    data : the inputs, and the outputs if they were measured
    parameters : a set, or name -> value (others at the model's defaults, or the fit's values), or None
    initial : state -> value. Numbers hold where the inputs begin, and the simulation starts there; states left out, or
        None for all, are fitted to the outputs by least squares (all at the first valid sample of the outputs, where no
        number is given). Estimates of a fit (``fit.initial["record"]``, taken as it is) hold at their own instant
    method : "exact", or "euler" for a linear model
    tolerance : largest estimated error of an output, relative to its largest value. A linear model is solved exactly;
        any other by steps that follow the error. Jumps in the equations (``sign``, ``if_else``) are met at
        their instant, and dry friction holds what is at rest. The last line of the result's history says which
        integrator ran and how far off it is
    band : True for a Prediction: the simulation of a fit with the 95 % bands that the errors of its parameters and
        initial states make, without and with the noise. In place of the fit a posterior (an object with ``fit`` and
        ``draws``, name -> (n,)) may be given, whose draws are then simulated

    What a late sensor shows before it shows the first instant was before the record: it is guessed, as the first
    samples go on backwards, and the history says for how long.

    Returns an Experiment with the input channels and one derived channel for each output, on the inputs' grid, in
    the units that the model declares.
    Raises SimulationError if initial states are missing and no output was measured; ExperimentError, ModelError.

    >>> import numpy as np, casadi_engine as ce
    >>> exp = ce.Experiment.from_arrays("idle", time=[0.0, 0.5, 1.0], units={"T": "N m"}, T=[0.0, 0.0, 0.0])
    >>> run = ce.simulate(ce.one_inertia(), exp, parameters={"J_eng": 1.0, "C_eng": 1.0},
    ...     initial={"omega_eng": 100.0})
    >>> run["omega"].values.round(3)
    array([100.   ,  60.653,  36.788])
    """
    source, fit, asked = model, check_band(model, parameters, band) or model, parameters
    if isinstance(fit, Fit):
        model, parameters, initial = _of_fit(fit, data, parameters, initial)
    _check_kinds(model, data, parameters, initial)
    data = arriving(model, data)
    given: dict[str, Any] = dict(initial or {})
    if not isinstance(source, Fit) and late_inputs(
        model
    ):  # a delay is what it says, not the law of a search for it
        before = {state.name for state in model.states}
        told = dict(zip(model.parameter_names, model.parameter_vector(parameters).tolist(), strict=True))
        model = read_late(model, input_lags(model, told, (data,), begun=False))
        for name in before - {state.name for state in model.states}:
            given.pop(name, None)
    names = [state.name for state in model.states]
    for name, value in given.items():
        number = as_number(value)
        if name in names and (number is None or not math.isfinite(number)):
            raise SimulationError(
                f"the initial value of {name} is not a finite number",
                seen=str(value),
                allowed="a number in the state's unit",
                cure="leave the state out to have it fitted",
            )
        if name not in names:
            raise SimulationError(
                f"the model {model.name} has no such state",
                seen=repr(name),
                allowed=near_matches(name, names),
                cure="print(model.table()) lists the states",
            )
    measured = _measured(model, data)
    missing = [name for name in names if name not in given]
    values = model.parameter_vector(parameters)
    if missing:
        if not measured:
            raise SimulationError(
                "the initial state is not known, and no output was measured to fit it to",
                seen=f"no value for {', '.join(missing)}",
                allowed=f"a value for each of {', '.join(names)}",
                cure="give initial={state: value, ...}",
            )
        given = _fitted_start(model, data, values, given, method, fit)
    of_fit = bool(measured) and all(isinstance(value, Estimate) for value in given.values())
    data = begun_at(data, given, model, ())
    known = dict(zip(model.parameter_names, values.tolist(), strict=True))
    model = with_nearest_lags(model, known, (data,), most=math.inf, begun=True)
    grid = (_fitted_grid if of_fit else _whole_grid)(
        lagged(model, {}), data
    )  # a late sensor is shifted at the end
    start = np.array([as_number(given[name]) for name in names], dtype=float)
    run = _run(model, data, values, start, replace(grid, measured={}), method, small(tolerance))
    if outside := _beyond_bounds(source, asked):
        last = run.history[-1]
        last = replace(last, arguments={**last.arguments, "outside of bounds": outside})
        run = replace(run, history=(*run.history[:-1], last))
    return with_band(source, fit, data, run, grid, given, method) if band else run


def _of_fit(
    fit: Fit, data: Any, parameters: Any, initial: Any
) -> tuple[Model, Parameters | dict[str, float], Mapping[str, Any] | None]:
    """Model, parameters and initial states of a fit for a record, where they are not given."""
    if not isinstance(parameters, Parameters):
        known = fit.values_for(getattr(data, "name", ""))
        own = {name: known[name] for name in fit.model.parameter_names}
        parameters = own | dict(parameters or {})
    if initial is None and isinstance(data, Experiment):
        begins = {record.name: _begin(fit.model, record) for record in fit.data}
        here = _begin(fit.model, data)
        if here is None:  # times alone, at which the fitted record is to go on
            here = min(
                (float(data[o.name].time[0]) for o in fit.model.outputs if o.name in data), default=None
            )
        if data.name in begins and begins[data.name] == here and _shows_the_same(fit, data):
            initial = fit.initial[data.name]
    return fit.model, parameters, initial


def _beyond_bounds(source: Any, asked: Any) -> dict[str, str]:
    """Numbers that were given outside the bounds that a model, or the set of a fit, gives its parameters."""
    if not isinstance(asked, Mapping):
        return {}
    known = source.parameters if isinstance(source, Fit) else source.parameters()
    outside = {}
    for name, value in asked.items():
        own, number = known[name], float(value)
        if not own.min <= number <= own.max:
            outside[name] = f"{number:g}, where its bounds are {own.min:g} and {own.max:g}"
    return outside


def _shows_the_same(fit: Fit, data: Experiment) -> bool:
    """False of another measurement under the name of a record of the fit: its outputs begin otherwise."""
    own, data = next(one for one in fit.data if one.name == data.name), arriving(fit.model, data)
    for name in set(_measured(fit.model, own)) & set(_measured(fit.model, data)):
        first, here = (one[name].values[one[name].mask][0] for one in (own, data))
        if not math.isclose(first, here, rel_tol=1e-9, abs_tol=1e-300):
            return False
    return True


def _measured(model: Model, data: Experiment) -> tuple[str, ...]:
    """The outputs of which there are samples."""
    return tuple(out.name for out in model.outputs if out.name in data and data[out.name].mask.any())


def _begin(model: Model, data: Experiment) -> float | None:
    """Where the valid samples of the outputs begin [s]."""
    channels = [data[out.name] for out in model.outputs if out.name in data]
    return min((float(c.time[c.mask][0]) for c in channels if c.mask.any()), default=None)


def _a_name(model: Any, kind: str) -> str:
    """A name of the model for an example, or a word where it has none or is no model."""
    return next((str(each.name) for each in getattr(model, kind, ())), "name")


def _check_kinds(model: Any, data: Any, parameters: Any, initial: Any) -> None:
    """Raise SimulationError for an argument that is of another kind than asked for, such as two exchanged ones."""
    kinds: tuple[tuple[str, Any, Any, str, str], ...] = (
        ("model", model, Model, "a Model or a Fit", "give simulate(model, experiment)"),
        ("data", data, Experiment, "one Experiment", "simulate several one by one"),
        ("parameters", parameters, (Parameters, Mapping, type(None)), "a set, name -> value, or None",
         f'write parameters={{"{_a_name(model, "declarations")}": 0.4}}, for instance'),
        ("initial", initial, (Mapping, type(None)), "state -> value, or None",
         f'write initial={{"{_a_name(model, "states")}": 0.5}}, for instance'),
    )  # fmt: skip
    for name, given, kind, allowed, cure in kinds:
        if not isinstance(given, kind):
            raise SimulationError(
                f"the argument {name} of simulate is of the wrong kind",
                seen=type(given).__name__,
                allowed=allowed,
                cure=cure,
            )


def _fitted_start(
    model: Model, data: Experiment, values: Array, given: Mapping[str, float], method: Method, source: Any
) -> dict[str, Any]:
    """The initial state that explains the measured outputs best, parameters held; as a fit does, where it is of one."""
    seen = _measured(model, data)
    known: Mapping[str, Any] = source.residual_level if isinstance(source, Fit) else {}
    noise = Noise(**{name: known[name] for name in seen if known.get(name, 0.0) > 0})
    rows = [k for k, out in enumerate(model.outputs) if out.name in seen]
    model = replace(
        model,
        outputs=tuple(model.outputs[k] for k in rows),
        output_expressions=ca.vertcat(*[model.output_expressions[k] for k in rows]),
    )
    fixed = model.parameters()
    for name, value in zip(model.parameter_names, values, strict=True):
        parameter = fixed[name]
        parameter.set(
            float(value), min=min(parameter.min, float(value)), max=max(parameter.max, float(value))
        )
        fixed.fix(name)
    find = partial(
        estimate, model, data, parameters=fixed, initial=given, noise=noise, loss=loss_of(source), method=method,
        progress=False,
    )  # fmt: skip
    fit = found_from_known(source, find, [data.name])
    if not fit.converged:
        raise SimulationError(
            "the initial state could not be fitted to the measured outputs",
            seen=fit.status,
            cure="give initial={state: value, ...}",
        )
    return dict(fit.initial[data.name])


def _fitted_grid(model: Model, data: Experiment) -> Grid:
    """The grid of a fit, from where its initial states hold to the last sample of the outputs, whether or not it has a
    value, as far as the inputs go."""
    outputs = [data[out.name] for out in model.outputs if out.name in data]
    fitted = lay_grid(model, data, outputs=tuple(channel.name for channel in outputs))
    inputs = [data[v.name].span[1] for v in model.inputs]
    last = min([max(channel.span[1] for channel in outputs), *inputs])
    if not last > fitted.time[-1] + 0.5 * fitted.step:
        return fitted
    for channel in outputs:
        time = _over(channel, fitted.start, last)
        data = data.with_channel(Channel(channel.name, channel.unit, time=time, values=np.zeros_like(time)))
    return lay_grid(model, data, outputs=tuple(channel.name for channel in outputs))


def _whole_grid(model: Model, data: Experiment) -> Grid:
    """The grid over all the time that the inputs cover (the outputs, if there are none), with the outputs' own times.

    `lay_grid` spans the valid samples of outputs: they are stood in for by ones that are valid all the time.
    """
    inputs = [v.name for v in model.inputs]
    outputs = [data[out.name] for out in model.outputs if out.name in data and out.name not in inputs]
    outputs = [channel for channel in outputs if channel.span[1] > channel.span[0]]
    if inputs or not outputs:
        coarse = lay_grid(model, data, outputs=())  # says what is missing
        first, last = coarse.start, float(coarse.time[-1])
    else:
        first, last = min(c.span[0] for c in outputs), max(c.span[1] for c in outputs)
    for channel in outputs:
        time = _over(channel, first, last)
        data = data.with_channel(Channel(channel.name, channel.unit, time=time, values=np.zeros_like(time)))
    return lay_grid(model, data, outputs=tuple(channel.name for channel in outputs))


def _over(channel: Channel, first: float, last: float) -> Array:
    """The channel's times from ``first`` to ``last``, at its own rate beyond its span where it has one."""
    rate, near = channel.rate, 0.0
    if rate is None:
        time = channel.time
    else:
        begin, near = channel.time[0] - np.floor((channel.time[0] - first) * rate + 1e-6) / rate, 1e-6 / rate
        time = begin + np.arange(np.floor((last - begin) * rate + 1e-6) + 1) / rate
    inside = time[(time > first + near) & (time < last - near)]
    return np.concatenate([[first], inside, [last]])


def _run(
    model: Model,
    data: Experiment,
    values: Array,
    start: Array,
    grid: Grid,
    method: Method,
    tolerance: float,
) -> Experiment:
    """The simulation from a known start over a grid, as an experiment."""
    inputs = data.only(*[v.name for v in model.inputs]) if model.inputs else data
    found = simulated(model, grid, values, start, method=method, tolerance=tolerance)
    measured = [out.name for out in model.outputs if out.name in data]
    result = inputs if model.inputs else data.only(*measured)
    shown = grid.time[:: grid.parts]
    for out, row in zip(model.outputs, as_shown(model, grid, found.outputs), strict=True):
        result = result.with_channel(
            Channel(
                out.name, channel_unit(out, data), time=shown, values=row[:: grid.parts], origin="derived"
            )
        )
    about = found.integration.to_dict()
    if any(lag for _, lag in model.lags):
        about["guessed before the first instant is shown"] = {
            name: f"{abs(lag):.6g} s" for name, lag in model.lags if lag
        }
    step = Step("simulate", {"model": model.name, **about}, len(shown), len(shown))
    return replace(result, history=(*result.history, step))
