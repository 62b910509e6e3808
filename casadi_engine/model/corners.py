"""Equations that jump with their states, with corners of a finite width in place of the jumps.

What is scored along a simulation, an effect that may be missing, needs equations with slopes: ``sign(v)`` becomes
``tanh(v/width)``, ``v > 0`` one half of 1 + tanh(v/width). The widths are parameters of the model, held at a small
share of what is typical, until a fit makes them as small as the motion asks for (``estimation.corner_widths``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from casadi_engine.model.declarations import ParameterDeclaration
from casadi_engine.model.jumps import Held, jumps_in, with_held_jumps

if TYPE_CHECKING:
    from casadi_engine.model.model import Model

# What the names of the widths end in.
WIDTH = ".jump.width"
# Share of the signal's typical magnitude over which its corner is rounded, before a motion is known.
_WIDTH = 5e-3


@dataclass(frozen=True, eq=False)
class Corner:
    """A jump that was rounded: at signal = 0, over the width that the parameter of this name has, in its unit."""

    width: str
    signal: Any


def with_rounded_jumps(
    model: Model, largest: Mapping[str, float] | None = None, *, share: float = _WIDTH
) -> Model:
    """The model with corners in place of what jumps with its states; itself where nothing does.

    largest : state or input -> its largest magnitude, where that is known; else the scale of a state is taken
    share : of that magnitude over which a jump is rounded

    Jumps at instants in time, and at whole numbers (floor, remainder), stay as they are.

    >>> import casadi as ca
    >>> from casadi_engine import Blueprint
    >>> blueprint = Blueprint("slide")
    >>> v, force = blueprint.state("v", unit="m/s"), blueprint.parameter("force", 2.0, unit="N")
    >>> blueprint.ode("v", -force * ca.sign(v))
    >>> blueprint.output("v", v, unit="m/s")
    >>> rounded = with_rounded_jumps(blueprint.model())
    >>> rounded.ode, rounded.corners[0].width
    (SX((-(force*tanh((v/v.jump.width))))), 'v.jump.width')
    """
    moving = ca.vertcat(model.x, model.w)
    columns = (model.ode, model.laws, model.output_expressions)
    whole = ca.vertcat(*columns)
    if not jumps_in(whole, moving):
        return model
    made = _Rounding(model, with_held_jumps(whole, moving, products=True), largest or {}, share)
    sizes = np.cumsum([column.numel() for column in columns]).tolist()
    ode, laws, outputs = (made.expression[a:b] for a, b in zip([0, *sizes[:-1]], sizes, strict=True))
    return replace(
        model,
        declarations=(*model.declarations, *made.declarations),
        p=ca.vertcat(model.p, *made.widths),
        ode=ode,
        laws=laws,
        output_expressions=outputs,
        corners=(*model.corners, *made.corners),
    )


class _Rounding:
    """What stands for the jumps of one expression."""

    def __init__(self, model: Model, held: Held, largest: Mapping[str, float], share: float) -> None:
        self._model, self._share = model, share
        states = [largest.get(state.name, 0.0) or state.scale for state in model.states]
        channels = [largest.get(one.name, 0.0) for one in model.inputs]
        beside = model.u.numel() - len(channels)  # their rates, by which no width is told
        self._sizes = np.array([*states, *channels, *[0.0] * beside])
        self.widths: list[Any] = []
        self.declarations: list[ParameterDeclaration] = []
        self.corners: list[Corner] = []
        known: dict[int, Any] = {}  # switch -> what goes from -1 to 1 there
        symbols = ca.vertsplit(held.symbols) if held.symbols.numel() else []
        values: list[Any] = []
        for number, (low, high) in enumerate(held.sides):
            switch = held.switches[held.at[number]]
            # a condition may depend on those before it
            signal = ca.substitute([switch.g], symbols[:number], values)[0] if number else switch.g
            if switch.kind == "integer":
                values.append(held.values[number])
            else:
                if held.at[number] not in known:
                    known[held.at[number]] = self._corner(signal)
                values.append((high + low) / 2 + (high - low) / 2 * known[held.at[number]])
        self.expression = ca.substitute([held.expression], symbols, values)[0]

    def _corner(self, signal: Any) -> Any:
        """tanh(signal/width), with a parameter of its own."""
        model, states = self._model, ca.vertsplit(self._model.x)
        stem = str(signal) if signal.is_symbolic() else f"corner_{len(self.corners) + 1}"
        width = ca.SX.sym(f"{stem}{WIDTH}")
        known = ca.vertcat(model.w, *self.widths)
        numbers = [0.0] * model.w.numel() + [one.value for one in self.declarations]
        seen = ca.substitute(ca.substitute(signal, known, ca.DM(numbers)), model.d, model.drive_expressions)
        slopes = ca.jacobian(seen, ca.vertcat(model.x, model.u))
        inputs = [model.x, model.u, model.d, model.t, model.p]
        at = [1.0, 0.0, 0.0, 0.0, ca.DM([one.value for one in model.declarations])]
        size = np.abs(
            np.asarray(ca.Function("slopes", inputs, [ca.densify(slopes)])(*at), dtype=float)
        ).ravel()
        typical = float(size @ self._sizes)
        if not 0 < typical < np.inf:
            typical = 1.0
        unit = next((s.unit for s, x in zip(model.states, states, strict=True) if str(x) == stem), "1")
        value = float(f"{self._share * typical:.2g}")
        words = f"over which the jump at {signal} = 0 is rounded"
        self.declarations.append(
            ParameterDeclaration(width.name(), value, unit, min=0.0, vary=False, description=words)
        )
        self.widths.append(width)
        self.corners.append(Corner(width.name(), signal))
        return ca.tanh(signal / width)
