"""Events of the user's own model in fresh records: at a time of their own, or not at all."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

SIGMA = 0.05


def record(name, seed, step=None):
    """A disc of 0.8 kg m2 and 0.3 N m s/rad, with a load of 2 N m from the time `step` on, by SciPy."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 12, 0.02)
    torque = 4 * np.sin(1.3 * t + rng.uniform(0, 6)) + 2 * np.sin(3.1 * t + rng.uniform(0, 6))
    ends = [t[0], t[-1]] if step is None else [t[0], step, t[-1]]
    speed, at, w = np.empty(0), t[0], 1.0
    for k, end in enumerate(ends[1:]):
        load = 2.0 * (k == 1)
        inside = np.append(t[(t >= at) & (t < end)], end)
        run = solve_ivp(
            lambda s, x, load=load: (np.interp(s, t, torque) - 0.3 * x - load) / 0.8,
            (at, end), [w], t_eval=inside, rtol=1e-10, atol=1e-12, max_step=0.02,
        )  # fmt: skip
        last = k == len(ends) - 2
        speed = np.append(speed, run.y[0] if last else run.y[0][:-1])
        at, w = end, run.y[0][-1]
    speed += SIGMA * rng.standard_normal(len(t))
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(name, time=t, units=units, T=torque, omega=speed)


def model_with_a_step(time):
    step = ce.effects.LoadStep()
    return ce.one_inertia().with_effect(step, at="engine", values={"torque": -1.0, "time": time})


@pytest.mark.slow  # test_events.py has such a time in fresh records
@pytest.mark.parametrize("own", [3.3, pytest.param(None, marks=pytest.mark.slow)])
def test_a_declared_event_has_a_time_of_its_own_in_fresh_records(own):
    data, fresh = record("a", 1, 7.9), record("b", 2, own)
    model = model_with_a_step(7.5)
    found = ce.repair(model, data, fresh=fresh, effects=["quadratic_drag"], starts=1, progress=False)
    assert found.verdict == "nothing missing"
    said = [words for words in found.messages if words.startswith("engine.load_step")]
    if own is None:
        assert said == ["engine.load_step does not happen in b"]
    else:
        assert said[0].startswith("engine.load_step was found in b too, at 3.3")
    assert found.gaps.validation_before.gap.chi2_per_sample < 1.2


@pytest.mark.slow
def test_what_is_missing_is_not_taken_for_an_event():
    data, fresh = record("a", 1, 7.9), record("b", 2, 3.3)
    other = ce.Experiment.from_arrays(
        "b",
        time=fresh["omega"].time,
        units={"T": "N m", "omega": "rad/s"},
        T=fresh["T"].values,
        omega=fresh["omega"].values + 0.6 * np.sin(5 * fresh["omega"].time),
    )
    found = ce.repair(model_with_a_step(7.5), data, fresh=other, effects=["quadratic_drag"], progress=False)
    assert found.verdict != "nothing missing"
