"""Laws of no name are held against effects by fresh data too, along one simulation of all of them."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import answer
from casadi_engine.discrepancy import elsewhere_families as module
from casadi_engine.discrepancy.all_data import along_all_data
from casadi_engine.discrepancy.elsewhere_families import elsewhere
from casadi_engine.discrepancy.evidence import FACTOR, Levels
from casadi_engine.discrepancy.null_model import null_model

NOISE = 0.02


def model():
    """A body of heat in an ambient that stays; the loss is proportional."""
    b = ce.Blueprint("body")
    c = b.parameter("C", 12.0, unit="J/K", min=1)
    g = b.parameter("G", 0.6, unit="W/K", min=0.01)
    t, p = b.state("T", unit="K", scale=30), b.input("P", unit="W")
    b.ode("T", (p - g * t + b.port("body", "inertia", {"speed": t}, unit="W")) / c)
    b.output("shown", t, unit="K")
    return b.model()


def run(seed, low, high, *, bend=0.0):
    """By SciPy, between two powers; what the body takes up grows with its temperature."""
    time = np.arange(400) * 0.25
    rng = np.random.default_rng(seed)
    power = np.interp(time, np.arange(0, 101, 5), rng.uniform(low, high, 21))
    start = 0.5 * (low + high) / 0.5

    def rate(t, y):
        return (np.interp(t, time, power) - 0.5 * y) / (10 * (1 + bend * (y - 30)))

    y = solve_ivp(rate, (0, time[-1]), [start], t_eval=time, rtol=1e-9, atol=1e-9, max_step=0.25).y[0]
    shown = y + NOISE * rng.standard_normal(len(time))
    return ce.Experiment.from_arrays(
        f"run {seed}", time=time, units={"P": "W", "shown": "K"}, P=power, shown=shown
    )


def fitted(record):
    return ce.estimate(model(), record, noise=ce.Noise(shown=NOISE), starts=1, progress=False)


def press():
    """A ram that a pump drives against a spring; its chamber is as stiff as its oil."""
    b = ce.Blueprint("press")
    m, c = b.parameter("m", 150.0, unit="kg", min=5), b.parameter("c", 3000.0, unit="N s/m", min=0)
    k, bulk = b.parameter("k", 1.6e5, unit="N/m", min=0), b.parameter("B", 1.5e8, unit="Pa", min=1e6)
    x, v, p = b.state("x", unit="m"), b.state("v", unit="m/s"), b.state("p", unit="Pa")
    flow = b.input("Q", unit="m3/s")
    piece = b.port("piece", "coupling", {"twist": x, "twist_rate": v, "stiffness": k})
    b.ode("x", v)
    b.ode("v", (2e-3 * (p - 8e6) - c * v - k * x - piece) / m)
    b.ode("p", bulk / 8e-4 * (flow - 2e-3 * v))
    b.output("p", p, unit="Pa")
    return b.model()


def pressed(seed, size, noise=6e4):
    """By SciPy: there is air in the oil, which makes it softer where the pressure is low."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 12, 0.0125)
    phase = rng.uniform(0, 2 * np.pi, 4)
    tones = 2 * np.pi * np.array([0.2, 0.53, 1.1, 2.3])
    flow = size * (np.array([0.7, 0.5, 0.5, 0.4]) @ np.sin(tones[:, None] * time + phase[:, None]))

    def rate(t, y):
        x, v, p = y
        bulk = 1.2e8 * 1.5 * p / (p + 1.5e6)
        return [
            v,
            (2e-3 * (p - 8e6) - 4000 * v - 2e5 * x) / 120,
            bulk / 8e-4 * (np.interp(t, time, flow) - 2e-3 * v),
        ]

    y = solve_ivp(
        rate, (0, 12), [0, 0, 8e6], t_eval=time, method="LSODA", rtol=1e-9, atol=1e-9, max_step=0.0125
    ).y
    p = y[2] + noise * rng.standard_normal(len(time))
    return ce.Experiment.from_arrays(f"run {seed}", time=time, units={"Q": "m3/s", "p": "Pa"}, Q=flow, p=p)


@pytest.mark.parametrize("by_all", [True, False])
def test_a_law_is_held_against_an_effect_by_fresh_data_too(monkeypatch, by_all):
    """A spring that hardens describes the search to its noise, and was named alone; fresh data, which reach other
    pressures, make a law of no name the more probable one, among them the modulus that depends on pressure."""
    monkeypatch.setattr(answer, "refitted_law", lambda *_, **__: None)
    if not by_all:
        monkeypatch.setattr(answer, "along_all_data", lambda *_: None)
    search, fresh = pressed(1, 1e-4, 3e4), pressed(2, 7e-5, 3e4)
    effects = ["cubic_stiffness", "viscous_friction"]
    found = ce.repair(press(), search, fresh=fresh, effects=effects, starts=1, progress=False)
    odds = found.unknown.odds if found.unknown is not None else 0.0
    assert (odds > 10) is by_all
    assert odds < 1 or found.verdict == ("class" if odds <= FACTOR else "unnamed")


def test_functions_that_do_no_more_than_their_constant_are_looked_at_once(monkeypatch):
    """A constant at the body takes most of this gap, by whatever signal; the heat capacity that is not constant comes
    after all of them, and had been left out."""
    null = null_model(fitted(run(1, 10, 20, bend=0.01)))
    levels = Levels({"shown": NOISE})
    drops = {}

    def few(null, levels, places):
        drops["names"] = [(port.name, signal.name) for port, signal in places]
        drop = np.array([100.0 - k for k in range(len(places))])
        return drop, np.where(np.arange(len(places)) < len(places) - 1, 1.0, 50.0)

    monkeypatch.setattr(module, "_drops", few)
    _, families, among = elsewhere(null, levels)
    names = drops["names"]
    assert [(one.port, one.signal) for one in families] == [names[0], names[-1]]
    assert among == len(names)


def test_what_a_function_does_beyond_its_constant():
    """Chi-squared that three terms take off, and that the constant leaves to the others."""
    null = null_model(fitted(run(1, 10, 20, bend=0.01)))
    places = module._places(null)
    drops, beyond = module._drops(null, Levels({"shown": NOISE}), places)
    assert np.all(drops >= beyond - 1e-9)
    found = dict(zip([(port.name, signal.name) for port, signal in places], beyond, strict=True))
    assert found["parameter_C", "T"] > 30  # chance makes 2


@pytest.mark.parametrize("placed", [True, False])
def test_no_structure_along_data_that_lack_its_numbers(placed):
    tried = stub(effects=(stub(placed=placed),))
    after = [] if not placed else [(None, None)]
    assert along_all_data(None, tried, [None], [], after) is None
