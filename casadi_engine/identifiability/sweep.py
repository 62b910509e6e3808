"""loss_sweep: the loss as one parameter at a time is moved, the others held (Figure 4.6 of the thesis)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError, SimulationError
from casadi_engine.estimation.options import whole
from casadi_engine.identifiability.fisher import Frame
from casadi_engine.identifiability.operating import OperatingRecord, planned
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, near_matches

Array = NDArray[np.float64]

_RECIPROCAL = "1/"


@dataclass(frozen=True, eq=False)
class LossSweep:
    """The loss V = (1/N) sum of e²/2 (2.16) over one parameter at a time.

    values : name -> (P,) of the parameter (or of its reciprocal); loss : name -> (P,) in squared output units, NaN
    where the simulation is not finite; reference : name -> the value that the others were held at
    at_reference : V at the reference values; samples : N; start : "fitted" or "held"
    """

    model: Model
    values: Mapping[str, Array]
    loss: Mapping[str, Array]
    reference: Mapping[str, float]
    units: Mapping[str, str]
    at_reference: float
    samples: int
    start: str

    def __str__(self) -> str:
        from casadi_engine.identifiability.practical_summary import sweep_text

        return sweep_text(self)

    def minimum(self, name: str) -> tuple[float, float]:
        """Parameter and loss at the lowest point of the sweep."""
        k = int(np.nanargmin(self.loss[name]))
        return float(self.values[name][k]), float(self.loss[name][k])

    def has_minimum(self, name: str) -> bool:
        """True if the lowest point lies inside the range swept, and both ends are higher."""
        loss = self.loss[name][np.isfinite(self.loss[name])]
        k = int(np.argmin(loss))
        return 0 < k < len(loss) - 1


def loss_sweep(
    model: Model,
    data: Any,
    *names: str,
    parameters: Parameters | None = None,
    span: tuple[float, float] = (0.0, 2.5),
    points: int = 51,
    start: str | Mapping[str, float] = "fitted",
) -> LossSweep:
    """Sweep the loss over one parameter at a time while the others are held at the values of the set.

    names : free parameters (default: all that are free), or "1/name" to step in the reciprocal as the thesis does
    span : range of each in units of its value; points : number of values, and the reference beside them
    start : initial states. "fitted": estimated anew at every point; "held": estimated at the reference values and
        kept; or state -> value, known (the thesis's way)
    Only outputs that were measured count; noise has no part in it.

    Raises EstimationError for an unknown name, an empty range, or data without measured outputs.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> run = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)))
    >>> pars = ce.one_inertia().parameters()
    >>> pars["J_eng"].set(0.4), pars["C_eng"].set(0.5)
    (<Parameter ...>, <Parameter ...>)
    >>> swept = loss_sweep(ce.one_inertia(), run, "C_eng", parameters=pars, points=26)
    >>> round(swept.minimum("C_eng")[0], 3), swept.has_minimum("C_eng")
    (0.5, True)
    """
    whole("points", points, 3)
    whole_set = model.parameters() if parameters is None else parameters
    chosen = names or tuple(name for name, one in whole_set.items() if one.vary)
    low, high = _span(span)
    known, way = _start(start)
    plans = planned(data)
    plans = tuple(replace(plan, start={**plan.start, **known}) for plan in plans)
    values, losses, reference, units = {}, {}, {}, {}
    middle, samples = np.nan, 0
    for name in chosen:
        plain = name.removeprefix(_RECIPROCAL)
        own = _alone(whole_set, plain)
        frame = Frame(model, own, tuple(plan.name for plan in plans))
        line = _Line(frame, plans, hold=way == "held")
        at = own[plain].value if plain == name else 1 / own[plain].value
        grid = np.unique(np.append(at * np.linspace(low, high, points), at))
        with np.errstate(divide="ignore"):
            z = grid if plain == name else 1 / np.where(grid == 0, np.nan, grid)
        values[name], losses[name] = grid, np.array([line.loss(value) for value in z])
        reference[name], units[name] = (
            float(at),
            own[plain].unit if plain == name else f"1/({own[plain].unit})",
        )
        middle, samples = line.loss(own[plain].value), line.samples
    return LossSweep(model, values, losses, reference, units, float(middle), samples, way)


class _Line:
    """The loss of some records as a function of one parameter."""

    def __init__(self, frame: Frame, plans: Sequence[Any], *, hold: bool) -> None:
        self.frame, self.records, starts = frame, [], []
        for plan in plans:
            record, seen = frame.linearise(plan)
            if not seen.was_measured.all():
                raise EstimationError(
                    f"{plan.name}: a loss needs measured outputs",
                    seen=", ".join(plan.experiment.names),
                    allowed=f"a record with {', '.join(record.outputs)}",
                    cure="give a record that was measured; fisher takes planned ones",
                )
            self.records.append(record)
            starts.append(seen.start)
        self.samples = sum(record.count for record in self.records)
        if hold:
            names = [state.name for state in frame.model.states]
            for k, start in enumerate(starts):
                given = dict(zip(names, start.tolist(), strict=True))
                held = replace(self.records[k].plan, start=given)
                physical = self.records[k].physical
                self.records[k] = OperatingRecord(frame.model, held, frame.coordinates.symbol, physical)

    def loss(self, value: float) -> float:
        """V at this value of the parameter; NaN where it cannot be simulated."""
        if np.isnan(value):
            return float("nan")
        v = self.frame.coordinates.of(np.array([value]))
        total = 0.0
        try:
            for record in self.records:
                with np.errstate(all="ignore"):
                    total += float(np.sum(record.at(v, closest=True).residual ** 2))
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            return float("nan")
        return 0.5 * total / self.samples


def _alone(parameters: Parameters, name: str) -> Parameters:
    """A copy of the set in which this parameter alone is free."""
    free = [key for key, one in parameters.items() if one.vary]
    if name not in free:
        raise EstimationError(
            "this parameter cannot be swept, for it is not free",
            seen=repr(name),
            allowed=near_matches(name, free) if free else "(no parameter is free)",
            cure='give free parameters, or "1/name" for a reciprocal',
        )
    made = parameters.copy()
    for key in free:
        if key != name:
            made.fix(key)
    return made


def _span(span: Any) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in span)
        good = 0 <= low < high < np.inf
    except (TypeError, ValueError):
        good = False
    if not good:
        raise EstimationError(
            "the range of a sweep is not acceptable",
            seen=repr(span),
            allowed="(low, high) in units of the value, 0 <= low < high",
            cure="leave span out for (0, 2.5)",
        )
    return low, high


def _start(start: Any) -> tuple[Mapping[str, float], str]:
    if isinstance(start, Mapping):
        return dict(start), "known"
    if start not in ("fitted", "held"):
        raise EstimationError(
            "the start of a sweep is not acceptable",
            seen=repr(start),
            allowed='"fitted", "held", or state -> value',
            cure="leave it out to estimate the initial states at every point",
        )
    return {}, start
