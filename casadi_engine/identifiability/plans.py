"""plan: an engine experiment that could be made, from a record of the same engine.

The pressures of the record are taken as functions of the crank angle, cycle by cycle, and parted into the motored
trace (the compression side mirrored at TDC) and what combustion adds. At another speed or load the motored part
stays, and the combustion is scaled so that the torque balances load, friction and acceleration.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ExperimentError
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.channel import sampling_rate
from casadi_engine.experiment.units import NOT_STATED, read_unit
from casadi_engine.identifiability.operating import PlannedExperiment
from casadi_engine.model import Model
from casadi_engine.model.arrival import arriving
from casadi_engine.parameters import Parameters

Array = NDArray[np.float64]

_CYCLE = 4 * math.pi
# Combustion is what lies above the mirrored compression from TDC to here, where the exhaust opens.
_EXHAUST_OPENS = math.radians(140.0)
_FADE = math.radians(25.0)
_ANGLES = 2880  # of the table of a cycle, every quarter of a degree


@dataclass(frozen=True)
class _Cylinder:
    """One cylinder's pressure: motored (cycles, A) and combustion (cycles, A) [Pa] over its own angle from -2 pi."""

    channel: str
    offset: float
    motored: Array
    combustion: Array

    def at(self, theta: Array, strength: Array) -> Array:
        """(N,) pressure at crank angles theta, with a strength (N,) of combustion."""
        own = theta - self.offset + _CYCLE / 2
        cycle = np.floor(own / _CYCLE).astype(int)
        place = (own / _CYCLE - cycle) * _ANGLES
        low = np.minimum(place.astype(int), _ANGLES - 1)
        share, row = place - low, cycle % len(self.motored)

        def table(values: Array) -> Array:
            return values[row, low] * (1 - share) + values[row, low + 1] * share

        found: Array = table(self.motored) + strength * table(self.combustion)
        return found

    def number(self, theta: Array) -> NDArray[np.intp]:
        """(N,) of the combustion that the angle belongs to, 1 for the first with its TDC at theta >= 0."""
        return np.floor((theta - self.offset) / _CYCLE + 0.5).astype(np.intp) + 1


def plan(
    model: Model,
    record: Experiment,
    *,
    parameters: Parameters | None = None,
    speed: float | None = None,
    load: float | None = None,
    misfire: Mapping[int, str | Sequence[int]] | None = None,
    load_step: tuple[float, float] | None = None,
    run_up: tuple[float, float] | None = None,
    duration: float | None = None,
    outputs: Sequence[str] | None = None,
    label: str = "",
) -> PlannedExperiment:
    """Plan an experiment on the engine of a record: another speed, load, misfire, a load step or a run-up.

    model : with channels theta, p1..., T_load (and omega for the linear form) and a linear core
    record : of the same engine, two whole cycles or more, whose pressures and cylinder differences are taken over
    parameters : the set (default: the model's), for the balance of torques
    speed : mean crank speed [rad/s] (default: the record's); run_up : (first, last) speed instead, changed evenly
    load : braking torque [N m] (default: the record's mean); load_step : (time [s], change of load [N m])
    misfire : {cylinder: "all" or the numbers of the cycles without combustion}; the other cylinders burn more for
        "all" so that the speed holds, and do not for single cycles
    duration : s (default: the record's). outputs : names of what would be measured (default: all of the model's)
    label : what to call it

    Returns a PlannedExperiment whose start is the motion that repeats in its first cycle.
    Raises ExperimentError for a model without these channels, or options that do not go together.
    """
    _check_kinds(model, record, parameters, {"speed": speed, "load": load, "duration": duration})
    engine = _Engine(model, arriving(model, record), parameters)
    if run_up is None:
        first = last = engine.speed if speed is None else float(speed)
    else:
        first, last = _pair("the run-up", run_up, "(first, last) speed in rad/s")
    if load_step is not None:
        load_step = _pair("the load step", load_step, "(time [s], change [N m])")
    _check(engine, speed, run_up, duration, misfire, first, last)
    length = record.duration if duration is None else duration
    time = np.arange(round(length * engine.rate) + 1) / engine.rate
    if load_step is not None and not 0 <= load_step[0] <= time[-1]:
        raise _refused(
            "the load step is not within the plan",
            f"{load_step[0]:g} s",
            f"give a time of 0 to {time[-1]:g} s, or a longer duration",
        )
    omega = first + (last - first) * time / time[-1]
    theta = first * time + 0.5 * (last - first) / time[-1] * time**2
    braking = np.full(len(time), engine.load if load is None else float(load))
    wanted = engine.wanted(omega, (last - first) / time[-1], braking)
    if load_step is not None:
        braking = braking + np.where(time >= load_step[0], load_step[1], 0.0)
    _check_cycles(engine, theta, misfire or {})
    pressures = engine.pressures(theta, wanted, misfire or {})
    channels = {"theta": theta, **pressures, "T_load": braking, "omega": omega}
    units = {"theta": "rad", "T_load": "N m", "omega": "rad/s"} | dict.fromkeys(pressures, "Pa")
    names = [variable.name for variable in model.inputs]
    experiment = Experiment.from_arrays(
        label or _words(record.name, speed, run_up, load, load_step, misfire),
        time=time,
        units={name: units[name] for name in names},
        origin="derived",
        inputs=names,
        **{name: channels[name] for name in names},
    )
    chosen = _chosen(model, outputs)
    # The linear form takes the speed as an input; that column must not count as measured.
    return PlannedExperiment(experiment, label, chosen)


def _words(record: str, *given: Any) -> str:
    names = ("speed", "run_up", "load", "load_step", "misfire")
    parts = [f"{name} {value}" for name, value in zip(names, given, strict=True) if value is not None]
    text = f"{record}: {', '.join(parts)}" if parts else f"{record} again"
    return text.replace("[", "(").replace("]", ")").replace('"', "'").replace(",", ";")


class _Engine:
    """What a record and a model tell of an engine."""

    def __init__(self, model: Model, record: Experiment, parameters: Parameters | None) -> None:
        _needs(model, record)
        self.model = model
        self.p = model.parameter_vector(parameters)
        theta = record["theta"]
        rate = sampling_rate(theta.time, 1e-2)
        if rate is None:
            raise _refused("the record's crank angle is not sampled evenly", "uneven times", "resample it")
        self.rate = rate
        self.speed = float((theta.values[-1] - theta.values[0]) / (theta.time[-1] - theta.time[0]))
        self.load = float(record["T_load"].values.mean())
        self.cylinders = [self._cylinder(k, record) for k in self._numbers()]
        self._balance()

    def _numbers(self) -> range:
        return range(1, 1 + sum(name.startswith("p") for name in (v.name for v in self.model.inputs)))

    def _cylinder(self, number: int, record: Experiment) -> _Cylinder:
        model = self.model
        angle = model.ports[f"cylinder_{number}"].signals["angle"]
        at = ca.Function("angle", [model.x, model.u, model.d, model.t, model.p], [angle])
        zero = [0.0 * part.numel() for part in (model.x, model.u, model.d)]
        offset = -float(at(*zero, 0.0, self.p))
        theta, pressure = record["theta"], record[f"p{number}"]
        crank = np.interp(pressure.time, theta.time, theta.values) - offset + _CYCLE / 2
        first, last = math.ceil(crank[0] / _CYCLE - 1e-3), math.floor(crank[-1] / _CYCLE + 1e-3)
        if last <= first:
            raise _refused(
                f"the record holds no whole cycle of cylinder {number}",
                f"{(crank[-1] - crank[0]) / _CYCLE:.2f} cycles",
                "take a record of two cycles or more",
            )
        grid = _CYCLE * (np.arange(first, last)[:, None] + np.arange(_ANGLES + 1)[None, :] / _ANGLES)
        whole = np.interp(grid, crank, pressure.values)
        own = np.linspace(-_CYCLE / 2, _CYCLE / 2, _ANGLES + 1)
        mirrored = whole[:, ::-1]  # the angle -theta*
        above = np.clip((_EXHAUST_OPENS + _FADE - own) / _FADE, 0.0, 1.0) * (own >= 0)
        combustion = above * np.maximum(whole - mirrored, 0.0)
        return _Cylinder(f"p{number}", offset, whole - combustion, combustion)

    def _balance(self) -> None:
        """The slow motion of the whole shaft: d(speed)/dt = decay*speed + sum(gain*drive), by the left eigenvector."""
        core = self.model.linear
        if core is None:
            raise _refused(
                "the model has no linear core", self.model.name, "make the planned channels yourself"
            )
        matrices = ca.Function("core", [self.model.p], [ca.densify(core.A), ca.densify(core.B)])(self.p)
        a, b = (np.asarray(part, dtype=float) for part in matrices)
        values, vectors = np.linalg.eig(a.T)
        slow = int(np.argmin(np.abs(values)))
        left = vectors[:, slow].real
        turning = np.array([state.unit == "rad/s" for state in self.model.states], dtype=float)
        left = left / (left @ turning)
        self.decay, self.gain = float(values[slow].real), left @ b

    def _mean_torque(self, theta: Array, omega: float, strengths: Array) -> float:
        """Mean over a cycle of sum(gain*drive), without the load; strengths : (cylinders,) of combustion."""
        model = self.model
        channels = {"theta": theta, "omega": np.full(len(theta), omega), "T_load": np.zeros(len(theta))}
        for cylinder, strength in zip(self.cylinders, strengths, strict=True):
            one = np.array([cylinder.motored.mean(axis=0), cylinder.combustion.mean(axis=0)])
            average = _Cylinder(cylinder.channel, cylinder.offset, one[:1], one[1:])
            channels[cylinder.channel] = average.at(theta, np.full(len(theta), strength))
        u = np.array([channels[variable.name] for variable in model.inputs])
        function = ca.Function("drives", [model.u, model.t, model.p], [model.drive_expressions])
        drives = np.asarray(function(u, np.zeros((1, len(theta))), np.tile(self.p[:, None], len(theta))))
        return float(self.gain @ drives.mean(axis=1))

    def wanted(self, omega: Array, acceleration: float, braking: Array) -> Array:
        """(N,) share of the load's side of the balance: what the engine must give, as gain*torque."""
        names = [variable.name for variable in self.model.drives]
        load = self.gain[names.index("T_load")] * braking if "T_load" in names else 0.0
        found: Array = acceleration - self.decay * omega - load
        return found

    def pressures(
        self, theta: Array, wanted: Array, misfire: Mapping[int, str | Sequence[int]]
    ) -> dict[str, Array]:
        """Pressures (N,) by channel that give the wanted torque on average over each cycle."""
        burns = np.array([0.0 if misfire.get(k) == "all" else 1.0 for k in self._numbers()])
        angles = np.linspace(0.0, _CYCLE, 1441)[:-1]
        still = self._mean_torque(angles, self.speed, 0 * burns)
        unit = self._mean_torque(angles, self.speed, burns) - still
        if not unit > 0:
            raise _refused(
                "no cylinder is left that burns", f"misfire={dict(misfire)}", "leave one cylinder burning"
            )
        strength = np.maximum((wanted - still) / unit, 0.0)
        found = {}
        for number, cylinder in zip(self._numbers(), self.cylinders, strict=True):
            own = strength * burns[number - 1]
            silent = misfire.get(number, ())
            if not isinstance(silent, str):
                own = np.where(np.isin(cylinder.number(theta), list(silent)), 0.0, own)
            found[cylinder.channel] = cylinder.at(theta, own)
        return found


def _needs(model: Model, record: Experiment) -> None:
    names = [variable.name for variable in model.inputs]
    known = ("theta", "omega", "T_load")
    strange = [n for n in names if n not in known and not (n[:1] == "p" and n[1:].isdigit())]
    if strange or "theta" not in names or "T_load" not in names:
        raise _refused(
            f"the model {model.name} is not driven by crank angle, pressures and a load",
            ", ".join(names) or "no channels",
            "make the planned channels yourself: PlannedExperiment(Experiment.from_arrays(...))",
        )
    for variable in model.inputs:
        if variable.unit != NOT_STATED and not read_unit(variable.unit).is_si:
            raise _refused(
                f"the model {model.name} declares a channel in another unit than SI, and plans are made in SI",
                f"{variable.name} in {variable.unit}",
                "make the planned channels yourself: PlannedExperiment(Experiment.from_arrays(...))",
            )
    for name in names:
        if name != "omega":
            _ = record[name]


def _check_kinds(model: Any, record: Any, parameters: Any, numbers: Mapping[str, Any]) -> None:
    for what, value, kind in (("model", model, Model), ("record", record, Experiment)):
        if not isinstance(value, kind):
            raise _refused(
                f"the {what} of a plan is not acceptable",
                repr(value),
                f"give plan(model, record): a {kind.__name__}",
            )
    if parameters is not None and not isinstance(parameters, Parameters):
        raise _refused(
            "the parameters are not a parameter set",
            type(parameters).__name__,
            "start from model.parameters()",
        )
    for name, value in numbers.items():
        if value is not None and not _is_number(value):
            raise _refused(
                f"the {name} of a plan is not a number", repr(value), f"give {name}=100.0, or leave it out"
            )


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and not math.isnan(value)


def _pair(what: str, given: Any, wanted: str) -> tuple[float, float]:
    values = tuple(given) if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str) else ()
    if len(values) != 2 or not all(_is_number(value) and math.isfinite(value) for value in values):
        raise _refused(f"{what} is not acceptable", repr(given), f"give {wanted}")
    return float(values[0]), float(values[1])


def _chosen(model: Model, outputs: Any) -> tuple[str, ...]:
    known = tuple(variable.name for variable in model.outputs)
    if outputs is None:
        return known
    names = tuple(outputs) if isinstance(outputs, Collection) and not isinstance(outputs, str) else ()
    if not names or not set(map(repr, names)) <= set(map(repr, known)):
        raise _refused(
            "the outputs of a plan are not acceptable",
            repr(outputs),
            f"give one or more of {', '.join(known)}, such as outputs={known[:1]!r}",
        )
    return names


def _check(
    engine: _Engine, speed: Any, run_up: Any, duration: Any, misfire: Any, first: float, last: float
) -> None:
    if speed is not None and run_up is not None:
        raise _refused("a plan has either a speed or a run-up", "both", "leave one of them out")
    if not (0 < first < math.inf and 0 < last < math.inf):
        raise _refused(
            "a crank speed is not acceptable", f"{first} to {last} rad/s", "give speeds > 0 in rad/s"
        )
    if duration is not None and not 2 * _CYCLE / min(first, last) < duration < math.inf:
        raise _refused("the duration is not acceptable", f"{duration} s", "give two engine cycles or more")
    numbers = engine._numbers()
    wanted = f'give cylinders 1 to {len(numbers)} with "all" or the numbers of cycles'
    if misfire is not None and not isinstance(misfire, Mapping):
        raise _refused("the misfire is not acceptable", repr(misfire), wanted)
    for cylinder, which in (misfire or {}).items():
        cycles = [] if isinstance(which, str) or not isinstance(which, Collection) else list(which)
        whole = bool(cycles) and all(_is_number(one) and one == int(one) for one in cycles)
        if cylinder not in numbers or not (which == "all" if isinstance(which, str) else whole):
            raise _refused("the misfire is not acceptable", f"{cylinder!r}: {which!r}", wanted)


def _check_cycles(engine: _Engine, theta: Array, misfire: Mapping[int, str | Sequence[int]]) -> None:
    """A cycle that the plan does not hold would leave the engine as it is, in silence."""
    for number, silent in misfire.items():
        there = engine.cylinders[number - 1].number(theta)
        if not isinstance(silent, str) and not set(silent) <= set(there.tolist()):
            raise _refused(
                "the misfire is of a cycle that the plan does not hold",
                f"{number}: {list(silent)}",
                f"give cycles {there.min()} to {there.max()} of cylinder {number}, or a longer duration",
            )


def _refused(problem: str, seen: str, cure: str) -> ExperimentError:
    return ExperimentError(problem, seen=seen, allowed="a plan of an engine on a load", cure=cure)
