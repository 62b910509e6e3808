"""The drives against which a residual is held are the inputs that act, by their names."""

import numpy as np
from scipy.signal import lfilter

import casadi_engine as ce


def test_an_input_of_which_all_acts_behind_is_tested_by_its_name():
    """It was "the drive is constant", as all of it had moved to a drive of the lag's own."""
    b = ce.Blueprint("body")
    gain, current = b.parameter("k", 2.0, min=0.1), b.input("i", unit="A")
    speed = b.state("w", unit="rad/s")
    b.ode("w", gain * current - speed)
    b.output("n", speed, unit="rad/s")
    model = b.model().with_effect(ce.effects.library("input_lag")[0], at="input_i")
    parameters = model.parameters()
    parameters["input_i.input_lag.share"].set(1.0)
    parameters.fix("input_i.input_lag.share")
    rng, time = np.random.default_rng(1), np.arange(600) * 0.05
    given = np.repeat(rng.uniform(-1, 1, 60), 10)
    step = np.exp(-0.05 / 0.4)
    acts = lfilter([0, 1 - step], [1, -step], given)
    slow = np.exp(-0.05)
    shown = lfilter([0, 1 - slow], [1, -slow], 2 * acts) + 0.01 * rng.standard_normal(600)
    data = ce.Experiment.from_arrays("r", time=time, units={"i": "A", "n": "rad/s"}, i=given, n=shown)
    fit = ce.estimate(model, data, parameters=parameters, progress=False)
    checks = ce.validate(fit, data).records["r"]["n"]
    assert list(checks.cross) == ["i"]
    assert checks.cross["i"].p_value is not None
