"""The Jacobian of problem B against its floating-point limit, and the price of a nonlinear law; a Markdown table.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/jacobian_limit.py

Problem B: the crankshaft in its linear form (13 states, 5 drives), six tied parameters, one normal record of 14 400
samples in 100 intervals of 144. The limit is the time that the floating-point operations of the Jacobian's matrix
products take at the rate this machine reaches on one large square product: once for the operations of the plain
recursion, sample by sample, and once for those of the blocks that the package works with, which are fewer. Then the
same model with Coulomb friction in its last coupling, tanh(rate/0.1 rad/s), and its torque as a seventh parameter.
CPU seconds, the median of the runs, on one thread.
"""

from __future__ import annotations

import datetime
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import casadi_engine as ce
from casadi_engine.model import Model, thesis_ties
from casadi_engine.model.declarations import ParameterDeclaration
from casadi_engine.parameters.compiled import compile as compile_parameters
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.intervals import Intervals, cut
from casadi_engine.simulation.propagator import make_propagator

RECORD = Path(__file__).parents[2] / "data" / "crankshaft" / "normal_1200rpm.csv.gz"
LENGTH = 144
WIDTH = 0.1  # rad/s
RUNS = 15


def median_time(work: Callable[[], Any], runs: int = RUNS) -> float:
    """Median CPU time [s] after a warm-up."""
    work()
    times = []
    for _ in range(runs):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.median(times))


def product_rate(size: int = 800) -> float:
    """Floating-point operations a second of one square matrix product."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, size, size))
    out = np.empty((size, size))
    return 2 * size**3 / median_time(lambda: np.matmul(a, b, out=out), 5)


def plain_flops(n: int, nz: int, ny: int, m: int, samples: int) -> int:
    """Operations of x+ = F x + G0 v0 + G1 v1, y = C x, and their derivatives by z, sample by sample."""
    state = (1 + 2 * nz) * n * n + (1 + nz) * n * 2 * m
    return 2 * samples * (state + (1 + nz) * ny * n)


def block_flops(n: int, nz: int, ny: int, m: int, plan: Intervals) -> int:
    """Operations of the products with block matrices, and of making these; see ``simulation.blocks``."""
    rows, drives, blocks = n + len(plan.samples) * ny, (plan.q + 1) * m, plan.b * plan.m
    forced = (1 + nz) * rows * drives * blocks
    states = (1 + 2 * nz) * n * n * blocks + n * n * n * plan.b
    outputs = (1 + 2 * nz) * (rows - n) * n * blocks
    chain = (1 + 2 * nz) * n * n * (plan.q + 1) * (n + 2 * m)
    return 2 * (forced + states + outputs + chain)


def with_coulomb(model: Model) -> Model:
    """The model with smooth Coulomb friction in the coupling to the dynamometer, its torque ``T_c`` [N m] free."""
    port, torque = model.ports["coupling_76"], ca.SX.sym("T_c")
    row = [other.name for other in model.ports.with_slot].index(port.name)
    laws = ca.densify(model.laws)
    laws[row] = laws[row] + torque * ca.tanh(port.signals["twist_rate"] / WIDTH)
    declared = ParameterDeclaration("T_c", 1.0, "N m", 0.0, 100.0, True, "friction torque")
    return replace(
        model, laws=laws, p=ca.vertcat(model.p, torque), declarations=(*model.declarations, declared)
    )


def times(model: Model, record: ce.Experiment) -> dict[str, Any]:
    """Set-up, value, Jacobian, contraction and fit."""
    parameters = thesis_ties(model.parameters())
    compiled = compile_parameters(parameters, model.parameter_names)
    start = time.process_time()
    grid = lay_grid(model, record)
    plan, scale = cut(grid, LENGTH), np.array([state.scale for state in model.states])
    propagator = make_propagator(model, grid, plan, compiled.z, compiled.physical[""], scale=scale)
    setup = time.process_time() - start
    z = compiled.start
    nodes = np.tile([1.26 if s.name.startswith("omega") else 0.0 for s in model.states], (plan.m, 1))
    path = propagator.propagate(z, nodes, 1)
    rng = np.random.default_rng(0)
    rho, lam = rng.normal(size=path.y[0].shape), rng.normal(size=nodes.T.shape)

    def second() -> None:
        propagator.contraction(z, propagator.propagate(z, nodes, 1), rho, lam)

    first = median_time(lambda: propagator.propagate(z, nodes, 1))
    off = thesis_ties(model.parameters())
    for index, name in enumerate(n for n in off if off[n].vary and not off[n].tie):
        off[name].set(off[name].value * (0.9 if index % 2 == 0 else 1.1))
    fits: list[Any] = []
    fit = median_time(
        lambda: fits.append(
            ce.estimate(model, record, parameters=off, noise=ce.Noise(omega=0.1), progress=False)
        ),
        3,
    )
    return {
        "setup": setup,
        "value": median_time(lambda: propagator.propagate(z, nodes, 0)),
        "jacobian": first,
        "hessian": median_time(second) - first,
        "fit": fit,
        "iterations": fits[-1].iterations,
        "counts": (len(scale), len(z), len(model.outputs), len(model.drives), plan, grid.samples),
    }


def main() -> None:
    """Print the tables."""
    record = ce.read_experiment(RECORD)
    model = ce.crankshaft(reciprocating_speed="measured")
    rate, plain, bent = product_rate(), times(model, record), times(with_coulomb(model), record)
    *sizes, plan, samples = plain["counts"]
    print(f"{datetime.date.today()}, {platform.machine()}; square products at {rate / 1e9:.1f} Gflop/s\n")
    print("| Jacobian of B | Mflop | limit | measured | ratio |\n|---|---|---|---|---|")
    for name, flops in (
        ("sample by sample", plain_flops(*sizes, samples)),
        (f"in blocks of {plan.q}", block_flops(*sizes, plan)),
    ):
        limit = flops / rate
        ratio = plain["jacobian"] / limit
        print(
            f"| {name} | {flops / 1e6:.0f} | {limit * 1e3:.2f} ms | {plain['jacobian'] * 1e3:.2f} ms | {ratio:.1f} |"
        )
    print(
        "\n| ms | set-up | outputs | Jacobian | and Hessian | fit | iterations |\n|---|---|---|---|---|---|---|"
    )
    for name, found in (("B", plain), ("B with Coulomb friction", bent)):
        row = [f"{found[key] * 1e3:.1f}" for key in ("setup", "value", "jacobian", "hessian", "fit")]
        print(f"| {name} | {' | '.join(row)} | {found['iterations']} |")
    ratios = [f"{bent[key] / plain[key]:.1f}" for key in ("setup", "value", "jacobian", "hessian", "fit")]
    print(f"| ratio | {' | '.join(ratios)} | |")


if __name__ == "__main__":
    main()
