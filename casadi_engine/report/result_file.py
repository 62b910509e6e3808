"""result.json: what a command found, as plain data by a fixed contract."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from functools import singledispatch
from pathlib import Path
from typing import Any

import numpy as np

import casadi_engine
from casadi_engine.errors import OutputError, ParameterError
from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.estimation.summary import parameter_of
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.report.files import write_file
from casadi_engine.report.kinds import Simulated, shown_by_others
from casadi_engine.report.plain import plain
from casadi_engine.validation.validate import Validation

SCHEMA = "casadi-engine/1"
NO_PREDICTOR = "output error: the model is simulated, there is no predictor"


def to_result(
    result: Any,
    *,
    command: str,
    arguments: Mapping[str, Any],
    seconds: float,
    seed: int | None,
) -> dict[str, Any]:
    """Return a Fit, a Validation or a Simulated as the plain data of result.json.

    command : "fit", "validate", "simulate", "repair" or "posterior".  arguments : what the command was given, JSON-able
    seconds : wall time without imports [s].  seed : of the multi-start

    Every null in place of a number has a reason under ``why`` of the same object.
    Raises ResultError for another kind of result, or arguments that JSON cannot hold.
    """
    found = content(result)
    common = {
        "command": command,
        "schema": SCHEMA,
        "version": casadi_engine.__version__,
        "status": found.pop("status"),
        "seconds": float(seconds),
        "timing": found.pop("timing"),
        "seed": seed,
        "arguments": dict(arguments),
    }
    document: dict[str, Any] = plain(common | found)
    return document


def write_result(path: Any, document: Mapping[str, Any]) -> Path:
    """Write result.json atomically and return its path.

    Raises OutputError when it cannot be written (the old file stays), ResultError for data that are not JSON.
    """
    text = json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False)
    return write_file(path, (text + "\n").encode())


def save_result(result: Any, path: Any, command: str, seconds: float, seed: int | None) -> Path:
    """Write a result as NAME.json, or as result.json into a folder, which is made; return the path of the file.

    OutputError where a file of that name is there that is no result.
    """
    named = isinstance(path, str | os.PathLike) and not os.fsdecode(path).endswith(".json")
    file = os.path.join(os.fsdecode(path), "result.json") if named else path
    _refuse_others(file)
    return write_result(file, to_result(result, command=command, arguments={}, seconds=seconds, seed=seed))


def _refuse_others(path: Any) -> None:
    """OutputError for a path under which there is a file that is no result."""
    if not isinstance(path, str | os.PathLike) or not os.path.isfile(path):
        return  # the writer says what else is wrong
    try:
        found = json.loads(Path(os.fsdecode(path)).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or not {"schema", "command"} <= set(found):
        raise OutputError(
            f"a file of this name would be lost: {os.fsdecode(path)}",
            seen="a file that is no result of this program",
            allowed="a new file, or an earlier result, which is replaced",
            cure="give another name, or move the file away",
        )


@singledispatch
def content(result: Any) -> dict[str, Any]:
    """What one kind of result puts into result.json."""
    found: dict[str, Any] = shown_by_others(content, result, "result.json")(result)
    return found


@content.register
def _(result: Fit) -> dict[str, Any]:
    return {
        "status": result.status,
        "timing": dict(result.timing),
        "inputs": describe(result.data, result.model),
        "noise": noise(result),
        "cost": result.cost,
        "n": result.n,
        "parameters": parameters_of(result),
        "iterations": result.iterations,
        "nodes": result.nodes,
        "optima": optima_of(result),
        "fit_percent": {
            record: {output: percents(found) for output, found in outputs.items()}
            for record, outputs in result.fit_percent.items()
        },
        "gain": _gain(result),
        **_for_warm_start(result),
    }


@content.register
def _(result: Validation) -> dict[str, Any]:
    fit: Fit = result.fit
    cost, n = _cost(result)
    return {
        "status": "answered",
        "timing": {},
        "inputs": describe(result.fit.data, fit.model),
        "noise": noise(fit),
        "cost": cost,
        "n": n,
        "parameters": parameters_of(fit),
        "records": {
            record: {output: _check(check) for output, check in outputs.items()}
            for record, outputs in result.records.items()
        },
        "passed": bool(result.passed),
        "alpha": result.alpha,
        "failed": list(result.failed),
        "notes": list(result.notes),
        "fit_status": fit.status,
    } | ({} if result.parameters is None else {"parameter_check": result.parameters.to_dict()})


@content.register
def _(result: Simulated) -> dict[str, Any]:
    why = "a simulation is not held against measurements"
    return {
        "status": "answered",
        "timing": {},
        "inputs": describe(result.data, result.model),
        "noise": {},
        "cost": None,
        "n": None,
        "why": {"cost": why, "n": why},
        "parameters": plain_parameters(result.parameters),
        "files": list(result.files),
    }


# ---- parts --------------------------------------------------------------------------------------------


def describe(data: Sequence[Experiment], model: Model) -> list[dict[str, Any]]:
    """The records: file, sha256, samples, outputs, history and what else is known of them."""
    names = [variable.name for variable in model.outputs]
    made = [
        experiment.describe(outputs=[name for name in names if name in experiment]) for experiment in data
    ]
    for channel in (channel for entry in made for channel in entry["channels"]):
        if channel["rate"] is None:
            channel["why"] = {"rate": "the times are not evenly spaced"}
    return made


def optima_of(fit: Fit) -> list[dict[str, Any]]:
    """The local optima of a multi-start, the best first."""
    return [
        {
            "cost": one.cost,
            "values": dict(one.values),
            "starts": one.starts,
            "status": one.status,
            "apart": one.apart,
        }
        for one in fit.optima
    ]


def noise(fit: Fit) -> dict[str, Any]:
    """Output -> sigma in its unit, and whether it was estimated."""
    return {
        name: {"sigma": sigma, "estimated": bool(estimated)} for name, (sigma, estimated) in fit.noise.items()
    }


def _gain(fit: Fit) -> dict[str, Any] | None:
    """The one-step predictor, (2.10); null for output error."""
    found = fit.innovations
    if found is None:
        return None
    return {
        "kind": found.kind,
        "states": list(found.states),
        "outputs": list(found.outputs),
        "L": found.gain,
        "K": found.kalman,
        "K_stderr": found.stderr,
        "sigma": dict(found.sigma),
        "radius": found.radius,
        "every": found.every,
        "why": {}
        if np.isfinite(found.stderr).all()
        else {"K_stderr": "null: nothing estimated moves it, or its error is not known"},
    }


def parameters_of(fit: Fit) -> dict[str, Any]:
    """Name -> the contract's entry, for every parameter of the fit and every ``name@record``."""
    return {name: _entry(estimate, parameter_of(fit, name)) for name, estimate in fit.estimates.items()}


def plain_parameters(parameters: Parameters) -> dict[str, Any]:
    """The same for parameters that were given, not estimated."""
    values = parameters.as_dict()
    return {
        name: _entry(Estimate(values[name], None, parameter.unit, why="not estimated", fixed=True), parameter)
        for name, parameter in parameters.items()
    }


def _entry(estimate: Estimate, parameter: Any) -> dict[str, Any]:
    why = _why(estimate)
    low, high = (-np.inf, np.inf) if parameter is None else (parameter.min, parameter.max)
    if not np.isfinite(low):
        why["min"] = "no lower bound"
    if not np.isfinite(high):
        why["max"] = "no upper bound"
    return {
        "value": estimate.value,
        "stderr": _stderr(estimate),
        "unit": estimate.unit,
        "min": low if np.isfinite(low) else None,
        "max": high if np.isfinite(high) else None,
        "vary": bool(parameter is not None and parameter.vary),
        "tie": None if parameter is None else parameter.tie,
        "at_bound": estimate.at_bound,
        **({} if estimate.interval is None else {"interval": list(estimate.interval)}),
        "prior": None if parameter is None or parameter.prior is None else list(parameter.prior),
        "why": why,
    }


def _stderr(estimate: Estimate) -> float | None:
    return None if estimate.at_bound or estimate.fixed else estimate.stderr


def _why(estimate: Estimate) -> dict[str, str]:
    if _stderr(estimate) is not None:
        return {}
    reason = "it is fixed" if estimate.fixed else "not known"
    if estimate.at_bound:
        reason = "it rests on its bound: no symmetric error"
    return {"stderr": estimate.why or reason}


def percents(found: Mapping[str, float | None]) -> dict[str, Any]:
    """Fit percentages (2.32) of one output, with the reason where there is none."""
    made: dict[str, Any] = {}
    for key in ("simulation", "prediction"):
        value = found.get(key)
        made[key] = value if value is not None and np.isfinite(value) else None
    reasons = {
        "simulation": "the measured output does not vary: (2.32) divides by its variation",
        "prediction": NO_PREDICTOR,
    }
    why = {key: reasons[key] for key, value in made.items() if value is None}
    return made | ({"why": why} if why else {})


def _for_warm_start(fit: Fit) -> dict[str, Any]:
    """What the contract does not ask for and a later fit can start from."""
    why: dict[str, str] = {}
    try:
        stored: dict[str, Any] | None = fit.parameters.to_dict()
    except ParameterError as error:  # a tie or constraint in CasADi that has no text
        stored, why["parameter_set"] = None, str(error)
    return {
        "model": fit.model.name,
        "dof": fit.dof,
        "free": list(fit.free),
        "start": dict(fit.start),
        "covariance": fit.covariance,
        "undetermined": [
            {"text": direction.text, "weights": dict(direction.weights)} for direction in fit.undetermined
        ],
        "initial_states": {
            record: {
                state: {
                    "value": estimate.value,
                    "stderr": _stderr(estimate),
                    "unit": estimate.unit,
                    "at_bound": estimate.at_bound,
                    "fixed": estimate.fixed,
                    "why": _why(estimate),
                }
                for state, estimate in states.items()
            }
            for record, states in fit.initial.items()
        },
        "parameter_set": stored,
        "options": {key: _option(value) for key, value in fit.options.items()},
        "messages": list(fit.messages),
        "why": why,
    }


def _option(value: Any) -> Any:
    """An option as data; what JSON cannot hold (a noise object, a callable) by its printed form."""
    if isinstance(value, Mapping):
        return {str(key): _option(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_option(entry) for entry in value]
    if value is None or isinstance(value, bool | int | float | str | np.generic | np.ndarray):
        return value
    return repr(value)


def _check(check: Any) -> dict[str, Any]:
    tests = {"whiteness_p": check.whiteness, "mean_p": check.mean, "size_p": check.size}
    tests |= {f"cross_p.{name}": test for name, test in check.cross.items()}
    return {
        "fit_percent": percents(check.fit_percent),
        "rmse": check.rmse,
        "S1": check.S1,
        "S2": check.S2,
        "whiteness_p": check.whiteness.p_value,
        "mean_p": check.mean.p_value,
        "size_p": check.size.p_value,
        "cross_p": {name: test.p_value for name, test in check.cross.items()},
        # Reasons of cross_p stand here under "cross_p.<drive>": cross_p itself holds drives alone.
        "why": {key: test.why or "no test" for key, test in tests.items() if test.p_value is None},
    }


def _cost(validation: Any) -> tuple[float, int]:
    """Σ((y − ŷ)/σ)² of the validated records with the fit's σ, and the number of samples that count."""
    cost, n = 0.0, 0
    for outputs in validation.records.values():
        for output, check in outputs.items():
            residual = check.trace.residual[check.trace.mask]
            sigma = validation.fit.residual_level[output]
            cost += float(np.sum((residual / sigma) ** 2))
            n += residual.size
    return cost, n
