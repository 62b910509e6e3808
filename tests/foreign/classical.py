"""The classical test problems: 25 non-stiff ones (DETEST) and six stiff ones, each once, as plain data.

Oracles: for the non-stiff ones SciPy's DOP853 at a relative 1e-13, run when asked for; for the stiff ones numbers in
classical_truth.json, which

    python tests/foreign/classical_truth.py

makes again with SciPy's Radau, and which end at the published reference values (Test Set for IVP Solvers).
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import classical_equations as equations
import classical_numpy as plain
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import casadi_engine as ce

Array = NDArray[np.float64]
TRUTH = Path(__file__).with_name("classical_truth.json")
LIMIT = 1e-5  # of each component's largest value along the run


@dataclass(frozen=True, eq=False)
class Classical:
    """One problem.

    symbolic, numeric : the right-hand side in CasADi and, written apart, in NumPy
    start : (n,) at the first time. time : (N,) where it is asked for. published : (n,) reference at the last time
    """

    name: str
    symbolic: Callable[[Any, list[Any]], list[Any]]
    numeric: Callable[[float, Array], Any]
    start: tuple[float, ...]
    time: Array
    published: tuple[float, ...] | None = None

    @property
    def stiff(self) -> bool:
        """True for those whose oracle is stored."""
        return self.published is not None

    def model(self) -> ce.Model:
        """As a user writes it from the README: no scales, no hints."""
        b = ce.Blueprint(self.name)
        states = [b.state(f"y{k + 1}") for k in range(len(self.start))]
        for k, rate in enumerate(self.symbolic(b.time, states)):
            b.ode(f"y{k + 1}", rate)
            b.output(f"out{k + 1}", states[k])
        return b.model()

    def record(self) -> ce.Experiment:
        """A record without inputs: it says by its outputs when to answer."""
        names = [f"out{k + 1}" for k in range(len(self.start))]
        channels = {name: np.zeros(len(self.time)) for name in names}
        return ce.Experiment.from_arrays(
            self.name, time=self.time, units=dict.fromkeys(names, "1"), **channels
        )

    def initial(self) -> dict[str, float]:
        """State -> value."""
        return {f"y{k + 1}": value for k, value in enumerate(self.start)}

    def truth(self, time: Array) -> Array:
        """(n, N) at the times: the stored numbers, or SciPy's."""
        if self.stiff and np.array_equal(time, self.time):
            return np.array(stored()[self.name])
        return self.solved(time)

    def solved(self, time: Array) -> Array:
        """(n, N) by SciPy: Radau for the stiff ones, else DOP853."""
        # Absolute tolerances a hundredth of a percent of the least component that matters.
        floor = SMALLEST.get(self.name, 1.0)
        answer = solve_ivp(
            self.numeric, (float(self.time[0]), float(max(time[-1], self.time[-1]))), self.start,
            method="Radau" if self.stiff else "DOP853", t_eval=time, rtol=1e-12 if self.stiff else 1e-13,
            atol=1e-13 * floor if self.stiff else 1e-15,
        )  # fmt: skip
        if not answer.success:
            raise RuntimeError(f"{self.name}: {answer.message}")
        return answer.y


# Largest value that the smallest component reaches along the run.
SMALLEST: dict[str, Any] = {
    "ROBER": np.array([1.0, 3.6e-5, 1.0]),
    "HIRES": np.array([1.0, 0.1, 0.01, 0.4, 0.1, 0.6, 6e-3, 6e-3]),
    "E5_pyrolysis": np.array([1.76e-3, 1e-10, 1e-11, 1e-10]),
    "POLLU": np.array(
        [5e-2, 0.2, 4e-9, 0.04, 2e-7, 1e-7, 0.1, 0.3, 1e-2, 1e-8, 1e-8, 2e-3, 2e-4, 1e-5, 9e-3, 4e-18, 7e-3, 1e-4,
         2e-6, 6e-5]
    ),
}  # fmt: skip


@functools.cache
def stored() -> dict[str, list[list[float]]]:
    """Problem -> (n, N) by Radau."""
    return json.loads(TRUTH.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def _linear(name: str) -> Callable[[float, Array], Array]:
    return lambda t, y: plain.LINEAR[name] @ y


def _orbit(number: int, eccentricity: float) -> Classical:
    start = (1 - eccentricity, 0.0, 0.0, math.sqrt((1 + eccentricity) / (1 - eccentricity)))
    return Classical(f"D{number}", equations.orbit, plain.kepler, start, TWENTY)


def _unit(n: int) -> tuple[float, ...]:
    return (1.0,) + (0.0,) * (n - 1)


TWENTY = np.linspace(0, 20, 41)
_PLANETS = (
    3.42947415189, 3.35386959711, 1.35494901715, 6.64145542550, 5.97156957878, 2.18231499728,
    11.2630437207, 14.6952576794, 6.27960525067, -30.1552268759, 1.65699966404, 1.43785752721,
    -21.1238353380, 28.4465098142, 15.3882659679,
    -0.557160570446, 0.505696783289, 0.230578543901, -0.415570776342, 0.365682722812, 0.169143213293,
    -0.325325669158, 0.189706021964, 0.087726532278, -0.024047625417, -0.287659532608, -0.117219543175,
    -0.176860753121, -0.216393453025, -0.014864789309,
)  # fmt: skip

NON_STIFF: tuple[Classical, ...] = (
    Classical("A1", equations.a1, lambda t, y: -y, (1.0,), TWENTY),
    Classical("A2", equations.a2, lambda t, y: -0.5 * y**3, (1.0,), TWENTY),
    Classical("A3", equations.a3, lambda t, y: math.cos(t) * y, (1.0,), TWENTY),
    Classical("A4", equations.a4, lambda t, y: 0.25 * y - 0.0125 * y * y, (1.0,), TWENTY),
    Classical("A5", equations.a5, lambda t, y: 1 - 2 * t / (y + t), (4.0,), TWENTY),
    Classical("B1", equations.b1, lambda t, y: y * np.array([2 - 2 * y[1], y[0] - 1]), (1.0, 3.0), TWENTY),
    Classical("B2", equations.b2, _linear("B2"), (2.0, 0.0, 1.0), TWENTY),
    Classical(
        "B3", equations.b3, lambda t, y: np.array([-y[0], y[0] - y[1] * y[1], y[1] * y[1]]), _unit(3), TWENTY
    ),
    Classical("B4", equations.b4, plain.moving_axes, (3.0, 0.0, 0.0), TWENTY),
    Classical(
        "B5", equations.b5, lambda t, y: np.array([1, -1, -0.51]) * y[[1, 0, 0]] * y[[2, 2, 1]], (0.0, 1.0, 1.0), TWENTY
    ),
    Classical("C1", equations.c1, _linear("C1"), _unit(10), TWENTY),
    Classical("C2", equations.c2, _linear("C2"), _unit(10), TWENTY),
    Classical("C3", equations.heat, _linear("C3"), _unit(10), TWENTY),
    Classical("C4", equations.heat, _linear("C4"), _unit(51), TWENTY),
    Classical("C5", equations.c5, plain.planets, _PLANETS, TWENTY),
    *(_orbit(k + 1, eccentricity) for k, eccentricity in enumerate((0.1, 0.3, 0.5, 0.7, 0.9))),
    Classical(
        "E1", equations.e1, lambda t, y: np.array([y[1], y[0] * (0.25 / (t + 1) ** 2 - 1) - y[1] / (t + 1)]),
        (0.6713967071418030, 0.09540051444747446), TWENTY,
    ),
    Classical("E2", equations.e2, lambda t, y: np.array([y[1], y[1] - y[0] ** 2 * y[1] - y[0]]), (2.0, 0.0), TWENTY),
    Classical(
        "E3", equations.e3, lambda t, y: np.array([y[1], y[0] ** 3 / 6 - y[0] + 2 * math.sin(2.78535 * t)]),
        (0.0, 0.0), TWENTY,
    ),
    Classical("E4", equations.e4, lambda t, y: np.array([y[1], 0.032 - 0.4 * y[1] * y[1]]), (30.0, 0.0), TWENTY),
    Classical(
        "E5", equations.e5, lambda t, y: np.array([y[1], math.hypot(1, y[1]) / (25 - t)]), (0.0, 0.0), TWENTY
    ),
)  # fmt: skip


def _decades(first: float, last: float, count: int) -> Array:
    return np.concatenate([[0.0], np.geomspace(first, last, count)])


STIFF: tuple[Classical, ...] = (
    Classical(
        "VDPOL", equations.vdpol, lambda t, y: np.array([y[1], 1e3 * (1 - y[0] ** 2) * y[1] - y[0]]), (2.0, 0.0),
        np.linspace(0, 2000, 41), (0.1706167732170469e1, -0.8928097010248125e-3),
    ),
    Classical(
        "ROBER", equations.rober, plain.rober, _unit(3), _decades(1e-5, 1e11, 33),
        (0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050),
    ),
    Classical(
        "OREGO", equations.orego, plain.orego, (1.0, 2.0, 3.0), np.linspace(0, 360, 41),
        (0.1000814870318523e1, 0.1228178521549917e4, 0.1320554942846706e3),
    ),
    Classical(
        "HIRES", equations.hires, plain.hires, (1.0, 0, 0, 0, 0, 0, 0, 0.0057), _decades(0.01, 321.8122, 40),
        (0.7371312573325668e-3, 0.1442485726316185e-3, 0.5888729740967575e-4, 0.1175651343283149e-2,
         0.2386356198831331e-2, 0.6238968252742796e-2, 0.2849998395185769e-2, 0.2850001604814231e-2),
    ),
    Classical(
        "E5_pyrolysis", equations.pyrolysis, plain.pyrolysis, (1.76e-3, 0.0, 0.0, 0.0), _decades(1e-5, 1e13, 37),
        (0.1152903278711829e-290, 0.8867655517642120e-22, 0.8854814626268838e-22, 0.0),
    ),
    Classical(
        "POLLU", equations.pollu, plain.pollu,
        (0, 0.2, 0, 0.04, 0, 0, 0.1, 0.3, 0.01, 0, 0, 0, 0, 0, 0, 0, 0.007, 0, 0, 0), np.linspace(0, 60, 31),
        (0.5646255480022769e-1, 0.1342484130422339, 0.4139734331099427e-8, 0.5523140207484359e-2,
         0.2018977262302196e-6, 0.1464541863493966e-6, 0.7784249118997964e-1, 0.3245075353396018,
         0.7494013383880406e-2, 0.1622293157301561e-7, 0.1135863833257075e-7, 0.2230505975721359e-2,
         0.2087162882798630e-3, 0.1396921016840158e-4, 0.8964884856898295e-2, 0.4352846369330103e-17,
         0.6899219696263405e-2, 0.1007803037365946e-3, 0.1772146513969984e-5, 0.5682943292316392e-4),
    ),
)  # fmt: skip

PROBLEMS = {problem.name: problem for problem in (*NON_STIFF, *STIFF)}


@dataclass(frozen=True)
class Answer:
    """What the package made of a problem: the largest error relative to each component's largest value, or why none."""

    error: float | None
    refused: str | None
    run: ce.Experiment | None


def simulated(problem: Classical) -> Answer:
    """Simulate the problem and hold it against the oracle at every time that was answered."""
    try:
        run = ce.simulate(problem.model(), problem.record(), initial=problem.initial())
    except ce.CasadiEngineError as error:
        return Answer(None, f"{type(error).__name__}: {error}", None)
    time = run["out1"].time
    found = np.array([run[f"out{k + 1}"].values for k in range(len(problem.start))])
    return Answer(relative_error(found, problem.truth(time)), None, run)


def relative_error(found: Array, truth: Array) -> float:
    """Largest difference (n, N), each component by its largest true value."""
    size = np.abs(truth).max(axis=1, keepdims=True)
    return float(np.max(np.abs(found - truth) / size))
