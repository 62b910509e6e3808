"""The linear core of a model: its constant matrices, found by differentiation and never written twice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca

from casadi_engine.model.linearity import is_affine

if TYPE_CHECKING:
    from casadi_engine.model.model import Model


@dataclass(frozen=True, eq=False)
class LinearCore:
    """Matrices of ẋ = A x + B d + G w + e, y = C x + D d + H w + c as SX functions of the parameters p alone.

    A : (n, n)    B : (n, m) drives d    G : (n, nw) slot torques w    e : (n, 1)
    C : (ny, n)   D : (ny, m)            H : (ny, nw), zero but for delayed sensors            c : (ny, 1)
    Drives that enter alike have equal columns; merging them is the simulator's business.
    """

    A: Any
    B: Any
    G: Any
    e: Any
    C: Any
    D: Any
    c: Any
    H: Any

    @property
    def matrices(self) -> tuple[Any, ...]:
        """A, B, G, e, C, D, c."""
        return (self.A, self.B, self.G, self.e, self.C, self.D, self.c)


def linear_core(model: Model) -> LinearCore | None:
    """Extract the linear core, or return None if the model is general.

    A model has one if its ode and its outputs are affine in (x, d, w) jointly, with coefficients
    that depend on parameters alone (no channel, no time), and none of it jumps in (x, d, w).
    """
    core, outer = ca.vertcat(model.x, model.d, model.w), ca.vertcat(model.u, model.t)
    both = ca.vertcat(model.ode, model.output_expressions)
    if not is_affine(both, core, outer):
        return None
    zero = [ca.SX.zeros(s.numel(), 1) for s in (model.x, model.d, model.w)]
    e, c = ca.substitute([model.ode, model.output_expressions], [model.x, model.d, model.w], zero)
    return LinearCore(
        A=ca.jacobian(model.ode, model.x),
        B=ca.jacobian(model.ode, model.d),
        G=ca.jacobian(model.ode, model.w),
        e=e,
        C=ca.jacobian(model.output_expressions, model.x),
        D=ca.jacobian(model.output_expressions, model.d),
        c=c,
        H=ca.jacobian(model.output_expressions, model.w),
    )
