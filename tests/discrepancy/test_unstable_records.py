"""Records of an unstable motion are searched in pieces."""

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.fresh import Portions
from casadi_engine.discrepancy.unstable_records import cut_words, in_pieces


def _falling(name, seed, push=0.0):
    """A state that a controller keeps: x' = 4 sin(x) + push + u, u = -9 x held for a step; by SciPy."""
    step, count = 0.01, 700
    x, u = np.zeros(count), np.zeros(count)
    random = np.random.default_rng(seed)
    x[0] = 0.1
    for k in range(count):
        u[k] = -9 * x[k] + np.sin(0.05 * k)
        if k + 1 < count:

            def slope(t, y, held=u[k]):
                del t
                return 4 * np.sin(y) + push + held

            x[k + 1] = solve_ivp(slope, (0, step), x[k : k + 1], rtol=1e-9, atol=1e-12).y[0, -1]
    return ce.Experiment.from_arrays(
        name,
        time=step * np.arange(count),
        units={"u": "N", "y": "m/s"},
        hold={"u": "zero"},
        inputs=("u",),
        u=u,
        y=x + 0.01 * random.standard_normal(count),
    )


def _model():
    b = ce.Blueprint("held")
    rate = b.parameter("rate", 3.5, unit="s-1", min=1, max=10)
    u, x = b.input("u", unit="N"), b.state("x", unit="m/s")
    at = b.port("body", "inertia", {"speed": x})
    b.ode("x", rate * ca.sin(x) + u + at)
    b.output("y", x, unit="m/s")
    return b.model()


def test_a_fit_says_how_far_its_motion_can_be_followed_and_a_repair_keeps_to_it():
    data, fresh = _falling("one", 1, 0.3), _falling("two", 2, 0.3)
    fit = ce.estimate(_model(), data, noise=ce.Noise(y=0.01), progress=False)
    assert 2.0 < fit.followed < 5.0  # a factor of a million, at a rate of 4 / s
    found = in_pieces(Portions((data,), (fresh,), "records"), fit)
    assert [one.name for one in found.data] == [f"one/{k + 1}" for k in range(len(found.data))]
    assert len(found.data) == len(found.fresh) > 1
    assert max(one.duration for one in (*found.data, *found.fresh)) <= fit.followed
    assert f"{fit.followed:.2g} s" in cut_words(fit)
    repair = ce.repair(_model(), data, fresh=fresh, noise=ce.Noise(y=0.01), progress=False)
    assert repair.verdict in ("named", "class")
    assert repair.confirmed
    (effect,) = repair.effects
    assert "body.constant_torque" in [f"{m.at}.{m.name}" for m in effect.members]
    assert any("in pieces" in words for words in repair.messages)


def test_records_that_can_be_followed_stay_whole():
    record = _falling("one", 1).between(0.0, 1.0)
    fit = ce.estimate(_model(), record, noise=ce.Noise(y=0.01), progress=False)
    assert fit.followed is None
    assert in_pieces(Portions((record,), (), None), fit) is None
