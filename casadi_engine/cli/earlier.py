"""Parameter values of an earlier fit or repair, from its result.json, and the effects that a repair found."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from casadi_engine.cli.job import say
from casadi_engine.cli.options import Options
from casadi_engine.errors import ResultError

if TYPE_CHECKING:
    from casadi_engine.estimation import Fit
    from casadi_engine.experiment import Experiment
    from casadi_engine.model import Model
    from casadi_engine.parameters import Parameters
    from casadi_engine.problem import Problem

# Share by which two copies of a value in one file may differ.
_EQUAL = 1e-9

From = Annotated[
    Path | None,
    typer.Option(
        "--from",
        metavar="RESULT",
        help="result.json of an earlier fit or repair (or its folder) that gives the values, and the effects found.",
    ),
]


def as_repaired(path: Path, problem: Problem) -> Problem:
    """The problem with what a stored repair found: effects in its model, and how inputs of its records go on between
    their samples where it took them otherwise than they were read; as it is for any other result.

    ResultError for an effect that is none of the library's.
    """
    found = _document(path)
    if found.get("equations") not in (None, equations_of(problem.model)):
        say(
            f"The equations of {problem.model.name} are not those that {path} was made with: its values may mean "
            "something else here"
        )
    status = found.get("status")
    if found.get("command") in ("fit", "repair") and status not in ("converged", "answered"):
        say(
            f"The {found['command']} of {path} did not end ({status}): its values are no optimum, and what follows "
            "is of them"
        )
    if found.get("command") != "repair":
        return problem
    return _with_holds(_with_effects(path, problem, found.get("effects") or ()), found.get("with_hold") or {})


def equations_of(model: Model) -> str:
    """By which equations are known again: a digest of their text."""
    return hashlib.sha256(model.equations().encode()).hexdigest()


def _with_effects(path: Path, problem: Problem, added: Iterable[Mapping[str, Any]]) -> Problem:
    """The problem with stored effects in its model."""
    from casadi_engine.effects import library
    from casadi_engine.effects.protocol import moves, with_settings
    from casadi_engine.errors import EffectError

    model = problem.model
    for one in added:
        name, at = str(one["name"]), str(one["at"])
        try:
            (effect,) = library(name)
            # a result of before has but the width and the mean, beside the parameters
            own = one.get("settings") or {
                key: one[key] for key in ("width", "about") if one.get(key) is not None
            }
            effect = with_settings(effect, own)
            known = {key.rpartition(".")[2]: value for key, value in (one.get("constants") or {}).items()}
            if moves(effect):
                say(
                    f"{name} at {at} is an event of the records it was found in: here it happens at the same time"
                )
            model = model.with_effect(
                effect, at=at, values={k: known[k] for k in effect.nuisance if k in known}
            )
        except EffectError as error:
            raise ResultError(
                f"{path}: the effect {name} at {at} that was found cannot be added to the model of the problem file",
                seen=error.problem,
                allowed="effects of the library, at ports of the model that the result was made with",
                cure=f'write it into the problem file: model = model.with_effect(..., at="{at}")',
            ) from None
    if model is problem.model:
        return problem
    return dataclasses.replace(problem, model=model, parameters=problem.parameters.extended(model))


def _with_holds(problem: Problem, holds: Mapping[str, str]) -> Problem:
    """The problem whose records are read with inputs that go on so between their samples."""
    from casadi_engine.experiment import Experiment

    if not holds:
        return problem

    def held(record: Any) -> Any:
        if not isinstance(record, Experiment):
            return record
        return record.with_hold(**{name: hold for name, hold in holds.items() if name in record})

    read = " and ".join(f'{name}="{hold}"' for name, hold in holds.items())
    say(f"The records are read as the repair took them, with_hold({read})")
    records, others = (tuple(map(held, part)) for part in (problem.records, problem.validation))
    return dataclasses.replace(
        problem, read=lambda path: held(problem.read(path)), records=records, validation=others
    )


def values_of(path: Path, parameters: Parameters, *, given: Options) -> Parameters:
    """Return a copy of `parameters` with the values of a stored fit, but for those that `given` sets.

    path : a result.json, or the folder that holds one. ResultError if it holds no parameters, none for a
    parameter of the set, one that the set does not have, or values by record for one of the set.
    """
    from casadi_engine.model.corners import WIDTH
    from casadi_engine.parameters import near_matches

    result = parameters.copy()
    # jumps that a repair rounded are sharp in the problem's own model
    stored = {k: v for k, v in _stored(path).items() if k in result or not k.endswith(WIDTH)}
    chosen = {text.partition("=")[0].strip() for text in (*given.set, *given.fix) if "=" in text}
    unknown = [name for name in stored if name.partition("@")[0] not in result]
    if unknown:
        raise ResultError(
            f"{path}: the result has a parameter that the problem does not have",
            seen=unknown[0],
            allowed=near_matches(unknown[0], result),
            cure="give the problem file that the result was made with",
        )
    for name, parameter in result.items():
        if parameter.tie is not None or name in chosen:
            continue
        if name in stored:
            value = _in_its_unit(path, name, stored[name], parameter.unit)
            parameter.set(_within(value, parameter.min, parameter.max))
        elif name not in given.free:
            by_record = [key for key in stored if key.startswith(f"{name}@")]
            raise ResultError(
                f"{path}: the result has no single value of the parameter {name}",
                seen=", ".join(by_record) or "none",
                allowed=f"a value of {name}",
                cure=f"give it by --set {name}=VALUE, or estimate it on these records by --free {name}",
            )
    return result


def noise_of(path: Path) -> dict[str, tuple[float, float]]:
    """Output -> standard deviation of the noise that a stored fit found, and from how many degrees of freedom; none of
    a fit with a gain, whose residuals are innovations."""
    stored = _document(path)
    if stored.get("gain") is not None:
        return {}
    dof = stored.get("dof")
    return {
        name: (one["sigma"], float(dof or 1) if one.get("estimated") else math.inf)
        for name, one in (stored.get("noise") or {}).items()
        if isinstance(one, Mapping) and isinstance(one.get("sigma"), (int, float))
    }


def same_files(path: Path, records: Iterable[Experiment]) -> list[str]:
    """Names of the records whose files are those that a stored result was found from."""
    known = {one.get("sha256") for one in _document(path).get("inputs") or ()} - {None}
    return [one.name for one in records if one.sha256 in known]


def stands_for(path: Path, found: Fit, parameters: Parameters, *, given: Options) -> Fit | None:
    """A Fit that knows of its parameters what a stored one does, their errors and the noise; None where the file does
    not tell all of it, or the values are not all those of the file.

    found : a fit of other records with the stored values held; parameters : the problem's
    """
    import numpy as np

    from casadi_engine.estimation.fit import Estimate
    from casadi_engine.estimation.parameter_errors import ParameterErrors

    stored = _document(path)
    free, rows = tuple(stored.get("free") or ()), stored.get("covariance") or ()
    entries, levels = stored.get("parameters") or {}, noise_of(path)
    whole = free and levels and not stored.get("undetermined") and all(name in parameters for name in free)
    if not whole or given.set or given.free or given.fix or set(levels) != set(found.noise):
        return None
    known = [entries[name] for name in free]
    _check_errors(path, dict(zip(free, known, strict=True)))
    if any(
        one.get("stderr") is None or one.get("unit") != parameters[name].unit
        for one, name in zip(known, free, strict=True)
    ):
        return None
    covariance = np.array([[math.nan if v is None else v for v in row] for row in rows], dtype=float)
    told = covariance.shape == (len(free),) * 2 and np.isfinite(covariance).all()
    if not told or not (np.diag(covariance) > 0).all():
        return None
    source = parameters.copy()
    for name, own in source.items():
        if own.tie is None:
            own.set(vary=name in free)
    errors = [Estimate(one["value"], one["stderr"], one["unit"]) for one in known]
    scale = np.sqrt(np.diag(covariance))
    nothing = np.zeros((len(free), 0))
    return dataclasses.replace(
        found, parameters=source, data=(), traces={}, free=free, noise=_levels(levels),
        dof=float(stored.get("dof") or 1),
        estimates={**found.estimates, **dict(zip(free, errors, strict=True))},
        errors=ParameterErrors.of(free, covariance, nothing, scale, np.zeros(len(free))), messages=(),
    )  # fmt: skip


def _check_errors(path: Path, known: Mapping[str, Mapping[str, Any]]) -> None:
    """ResultError for a standard error that is none."""
    for name, one in known.items():
        error = one.get("stderr")
        if error is not None and not (isinstance(error, (int, float)) and 0 < error < math.inf):
            raise ResultError(
                f"{path}: the standard error of {name} is not a positive number",
                seen=str(error),
                allowed="a positive number, or null where it is not known",
                cure="take the file as the fit wrote it",
            )


def _levels(levels: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, bool]]:
    return {name: (sigma, math.isfinite(dof)) for name, (sigma, dof) in levels.items()}


def _in_its_unit(path: Path, name: str, found: tuple[float, str], unit: str) -> float:
    """A stored value in the unit of the problem's parameter."""
    from casadi_engine.errors import UnitError
    from casadi_engine.experiment.units import converted

    value, own = found
    if own == unit or not own:
        return value
    try:
        changed = float(converted([value], own, unit)[0])
    except UnitError:
        raise ResultError(
            f"{path}: the unit of the parameter {name} is another one in the problem",
            seen=f"{own} in the result, {unit} in the problem",
            allowed="a unit of the same quantity",
            cure=f"give it by --set {name}=VALUE, or the problem file that the result was made with",
        ) from None
    say(f"{name} = {value:.6g} {own} of {path} is {changed:.6g} {unit} here")
    return changed


def _stored(path: Path) -> dict[str, tuple[float, str]]:
    """Name -> value of a result, and its unit."""
    entries = _document(path).get("parameters") or {}
    values = {
        name: (entry["value"], str(entry.get("unit") or ""))
        for name, entry in entries.items()
        if isinstance(entry.get("value"), (int, float)) and math.isfinite(entry["value"])
    }
    for name, value, other in _contradicting(values, _document(path).get("parameter_set")):
        raise ResultError(
            f"{path}: the result holds two values of the parameter {name}",
            seen=f"{value:.8g} in parameters, {other:.8g} in parameter_set",
            allowed="one value in both, as a fit writes them",
            cure=f"take the file as the fit wrote it, and give another value by --set {name}=VALUE",
        )
    if not values:
        raise ResultError(
            f"{path}: the result holds no parameter values",
            allowed="the result.json of a fit",
            cure="run `casadi-engine fit` first",
        )
    return values


def _contradicting(
    values: Mapping[str, tuple[float, str]], stored: Any
) -> Iterable[tuple[str, float, float]]:
    """Parameters that have another value in the stored set."""
    rows = stored.get("parameters") if isinstance(stored, Mapping) else None
    for row in rows if isinstance(rows, list) else ():
        name, other = (str(row.get("name")), row.get("value")) if isinstance(row, Mapping) else ("", None)
        if name not in values or not isinstance(other, (int, float)) or row.get("tie") is not None:
            continue
        if not math.isclose(values[name][0], other, rel_tol=_EQUAL, abs_tol=1e-300):
            yield name, values[name][0], float(other)


def _document(path: Path) -> Mapping[str, Any]:
    from casadi_engine.report import load_result

    stored: Any = load_result(path / "result.json" if path.is_dir() else path)
    return stored if isinstance(stored, Mapping) else {}


def _within(value: float, low: float, high: float) -> float:
    """The value moved into its bounds if only the solver's tolerance took it out."""
    slack = 1e-6 * max(abs(value), 1e-12)
    if low - slack <= value < low:
        return low
    return high if high < value <= high + slack else value
