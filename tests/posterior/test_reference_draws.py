"""Two posteriors of ordinary differential equations against reference draws of posteriordb.

Data and quantiles of the reference draws (10 000 of Stan, R-hat below 1.01) are from github.com/stan-dev/posteriordb,
commit 28f8d3d, Copyright (c) 2011-2024, Stan Developers and their Assignees, BSD 3-Clause License; the pelts are those
of the Hudson's Bay Company (Hewitt 1921). Priors that the package does not have enter as weights of its draws.
"""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce

pytestmark = pytest.mark.slow

LEVELS = (0.025, 0.1, 0.25, 0.5, 0.75, 0.9, 0.975)
HARE = [30, 47.2, 70.2, 77.4, 36.3, 20.6, 18.1, 21.4, 22, 25.4, 27.1, 40.3, 57, 76.6, 52.3, 19.5, 11.2, 7.6, 14.6,
        16.2, 24.7]  # fmt: skip
LYNX = [
    4,
    6.1,
    9.8,
    35.2,
    59.4,
    41.7,
    19,
    13,
    8.3,
    9.1,
    7.4,
    8,
    12.3,
    19.5,
    45.7,
    51.1,
    29.7,
    15.8,
    9.7,
    10.1,
    8.6,
]
LYNX_HARE = {
    "alpha": (0.430718, 0.469313, 0.503621, 0.543648, 0.587064, 0.628665, 0.680291),
    "beta": (0.020395, 0.022652, 0.02485, 0.027502, 0.030319, 0.033181, 0.036552),
    "gamma": (0.640902, 0.691454, 0.738134, 0.794057, 0.854908, 0.917551, 0.991832),
    "delta": (0.017843, 0.019897, 0.021648, 0.023825, 0.026156, 0.028764, 0.031733),
    "sigma(hare)": (0.180215, 0.198126, 0.217359, 0.242489, 0.272423, 0.304964, 0.348935),
    "sigma(lynx)": (0.183305, 0.200781, 0.220082, 0.244836, 0.275707, 0.308648, 0.352477),
}
FIRST = {
    "hare_0": (28.512339, 30.384169, 32.076622, 33.944084, 35.908215, 37.744147, 40.066785),
    "lynx_0": (4.968617, 5.291084, 5.578611, 5.911344, 6.259822, 6.616572, 7.045547),
}
CONCENTRATION = [
    5.70812264865215, 7.10126075072086, 8.38520678426651, 9.79008249883381, 13.4390409239245, 11.4478987597702,
    11.2124282696837, 11.4269217682577, 12.2432859438401, 13.8201804108938, 13.8408670746042, 11.422291744251,
    10.5031943081843, 11.9121452242965, 14.0849980781312, 10.5505145523917, 10.1905539351877, 12.2232272590821,
    11.7290653047821, 12.2719396535996,
]  # fmt: skip
ELIMINATION = {
    "k_a": (0.626491, 0.668345, 0.708803, 0.755026, 0.805831, 0.8591, 0.932187),
    "K_m": (0.041087, 0.164212, 0.408339, 0.979539, 2.253882, 5.081836, 15.049631),
    "V_m": (0.594365, 0.705323, 0.792468, 0.897298, 1.025641, 1.227618, 1.899536),
    "sigma(C)": (0.092071, 0.10247, 0.112362, 0.125453, 0.142091, 0.159788, 0.183825),
}


def weighted_quantiles(x, weight):
    order = np.argsort(x)
    share = np.cumsum(weight[order])
    return np.interp(LEVELS, (share - 0.5 * weight[order]) / share[-1], x[order])


def apart(post, reference, log_weight):
    """name -> (7,) how far quantiles are from the reference's, in its spread; all of logarithms."""
    weight = np.exp(log_weight - log_weight.max())
    found = {}
    for name, known in reference.items():
        ours, known = np.log(weighted_quantiles(post[name], weight)), np.log(known)
        found[name] = (ours - known) / (0.5 * (known[5] - known[1]) / 1.2816)
    return found


def agree(found):
    """The ends of 95 % are known to a third of a spread from as many draws, the middle to a fifth."""
    for name, own in found.items():
        assert np.abs(own[1:-1]).max() < 0.2, name
        assert np.abs(own).max() < 0.5, name


def lynx_hare_fit():
    """Lotka and Volterra's predators and prey, in logarithms; the first ones are parameters."""
    b = ce.Blueprint("lynx_hare")
    alpha, beta = b.parameter("alpha", 0.8, min=1e-3), b.parameter("beta", 0.04, min=1e-5)
    gamma, delta = b.parameter("gamma", 0.8, min=1e-3), b.parameter("delta", 0.04, min=1e-5)
    first = b.parameter("log_hare_0", 3.4), b.parameter("log_lynx_0", 1.5)
    x, y = b.state("x"), b.state("y")
    b.ode("x", alpha - beta * ca.exp(first[1] + y))
    b.ode("y", -gamma + delta * ca.exp(first[0] + x))
    b.output("hare", first[0] + x)
    b.output("lynx", first[1] + y)
    model = b.model()
    pars = model.parameters()
    for name, mean, sigma in (
        ("alpha", 1, 0.5),
        ("gamma", 1, 0.5),
        ("beta", 0.05, 0.05),
        ("delta", 0.05, 0.05),
    ):
        pars[name].set(prior=(mean, sigma))
    for name in ("log_hare_0", "log_lynx_0"):
        pars[name].set(prior=(np.log(10), 1.0))
    data = ce.Experiment.from_arrays(
        "pelts", time=np.arange(21.0), units={"hare": "1", "lynx": "1"}, hare=np.log(HARE), lynx=np.log(LYNX)
    )
    return ce.estimate(
        model, data, parameters=pars, noise=ce.Noise(hare="estimate", lynx="estimate"), initial={"x": 0.0, "y": 0.0},
        progress=False,
    )  # fmt: skip


def test_lynx_and_hare():
    post = ce.posterior(lynx_hare_fit(), draws=2000)
    # noise levels: log-normal about exp(-1) with sigma 1, ours flat in the logarithm
    log_weight = -0.5 * sum((np.log(post[f"sigma({name})"]) + 1) ** 2 for name in ("hare", "lynx"))
    found = apart(post, LYNX_HARE, log_weight)
    agree(found)
    for name, known in FIRST.items():
        log = np.log(weighted_quantiles(np.exp(post[f"log_{name}"]), np.exp(log_weight - log_weight.max())))
        assert np.abs(log - np.log(known))[1:-1].max() < 0.2 * np.ptp(np.log(known)) / 4


def one_compartment_fit():
    """A drug that is absorbed and eliminated (Michaelis and Menten); the data hardly tell K_m, whose tail is long."""
    b = ce.Blueprint("one_compartment")
    k_a = b.parameter("k_a", 0.8, min=1e-3, max=1e3)
    k_m, v_m = b.parameter("K_m", 1.0, min=1e-4, max=1e4), b.parameter("V_m", 1.0, min=1e-3, max=1e4)
    c, dose = b.state("c"), b.input("D")
    b.ode("c", 0.5 * dose * k_a * ca.exp(-k_a * b.time) - 0.5 * v_m * c / (k_m + c))
    b.output("C", ca.log(c + 1e-9))
    model = b.model()
    time = np.arange(0, 10.1, 0.5)
    data = ce.Experiment.from_arrays(
        "dose", time=time, units={"D": "1", "C": "1"}, D=np.full(21, 30.0), C=np.log([np.nan, *CONCENTRATION])
    )
    return ce.estimate(model, data, noise=ce.Noise(C="estimate"), initial={"c": 0.0}, progress=False)


def test_one_compartment_with_saturated_elimination():
    post = ce.posterior(one_compartment_fit())
    # half-Cauchy priors of scale 1 in place of those that are flat in the logarithm
    log_weight = sum(np.log(post[name]) - np.log1p(post[name] ** 2) for name in ELIMINATION)
    found = apart(post, ELIMINATION, log_weight)
    agree(found)
