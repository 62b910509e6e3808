"""Laws with corners, held against simpler ones whose corners are as sharp as they may be."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce


def sprinkler():
    b = ce.Blueprint("sprinkler")
    inertia = b.parameter("J", 0.03, unit="kg m2", min=1e-3, vary=False)
    k, c = b.parameter("k", 0.4, unit="N m", min=0), b.parameter("c", 0.05, unit="N m s/rad", min=0)
    w, p = b.state("w", unit="rad/s"), b.input("p", unit="1")
    b.ode("w", (k * p - c * w + b.port("arm", "inertia", {"speed": w})) / inertia)
    b.output("n", w, unit="rad/s")
    return b.model()


def turned(name, levels, seed):
    """An arm that turns one way alone and rests in between, with dry friction, by SciPy."""
    rng = np.random.default_rng(seed)
    time = np.arange(20 * len(levels)) * 0.1
    p = np.convolve(np.repeat(levels, 20), np.ones(3) / 3, "same")

    def rate(t, x):
        drive = 0.5 * np.interp(t, time, p) - 0.06 * x[0]
        stuck = abs(x[0]) < 1e-4 and abs(drive) <= 0.25
        return [
            -100 * x[0] if stuck else (drive - 0.25 * np.sign(x[0] if abs(x[0]) > 1e-4 else drive)) / 0.025
        ]

    w = solve_ivp(rate, (0, time[-1]), [0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.005).y[0]
    n = w + 0.08 * rng.standard_normal(len(time))
    return ce.Experiment.from_arrays(name, time=time, units={"p": "1", "n": "rad/s"}, p=p, n=n)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_friction_by_direction_is_no_name_for_a_sharper_corner(seed):
    """Its asymmetry, of a shaft that never turns back, made a wide corner steep: named alone and confirmed."""
    search = turned("run", [0, 2, 0, 3, 1, 0, 2, 4, 0, 1, 3, 2], seed)
    fresh = turned("other", [0, 3, 0, 2, 1, 0, 4, 2], seed + 50)
    effects = ["coulomb_friction", "asymmetric_friction", "quadratic_drag"]
    found = ce.repair(sprinkler(), search, fresh=fresh, effects=effects, progress=False)
    (one,) = found.effects
    assert one.members[0].label == "coulomb_friction at arm"
    assert one.amplitude.value == pytest.approx(0.3, rel=0.1)  # in the scale of the inertia that is known
