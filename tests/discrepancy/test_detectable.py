"""The size that would have been found is said where it says something, and words where it does not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.discrepancy.detectable import not_found, prior_scales
from casadi_engine.discrepancy.summary import _not_found


def spun(noise, *, turning=3.0, seed=0):
    """A rotor that turns one way, by SciPy: J dw/dt = T - c w."""
    time = np.arange(400) * 0.02

    def torque(t):
        return turning + 2 * np.sin(0.9 * t) + 0.5 * np.sin(5 * t)

    made = solve_ivp(
        lambda t, w: (torque(t) - 0.8 * w) / 0.5,
        (0, time[-1]),
        [turning / 0.8],
        t_eval=time,
        rtol=1e-9,
        atol=1e-9,
    )
    speed = made.y[0] + noise * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays(
        "run", time=time, T=torque(time), w=speed, units={"T": "N m", "w": "rad/s"}, inputs=["T"]
    )


def rotor():
    b = ce.Blueprint("rotor")
    J, c = b.parameter("J", 0.5, unit="kg m2", min=0.01), b.parameter("c", 0.8, unit="N m s/rad", min=0)
    w, torque = b.state("w", unit="rad/s"), b.input("T", unit="N m")
    b.ode("w", (torque - c * w + b.port("rotor", "inertia", {"speed": w})) / J)
    b.output("w", w, unit="rad/s")
    return b.model()


def missed(noise, effects, **options):
    fit = ce.estimate(rotor(), spun(noise, **options), noise=ce.Noise(w=noise), progress=False)
    screened = screen(fit, effects)
    return screened, {one.name: one for one in not_found(screened)}


FRICTION = ["coulomb_friction", "constant_torque", "quadratic_drag"]


def test_effects_that_do_the_same_are_said_to_do_so():
    _, found = missed(0.01, FRICTION)
    assert found["coulomb_friction"].twin == "constant_torque at rotor"
    assert found["constant_torque"].twin == "coulomb_friction at rotor"
    assert found["quadratic_drag"].twin == ""
    _, both_ways = missed(0.01, FRICTION, turning=0.0)
    assert [one.twin for one in both_ways.values()] == ["", "", ""]


def test_a_size_beyond_what_the_record_moves_excludes_nothing():
    _, clear = missed(0.01, ["quadratic_drag", "sensor_offset"], turning=0.0)
    _, noisy = missed(30.0, ["quadratic_drag", "sensor_offset"], turning=0.0)
    assert clear["quadratic_drag"].excluded
    assert not noisy["quadratic_drag"].excluded
    assert noisy["quadratic_drag"].testable
    assert noisy["quadratic_drag"].note.startswith("it would have to move an output by ")
    assert noisy["sensor_offset"].note.endswith("as large as 5 % of what the output varies by")


def test_the_plausible_size_is_that_which_moves_an_output_by_its_variation():
    screened, _ = missed(0.01, ["sensor_offset", "sensor_gain", "constant_torque"])
    varied = np.std(spun(0.0)["w"].values)
    scales = dict(zip([one.effect for one in screened.candidates], prior_scales(screened), strict=True))
    assert scales["sensor_offset"] == pytest.approx(0.05 * varied, rel=0.01)
    # a constant torque comes to its full speed within the time J/c of the start
    assert scales["constant_torque"] == pytest.approx(0.8 * varied, rel=0.1)


def printed(some, said="nothing missing", undetermined=()):
    class Found:
        not_found, verdict, model, unknown = tuple(some), said, ce.one_inertia(), None
        fit = SimpleNamespace(undetermined=undetermined, free=("J", "k", "c"))

    forms = _not_found(Found())
    return " ".join(" ".join(forms[0] if forms else ()).split())


def test_the_screen_says_it_in_words():
    _, found = missed(0.01, FRICTION)
    text = printed(found.values())
    assert "quadratic_drag at rotor 0.0" in text
    assert "coulomb_friction at rotor not told from constant_torque at rotor (one of the two from" in text
    assert "and 1 more that have such a rival" in text
    assert printed(found.values(), "unnamed") == ""  # along a model that lacks what is not named
    drag = replace(
        found["quadratic_drag"], note="it would have to move an output by 3 times what that varies by"
    )
    text = printed([drag])
    assert "no plausible size is excluded of quadratic_drag at rotor" in text
    assert f"{drag.smallest_detectable:.2g}" not in text
    scale = SimpleNamespace(weights={"J": 0.6, "k": 0.6, "c": 0.5})
    text = printed(found.values(), undetermined=(scale,))
    assert "Smallest detectable sizes (95 % power) with J, k, c as fitted: " in text
    offset = replace(found["quadratic_drag"], name="sensor_gain", unit="1", smallest_detectable=0.041)
    lag = replace(offset, name="input_gain", testable=False)
    text = printed([offset, lag])
    assert "sensor_gain at rotor a share of 0.041" in text
    assert "not testable with these data: input_gain at rotor" in text
    text = printed([drag, *(replace(drag, name=f"effect_{k}") for k in range(4))])
    assert "of quadratic_drag at rotor, effect_0 at rotor, effect_1 at rotor and 2 more" in text
