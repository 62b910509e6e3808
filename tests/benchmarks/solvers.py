"""Who takes part: module, function, interpreter, and how often."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Solver:
    """One row of the tables.

    module, function : what to call, fit(case, start, mark); peers : runs in the peers' environment
    starts : at most so many starts, for the slow ones; packages : whose versions are noted
    cases : which problems it takes part in, () for all
    """

    title: str
    module: str
    function: str = "fit"
    peers: bool = False
    starts: int = 20
    packages: tuple[str, ...] = ()
    cases: tuple[str, ...] = ()


SOLVERS = {
    "ours": Solver("casadi-engine", "ours", packages=("casadi-engine", "casadi", "numpy")),
    "scipy": Solver(
        "SciPy least_squares, frequency domain, projected", "opponent_spectral", packages=("scipy", "numpy")
    ),
    "scipy-A": Solver(
        "SciPy least_squares, the same written for two masses",
        "opponent_two_mass_entry",
        "compressed",
        packages=("scipy",),
        cases=("A",),
    ),
    "lfilter": Solver(
        "SciPy least_squares, lfilter",
        "opponent_two_mass_entry",
        "filters",
        packages=("scipy",),
        cases=("A",),
    ),
    "lmfit": Solver(
        "lmfit on the frequency-domain residual", "opponent_lmfit", peers=True, packages=("lmfit", "scipy")
    ),
    "jax-sysid": Solver(
        "jax-sysid, L-BFGS-B", "opponent_jax_sysid", peers=True, starts=2, packages=("jax-sysid", "jax")
    ),
    "casadi": Solver(
        "CasADi multiple shooting, Gauss-Newton", "opponent_casadi", starts=2, packages=("casadi",)
    ),
    "casadi-exact": Solver(
        "CasADi multiple shooting, exact Hessian", "opponent_casadi", "exact", starts=2, packages=("casadi",)
    ),
}
