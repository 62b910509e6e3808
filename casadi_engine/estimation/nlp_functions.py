"""The multiple-shooting problem and its derivatives as nlpsol asks for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import TimeUp
from casadi_engine.errors import ModelError
from casadi_engine.estimation.shooting import ShootingProblem

Array = NDArray[np.float64]

# Longest step of a logarithm, or of a scaled parameter in units of its size where that is larger: beyond it the
# linearised problem says nothing.
_LONGEST = 2.0
# Points at which the model cannot be evaluated that are tried from one start by IPOPT, and their share of all: with
# more of both the search stands before a wall, and every further halving of its steps meets it again.
_REFUSED, _MOSTLY = 30, 0.5


class Supplied(ca.Callback):
    """A function with the names and sparsities that nlpsol asks for."""

    def __init__(
        self, name: str, inputs: dict[str, Any], outputs: dict[str, Any], run: Callable[..., Any]
    ) -> None:
        ca.Callback.__init__(self)
        self._in, self._out, self._run = inputs, outputs, run
        self.failure: BaseException | None = None
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._in)

    def get_n_out(self) -> int:
        return len(self._out)

    def get_name_in(self, i: int) -> str:
        return list(self._in)[i]

    def get_name_out(self, i: int) -> str:
        return list(self._out)[i]

    def get_sparsity_in(self, i: int) -> Any:
        return list(self._in.values())[i]

    def get_sparsity_out(self, i: int) -> Any:
        return list(self._out.values())[i]

    def eval(self, arguments: Any) -> Any:
        """Run the function; what goes wrong in it is kept, for the solver would pass over it."""
        try:
            return self._run(*arguments)
        except BaseException as failure:
            self.failure = failure
            if self.name() == "watch":
                return [1.0]
            raise


def shapes(problem: ShootingProblem) -> tuple[Any, ...]:
    """Sparsities of the variables, the constraints, nothing and one number."""
    return tuple(ca.Sparsity.dense(k, 1) for k in (problem.size, problem.rows, 0, 1))


@dataclass
class Tried:
    """The points IPOPT tries from one start, and those of them at which the model could not be evaluated.

    last : (size,) the last one it accepted; late : the time was up within one
    """

    last: Array
    points: int = 0
    refused: int = 0
    late: bool = False

    @property
    def ends(self) -> bool:
        """True if the run is to end."""
        return self.late or self.wall

    @property
    def wall(self) -> bool:
        """True if the model cannot be evaluated at most points."""
        return self.refused > _REFUSED and self.refused > _MOSTLY * self.points


def functions(problem: ShootingProblem, tried: Tried, log: NDArray[np.bool_]) -> list[Supplied]:
    """The problem, its gradient, constraint Jacobian and Hessian, as nlpsol asks for them."""
    x, g, none, one = shapes(problem)
    jac, hess = problem.jacobian_pattern, problem.hessian_pattern
    at = {"x": x, "p": none}

    nothing = np.full(problem.rows, np.nan)

    def point(value: Any) -> Any:
        """The point, or None where the model cannot be evaluated: IPOPT then shortens its step."""
        if tried.ends:
            return None
        x = np.asarray(value, dtype=float).ravel()
        tried.points += 1
        try:
            return problem.at(x)
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            tried.refused += 1
            return None
        except TimeUp:
            tried.late = True
            return None

    def jacobian(value: Any, _: Any) -> Any:
        found = point(value)
        if found is None:
            return [nothing, ca.DM(jac.sparsity, np.nan)]
        tried.last = found.x  # slopes are asked for where a step has been accepted, of a restoration too
        return [found.constraints, jac.matrix(problem.jacobian(found.x))]

    def gradient(value: Any, _: Any) -> Any:
        found = point(value)
        if found is None:
            return [np.nan, np.full(problem.size, np.nan)]
        tried.last = found.x  # asked for alone where there are no constraints
        return [found.objective, found.gradient]

    def hessian(value: Any, _: Any, factor: Any, lam: Any) -> Any:
        found = point(value)
        if found is None:
            return [ca.DM(hess.sparsity, np.nan)]
        try:
            values = problem.hessian(found.x, float(factor), np.asarray(lam, dtype=float).ravel())
        except TimeUp:
            tried.late = True
            return [ca.DM(hess.sparsity, np.nan)]
        return [hess.matrix(values)]

    def both(value: Any, _: Any) -> Any:
        last = tried.last[: problem.nv]
        away = np.abs(np.asarray(value, dtype=float).ravel()[: problem.nv] - last)
        reach = _LONGEST * np.where(log, 1.0, np.maximum(1.0, np.abs(last)))
        found = point(value) if (away <= reach).all() else None
        return [np.nan, nothing] if found is None else [found.objective, found.constraints]

    multipliers = {"lam_f": one, "lam_g": g}
    return [
        Supplied("nlp", at, {"f": one, "g": g}, both),
        Supplied("nlp_grad_f", at, {"f": one, "grad_f_x": x}, gradient),
        Supplied("nlp_jac_g", at, {"g": g, "jac_g_x": jac.sparsity}, jacobian),
        Supplied("nlp_hess_l", {**at, **multipliers}, {"hess_gamma_x_x": hess.sparsity}, hessian),
    ]
