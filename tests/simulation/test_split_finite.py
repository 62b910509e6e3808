"""A linear part of which a slope by a parameter is no number is none: the whole equation is a law then."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.simulation.split import split


def reactor():
    """A decay by Arrhenius' law beside two linear equations: at T = 0, exp(-E/(R T)) is 0 and its slope by E none."""
    b = ce.Blueprint("reactor")
    rate = b.parameter("k", 2e-3, unit="1/s", min=1e-5, max=1)
    energy = b.parameter("E", 5e4, unit="J/mol", min=1e4, max=2e5)
    c, warm, metal = b.state("c", unit="mol/L"), b.state("T", unit="K"), b.state("T_m", unit="K")
    heat = b.input("P", unit="W")
    b.ode("c", -rate * ca.exp(-energy / 8.314 * (1 / warm - 1 / 318.0)) * c + 5e-5)
    b.ode("T", (200 * (metal - warm) - 50 * (warm - 295)) / 4e4)
    b.ode("T_m", (heat - 200 * (metal - warm)) / 5e3)
    b.output("conc", c, unit="mol/L")
    b.output("temp", warm, unit="K")
    return b.model()


def record():
    """By SciPy, with k = 0.003 1/s and E = 70 kJ/mol."""
    rng, time = np.random.default_rng(3), np.arange(300) * 5.0
    heat = np.interp(time, np.linspace(0, time[-1], 9), rng.uniform(0, 3000, 9))

    def rates(t, x):
        c, warm, metal = x
        decay = 3e-3 * np.exp(-7e4 / 8.314 * (1 / warm - 1 / 318.0)) * c
        flow = 200 * (metal - warm)
        return [5e-5 - decay, (flow - 50 * (warm - 295)) / 4e4, (np.interp(t, time, heat) - flow) / 5e3]

    run = solve_ivp(rates, (0, time[-1]), [0.05, 310, 312], t_eval=time, rtol=1e-9, atol=1e-11, max_step=5)
    shown = {
        "conc": run.y[0] + 2e-4 * rng.standard_normal(300),
        "temp": run.y[1] + 0.05 * rng.standard_normal(300),
    }
    return ce.Experiment.from_arrays(
        "run", time=time, units={"P": "W", "conc": "mol/L", "temp": "K"}, P=heat, **shown
    )


def test_the_core_holds_no_slope_that_is_no_number():
    core = split(reactor()).core
    p = reactor().parameter_vector()
    slopes = ca.jacobian(ca.vec(ca.densify(core.A)), reactor().p)
    assert not slopes.nnz()  # the decay is a law as a whole
    assert np.isfinite(np.array(ca.Function("A", [], [core.A])()["o0"])).all()
    assert len(p) == 2


def test_a_fit_finds_the_energy_of_a_reaction():
    """ "The model cannot be evaluated at the start values", whatever these were."""
    fit = ce.estimate(reactor(), record(), initial={"c": 0.05, "T": 310.0, "T_m": 312.0}, progress=False)
    assert fit.converged
    for name, true in (("k", 3e-3), ("E", 7e4)):
        one = fit.estimates[name]
        assert abs(one.value - true) < 4 * one.stderr
        assert one.stderr < 0.1 * true


def test_a_lag_of_a_sensor_beside_it_can_be_simulated():
    model = reactor().with_effect(
        ce.effects.SensorLag(), at="sensor_conc", values={"share": 1.0, "time": 20.0}
    )
    fit = ce.estimate(model, record(), initial={"c": 0.05, "T": 310.0, "T_m": 312.0}, progress=False)
    assert fit.converged
    assert fit.values["E"] == pytest.approx(7e4, rel=0.1)
