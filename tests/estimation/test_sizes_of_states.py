"""States of very different size in one model: a refit finds the first states of all, whatever their units."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation.refit_entry import refit
from casadi_engine.estimation.windows import sizes_of

TIME = np.arange(400) * 0.2
LEVELS = {"pressure": 500.0, "flow": 4e-6}


def line(scaled):
    """A pipe and a vessel in SI units, with the states' scales or without: 1e-3 m3/s and 2e5 Pa."""
    b = ce.Blueprint("line")
    inertance = b.parameter("I", 7e7, unit="kg/m4", min=1e7, max=1e9)
    loss = b.parameter("R", 2e10, unit="kg/m7", min=1e9, max=1e12)
    capacity = b.parameter("C", 8e-9, unit="m3/Pa", min=1e-9, max=1e-7)
    pump = b.input("p_pump", unit="Pa")
    flow = b.state("q", unit="m3/s", **({"scale": 1e-3} if scaled else {}))
    pressure = b.state("p", unit="Pa", **({"scale": 1e5} if scaled else {}))
    b.ode("q", (pump - pressure - loss * flow * ca.fabs(flow)) / inertance)
    b.ode("p", (flow - 2.6e-6 * ca.sqrt(ca.fmax(pressure, 1.0))) / capacity)
    b.output("pressure", pressure, unit="Pa")
    b.output("flow", flow, unit="m3/s")
    return b.model()


def record():
    """By SciPy, the pump's pressure joined by lines."""
    rng = np.random.default_rng(4)
    pump = rng.uniform(1.4e5, 3e5, 12)[(TIME / 7).astype(int)]

    def rate(t, x):
        q, p = x
        return [(np.interp(t, TIME, pump) - p - 3e10 * q * abs(q)) / 1e8, (q - 2.6e-6 * np.sqrt(p)) / 1e-8]

    run = solve_ivp(
        rate, (0, TIME[-1]), [1e-3, 1.6e5], t_eval=TIME, rtol=1e-9, atol=[1e-12, 1e-4], max_step=0.2
    )
    q, p = run.y
    shown = {
        "pressure": p + LEVELS["pressure"] * rng.standard_normal(len(TIME)),
        "flow": q + LEVELS["flow"] * rng.standard_normal(len(TIME)),
    }
    units = {"p_pump": "Pa", "pressure": "Pa", "flow": "m3/s"}
    return ce.Experiment.from_arrays("run", time=TIME, units=units, p_pump=pump, **shown)


def test_a_refit_in_si_units_ends_where_one_with_scales_does():
    """The first pressure was held by the size of the flow, chi-squared a quarter too high, and the refit said that it
    had converged: the gain of a sensor was named for that of the pump, confirmed."""
    plain, known = (
        refit(model, [record()], model.parameters(), levels=LEVELS, corners=False)
        for model in (line(scaled=False), line(scaled=True))
    )
    assert plain.status == known.status == "converged"
    assert plain.cost == pytest.approx(known.cost, abs=0.05)
    assert plain.cost == pytest.approx(800, abs=4 * np.sqrt(1600))
    for name in ("q", "p"):
        assert plain.initial["run"][name] == pytest.approx(known.initial["run"][name], rel=1e-3)
    assert plain.values == pytest.approx(known.values, rel=1e-4)


def test_the_size_of_a_state_is_its_root_mean_square_and_one_where_it_is_nothing():
    nodes = np.array([[3e5, 0.0, -4e-3], [3e5, 0.0, 4e-3]])
    assert sizes_of(nodes) == pytest.approx([3e5, 1.0, 4e-3])
    assert sizes_of(np.full((2, 1), np.inf)) == pytest.approx([1.0])
