"""What nonlinear laws cost and how exact they are: one run, a dated table in NONLINEAR.md with `--write`.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/nonlinear_core.py [--starts 5] [--write]

1. The fit of B (six tied parameters, one normal record of 14 400 samples, starts within 20 %), and of B with smooth
   Coulomb friction, tanh(rate/0.1 rad/s), in the coupling to the dynamometer, its torque as a seventh parameter. The
   record of the second is simulated with the friction, noise carried into the reciprocating torque as in the first.
2. The exponential integrator against SciPy's DOP853 at a tolerance of 1e-12, and against a sharp law's closed form as
   the width of its smoothing goes to zero.
3. Sixty sensitivities of candidate laws along a record of 14 402 samples of two masses with two outputs.
4. The Jacobian of B against its floating-point limit (`jacobian_limit.py`).

CPU seconds on one thread, and the seconds that three million additions take in Python, to compare machines by.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import jacobian_limit as limit  # noqa: E402
import ours  # noqa: E402
from cases import case_b  # noqa: E402

import casadi_engine as ce  # noqa: E402
from casadi_engine.model import Model  # noqa: E402
from casadi_engine.simulation.candidate_sensitivities import grid_sensitivities, torque_direction  # noqa: E402
from casadi_engine.simulation.grid import Grid, lay_grid  # noqa: E402
from casadi_engine.simulation.intervals import cut  # noqa: E402
from casadi_engine.simulation.null_path import null_path  # noqa: E402
from casadi_engine.simulation.propagator import make_propagator  # noqa: E402

FRICTION = 6.0  # N m
STEP = 1 / 14402.0


def reading() -> float:
    """Seconds of three million additions in Python."""
    begun, total = time.process_time(), 0
    for number in range(3_000_000):
        total += number
    return time.process_time() - begun


# ---- 1. the price of a law


def record_with_friction(model: Model, case: Any, plain: ce.Experiment) -> ce.Experiment:
    """The record of B with friction: simulated again until its torque is made of its own measured speed."""
    truth = dict(zip(case.shape.names, case.truth.tolist(), strict=True)) | {"T_c": FRICTION}
    start = {
        s.name: float(plain["omega"].values[0]) if s.name.startswith("omega") else 0.0 for s in model.states
    }
    noise = case.sigma * np.random.default_rng(7).standard_normal(len(plain["omega"].time))
    data = plain
    for _ in range(12):
        run = ce.simulate(model, data, parameters=truth, initial=start)
        speed = run["omega"].values + noise
        change = float(np.abs(speed - data["omega"].values).max())
        data = data.with_channel(replace(plain["omega"], values=speed))
        if change < 1e-9:
            return data
    message = f"the measured speed does not settle: {change}"
    raise RuntimeError(message)


def fit_times(
    model: Model, data: ce.Experiment, case: Any, starts: int, **laws: float
) -> list[tuple[float, Any]]:
    """CPU time [s] and Fit from every start, after one that does not count."""
    found = []
    for number in [0, *range(starts)]:
        parameters = ours.parameters_of(case, model, {n: n for n in case.shape.names}, case.start(number))
        for name, value in laws.items():
            parameters[name].set(value)
        begun = time.process_time()
        fit = ce.estimate(
            model, data, parameters=parameters, noise=ce.Noise(omega=case.sigma), progress=False
        )
        found.append((time.process_time() - begun, fit))
    return found[1:]


def price(starts: int) -> list[str]:
    """The lines on B with and without friction."""
    case = case_b()
    (plain,), (model, _) = ours.experiments(case), ours.model_of(case)
    bent = limit.with_coulomb(model)
    data = record_with_friction(bent, case, plain)
    runs = {
        "B": fit_times(model, plain, case, starts),
        "B + friction": fit_times(bent, data, case, starts, T_c=1.0),
    }
    lines = ["| fit | CPU, median | slowest | iterations | χ²/N |", "|---|---|---|---|---|"]
    for name, found in runs.items():
        times, fits = [t for t, _ in found], [fit for _, fit in found]
        best = min(fit.cost / fit.n for fit in fits)
        lines.append(
            f"| {name} | {np.median(times):.2f} s | {max(times):.2f} s | {np.median([f.iterations for f in fits]):.0f} "
            f"| {best:.5f} |"
        )
    medians = [np.median([t for t, _ in found]) for found in runs.values()]
    iterations = [np.median([f.iterations for _, f in found]) for found in runs.values()]
    ratio = medians[1] / medians[0]
    each = ratio * iterations[0] / iterations[1]
    last = min((fit for _, fit in runs["B + friction"]), key=lambda fit: fit.cost)
    torque = last.estimates["T_c"]
    (steps,) = last.integration.values()
    lines += [
        "",
        f"The law costs a factor **{ratio:.1f}** of the fit ({each:.1f} an iteration); limit 10, aim 4. "
        f"The torque, {FRICTION:g} N m in the record, is found as "
        f"{torque.value:.3f} ± {torque.stderr:.3f} N m; {steps}.",
    ]
    return lines


# ---- 2. accuracy


def _joint(law: Callable[[Any, Any], Any]) -> Model:
    """Two masses and a nonlinear law of twist and twist rate in their coupling."""
    b = ce.Blueprint("pair")
    one, two = b.state("one", scale=100.0), b.state("two", scale=100.0)
    twist, push, load = b.state("twist", scale=0.1), b.input("push"), b.input("load")
    rate = two - one
    inner = 1992 * twist + 2.5 * rate + b.port("joint", "coupling", {"twist": twist, "twist_rate": rate})
    b.ode("one", 2.557 * (inner - 0.15 * one + push))
    b.ode("two", 5.646 * (-inner - load))
    b.ode("twist", rate)
    b.output("y", one)
    b.law("joint", law(twist, rate))
    return b.model()


def _run(model: Model, grid: Grid, start: list[float], substeps: int = 1) -> np.ndarray:
    plan, scale = cut(grid, None), np.array([state.scale for state in model.states])
    p = ca.DM(model.parameter_vector())
    made = make_propagator(model, grid, plan, ca.SX(0, 1), p, scale=scale, substeps=substeps)
    y = made.propagate(np.zeros(0), np.array(start)[None] / scale, 0).y[0]
    return np.asarray(y.reshape(len(plan.samples), plan.b, 1).transpose(1, 0, 2).ravel()[: grid.samples])


def accuracy() -> list[str]:
    """The lines on exactness."""
    laws: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
        "smooth Coulomb friction, 5 N m, width 0.5 rad/s": (
            lambda a, v: 5 * ca.tanh(v / 0.5),
            lambda a, v: 5 * np.tanh(v / 0.5),
        ),
        "cubic stiffness": (lambda a, v: 2e6 * a**3, lambda a, v: 2e6 * a**3),
        "quadratic drag": (lambda a, v: 0.5 * ca.fabs(v) * v, lambda a, v: 0.5 * np.abs(v) * v),
    }
    count, time_ = 400, STEP * np.arange(400)
    push = 57 + 300 * np.maximum(np.sin(250 * time_), 0) ** 4
    grid = Grid(0.0, STEP, count, np.array([push, np.full(count, 57.0)]), ("first", "first"), {})
    start = [120.0, 120.0, -57 / 1992]
    lines = ["| law | largest error of the output, relative |", "|---|---|"]
    for name, (symbolic, number) in laws.items():
        found, wanted, x = _run(_joint(symbolic), grid, start), [start[0]], np.array(start)
        for k in range(count - 1):

            def slope(
                t: float, x: np.ndarray, k: int = k, number: Callable[..., Any] = number
            ) -> list[float]:
                drive = push[k] + (push[k + 1] - push[k]) * t / STEP
                inner = 1992 * x[2] + 2.5 * (x[1] - x[0]) + number(x[2], x[1] - x[0])
                return [2.557 * (inner - 0.15 * x[0] + drive), 5.646 * (-inner - 57), x[1] - x[0]]

            x = solve_ivp(slope, (0, STEP), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            wanted.append(x[0])
        off = np.abs(found - np.array(wanted)).max() / np.abs(wanted).max()
        lines.append(f"| {name} | {off:.1e} |")
    lines += [
        "",
        "A sliding mass (1 m/s) that dry friction (2 m/s²) stops, against its parabola:",
        "",
        "| width of the smoothing [m/s] | largest error of the path [m] |",
        "|---|---|",
    ]
    step = 1e-3
    t = step * np.arange(1500)
    sharp = np.where(t < 0.5, t - t**2, 0.25)
    still = Grid(0.0, step, 1500, np.zeros((1, 1500)), ("first",), {})
    for width, substeps in ((0.1, 1), (0.01, 1), (0.001, 4), (0.0001, 32)):
        b = ce.Blueprint("braked")
        v, q, force = b.state("v"), b.state("q"), b.input("F")
        b.ode("v", force + b.port("ground", "inertia", {"speed": v}))
        b.ode("q", v)
        b.law("ground", -2.0 * ca.tanh(v / width))
        b.output("q", q)
        off = np.abs(_run(b.model(), still, [1.0, 0.0], substeps) - sharp).max()
        lines.append(f"| {width:g} | {off:.1e} |")
    return lines


# ---- 3. candidates, 4. the Jacobian


def candidates() -> list[str]:
    """Sixty laws along a record of 14 402 samples."""
    record = ce.read_experiment(limit.RECORD.parents[1] / "misfire_1200rpm.csv.gz", optional=("omega_load",))
    lines = ["| null model | CPU, median of 5 |", "|---|---|"]
    for form, words in (("measured", "linear"), ("model", "nonlinear")):
        model = ce.two_mass(outputs=("omega", "omega_load"), reciprocating_speed=form)
        grid = lay_grid(model, record)
        channels = np.concatenate(
            [grid.channels, grid.channels[:, -1:].repeat(14402 - grid.samples, axis=1)], axis=1
        )
        grid = replace(grid, samples=14402, channels=channels, measured={})
        path = null_path(model, grid, model.parameter_vector(), [124.0, 121.0, 0.01])
        made = []
        for port, signal in (("coupling", "twist_rate"), ("engine", "speed"), ("load", "speed")):
            v = model.ports[port].signals[signal]
            made += [
                torque_direction(model, port, ca.tanh((v - 6 * k) / (0.5 + k)), name=f"{k}")
                for k in range(20)
            ]
        spent = limit.median_time(lambda path=path, made=made: grid_sensitivities(path, made), 5)  # type: ignore[misc]
        lines.append(f"| {words} | {spent:.3f} s |")
    return [*lines, "", "Limit 2 s, aim 0.3 s."]


def jacobian() -> list[str]:
    """The Jacobian of B against the operations it needs."""
    record, model = ce.read_experiment(limit.RECORD), ce.crankshaft(reciprocating_speed="measured")
    rate, plain, bent = (
        limit.product_rate(),
        limit.times(model, record),
        limit.times(limit.with_coulomb(model), record),
    )
    *sizes, plan, samples = plain["counts"]
    lines = ["| operations | Mflop | limit | measured | ratio |", "|---|---|---|---|---|"]
    for name, flops in (
        ("sample by sample", limit.plain_flops(*sizes, samples)),
        (f"in blocks of {plan.q}", limit.block_flops(*sizes, plan)),
    ):
        least, took = flops / rate, plain["jacobian"]
        lines.append(
            f"| {name} | {flops / 1e6:.0f} | {least * 1e3:.2f} ms | {took * 1e3:.2f} ms | **{took / least:.1f}** |"
        )
    return [
        *lines,
        "",
        f"Square products at {rate / 1e9:.1f} Gflop/s; limit 5, aim 2. With the friction law, which no block can "
        f"hold, a Jacobian takes {bent['jacobian'] * 1e3:.1f} ms and second derivatives "
        f"{bent['hessian'] * 1e3:.1f} ms more ({plain['hessian'] * 1e3:.1f} ms without).",
    ]


def main() -> None:
    """Print the tables, write them if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--write", action="store_true")
    chosen = parser.parse_args()
    parts = [
        "# Nonlinear laws",
        f"{datetime.date.today():%Y-%m-%d}, `python tests/benchmarks/nonlinear_core.py --write`; {platform.machine()}, "
        f"one thread, three million additions in Python in {reading():.2f} s.",
        "## The price of a law",
        "\n".join(price(chosen.starts)),
        "## Accuracy",
        "\n".join(accuracy()),
        "## Sixty candidate laws, two outputs, 14 402 samples",
        "\n".join(candidates()),
        "## The Jacobian of B",
        "\n".join(jacobian()),
    ]
    text = "\n\n".join(parts) + "\n"
    print(text)
    if chosen.write:
        (HERE / "NONLINEAR.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
