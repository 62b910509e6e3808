"""Two effects on one equation that may be a product of their signals."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.one_product import may_be_a_product

TIME = np.arange(400) * 0.1
LOSS, PATH = "vat.viscous_friction.coefficient", "w_to_vat.input_path.gain"
FOUND = (
    SimpleNamespace(name="viscous_friction", at="vat", parameters={LOSS: None}),
    SimpleNamespace(name="input_path", at="w_to_vat", parameters={PATH: None}),
)


def repaired():
    """A vat that fills by u; a loss in proportion to its content, and what a recorded wind takes away."""
    b = ce.Blueprint("vat")
    content, u = b.state("S", unit="kg", scale=10), b.input("u", unit="kg/s")
    b.input("w", unit="m/s")
    size = b.parameter("a", 1.0, min=0.1, max=10)
    slot = b.port("vat", "inertia", {"speed": content}, unit="kg/s")
    b.ode("S", size * u + slot)
    b.output("shown", content, unit="kg")
    model = b.model().with_effect(ce.effects.ViscousFriction(), at="vat", values={"coefficient": 0.2})
    return model.with_effect(ce.effects.InputPath(about=2.0), at="w_to_vat", values={"gain": -0.5})


def record(law, swing):
    """By SciPy, with noise of 0.5 %."""
    drive = 2.0 + swing * np.sign(np.sin(0.31 * TIME))
    wind = 2.0 + swing * np.sin(0.83 * TIME)

    def rate(t, z):
        return np.interp(t, TIME, drive) - law(z[0], np.interp(t, TIME, wind))

    z = solve_ivp(rate, (0, TIME[-1]), [10.0], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=0.1).y[0]
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(TIME))
    units = {"u": "kg/s", "w": "m/s", "shown": "kg"}
    return ce.Experiment.from_arrays("r", time=TIME, units=units, u=drive, w=wind, shown=z + noise)


@pytest.mark.parametrize(
    ("law", "swing", "may"),
    [
        (lambda s, w: 0.1 * s * w, 0.15, True),  # about where it works a product is a sum
        (lambda s, w: 0.1 * s * w, 1.5, True),
        (lambda s, w: 0.2 * s + 1.0 * (w - 2.0), 0.02, True),  # and these data do not tell
        (lambda s, w: 0.2 * s + 1.0 * (w - 2.0), 1.0, False),
    ],
)
def test_a_product_is_told_where_the_signals_move(law, swing, may):
    fit = ce.estimate(repaired(), record(law, swing), noise=ce.Noise(shown=0.05), progress=False)
    words = may_be_a_product(fit, FOUND)
    assert words.startswith("viscous_friction at vat and input_path at w_to_vat act on one equation,") == may
    assert bool(words) == may


def test_one_effect_or_two_of_one_signal_or_no_fit_are_no_product():
    fit = ce.estimate(
        repaired(), record(lambda s, w: 0.2 * s + w - 2, 0.1), noise=ce.Noise(shown=0.05), progress=False
    )
    assert may_be_a_product(None, FOUND) == ""
    assert may_be_a_product(fit, FOUND[:1]) == ""
    assert may_be_a_product(fit, (FOUND[0], FOUND[0])) == ""
