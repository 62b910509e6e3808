"""An event beside what comes gradually: a load that comes is one, the rest of a law along a run-down is none."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce


def flywheel():
    b = ce.Blueprint("flywheel")
    inertia = b.parameter("J", 0.8, unit="kg m2", vary=False)
    d = b.parameter("d", 0.01, unit="N m s/rad", min=0)
    speed = b.state("w", unit="rad/s", scale=30)
    acts = b.port("flywheel", "inertia", {"speed": speed})
    b.ode("w", (-d * speed + acts) / inertia)
    b.output("omega", speed, unit="rad/s")
    return b.model()


def run_down(name, first, seed, *, windage=0.0, load=0.0, at=np.inf):
    """A run-down by an integrator of its own: viscous friction, and windage or a brake that comes at a time."""
    time = np.arange(400) * 0.1

    def rate(t, w):
        return (-0.02 * w - windage * w * abs(w) - load * (t >= at)) / 0.8

    parts = [0.0, *([at] if at < time[-1] else []), time[-1]]
    speed, start = np.empty(0), [first]
    for low, high in pairwise(parts):
        own = time[(time >= low) & (time < high) if high < time[-1] else (time >= low)]
        done = solve_ivp(rate, (low, high), start, t_eval=own, rtol=1e-10, atol=1e-10)
        end = solve_ivp(rate, (low, high), start, rtol=1e-10, atol=1e-10).y[:, -1]
        speed, start = np.concatenate([speed, done.y[0]]), end
    noise = 0.02 * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays(name, time=time, units={"omega": "rad/s"}, omega=speed + noise)


def repaired(**law):
    data = [run_down("one", 60.0, 1, **law), run_down("two", 45.0, 2, **law)]
    effects = ["load_step", "sensor_offset"]
    return ce.repair(
        flywheel(), data, fresh=run_down("fresh", 52.0, 3, **law), effects=effects, progress=False,
        noise=ce.Noise(omega=0.02),
    )  # fmt: skip


def test_a_brake_that_comes_at_once_is_an_event():
    found = repaired(load=0.15, at=17.3)
    (effect,) = found.effects
    assert effect.key == "flywheel.load_step"
    assert found.confirmed
    size = effect.parameters["flywheel.load_step.torque"]
    assert size.value == pytest.approx(-0.15, abs=4 * size.stderr) or size.value == pytest.approx(
        0.15, abs=4 * size.stderr
    )


def test_what_a_law_lacks_along_a_run_down_is_no_event():
    """Windage that no effect may name: a brake with a time and a size in each record closed most of it, and was
    confirmed by fresh data, in which it had a time and a size of its own again."""
    found = repaired(windage=4e-4)
    assert found.verdict == "unnamed"
    assert not any(one.name == "load_step" for one in found.effects)
