"""What an effect's law sees of its port: signals, time, typical magnitudes and states of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EffectError
from casadi_engine.model.declarations import Port
from casadi_engine.parameters import near_matches

# An SX scalar -> its values (N,) along every record.
Courses = Callable[[Any], Sequence[NDArray[np.float64]]]

if TYPE_CHECKING:
    from casadi_engine.model.model import Model


class PortView:
    """A port as a law reads it; every signal is an attribute (``port.speed``).

    name, kind : of the port        time : SX symbol [s]
    courses : what gives the values (N,) of an SX scalar along the model's simulation of each record, if there is one
    """

    def __init__(self, model: Model, port: Port, courses: Courses | None = None):
        self.name, self.kind, self.time = port.name, port.kind, model.t
        self._model, self._port, self._courses = model, port, courses
        self.states: dict[str, Any] = {}

    def has(self, signal: str) -> bool:
        """True if the port has a signal of that name."""
        return signal in self._port.signals

    def __getattr__(self, signal: str) -> Any:
        if signal.startswith("__"):
            raise AttributeError(signal)
        if signal not in self._port.signals:
            raise EffectError(
                f"the port {self.name} has no such signal",
                seen=repr(signal),
                allowed=near_matches(signal, self._port.signals),
                cure="print(model.ports) lists the signals; an effect names those it needs in `needs`",
            )
        return self._port.signals[signal]

    def state(self, name: str) -> Any:
        """The SX symbol of a state of the effect's own; its start and rate go into `Law(states=...)`."""
        if name not in self.states:
            self.states[name] = ca.SX.sym(f"{self.name}.{name}")
        return self.states[name]

    def number(self, signal: str, values: Mapping[str, float]) -> float:
        """The number of a signal that is made of parameters alone, at these values by name."""
        expression = getattr(self, signal)
        symbols = ca.symvar(expression)
        function = ca.Function("number", [ca.vertcat(*symbols)], [expression])
        return float(function([values[symbol.name()] for symbol in symbols]))

    def courses(self, signal: str) -> tuple[NDArray[np.float64], ...]:
        """The signal along the simulation of each record, (N,) at its samples; empty where nothing was simulated."""
        return () if self._courses is None else tuple(self._courses(getattr(self, signal)))

    def typical(self, signal: str) -> float:
        """Typical magnitude of a signal, from the scales of the states or channels that it is made of.

        A signal that is not affine in them counts 1.
        """
        expression, model = getattr(self, signal), self._model
        for column, variables in ((model.x, model.states), (model.channels, model.inputs)):
            slope = ca.jacobian(expression, column)
            if slope.nnz() and not ca.symvar(slope):
                scales = np.array([variable.scale for variable in variables])
                found = float(np.linalg.norm(np.array(ca.DM(ca.densify(slope))).ravel() * scales))
                return found if found > 0 else 1.0
        return 1.0


def port_view(model: Model, at: str) -> PortView:
    """The port of that name as a law sees it; ModelError if the model has none."""
    return PortView(model, model.ports[at])


class Values:
    """The amplitude and nuisance parameters of an effect as attributes, SX symbols or numbers."""

    def __init__(self, effect: str, values: dict[str, Any]):
        self._effect, self._values = effect, values

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self._values:
            raise EffectError(
                f"the effect {self._effect} has no such parameter",
                seen=repr(name),
                allowed=near_matches(name, self._values),
                cure="declare it as the amplitude or in nuisance",
            )
        return self._values[name]
