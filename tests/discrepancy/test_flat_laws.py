"""Laws without a slope at amplitude 0, a square or a magnitude of it: looked for from other sizes, and said."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.discrepancy.detectable import not_found


class Squared(ce.Effect):
    name, attaches = "squared_drag", ("inertia",)
    sentence = "a drag at {port} by the square of its root"
    amplitude = ce.effects.Amplitude("root", unit="1", min=0)

    def law(self, port, p, math):
        return -(p.root**2) * port.speed * math.abs(port.speed, width=0.1)


class Magnitude(Squared):
    name = "magnitude_drag"
    amplitude = ce.effects.Amplitude("size", unit="1")

    def law(self, port, p, math):
        return -ca.fabs(p.size) * port.speed * math.abs(port.speed, width=0.1)


class Odd(Squared):
    name = "odd_drag"
    amplitude = ce.effects.Amplitude("root", unit="1")

    def law(self, port, p, math):
        return -p.root * ca.fabs(p.root) * port.speed * math.abs(port.speed, width=0.1)


class Plain(Squared):
    name = "plain_drag"
    amplitude = ce.effects.Amplitude("size", unit="1", min=0)

    def law(self, port, p, math):
        return -p.size * port.speed * math.abs(port.speed, width=0.1)


def spun(drag, seed=0):
    """A rotor with a drag that grows with the square of its speed, by SciPy."""
    time = np.arange(500) * 0.02

    def torque(t):
        return 0.6 * np.sin(0.9 * t) + 0.4 * np.sin(3.1 * t) + 0.2 * np.sin(7 * t)

    def rate(t, w):
        return [(torque(t) - 0.02 * w[0] - drag * w[0] * abs(w[0])) / 0.05]

    made = solve_ivp(rate, (0, time[-1]), [0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.02)
    speed = made.y[0] + 0.1 * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays(
        "run", time=time, T=torque(time), w=speed, units={"T": "N m", "w": "rad/s"}, inputs=["T"]
    )


def rotor():
    b = ce.Blueprint("rotor")
    J, c = b.parameter("J", 0.05, unit="kg m2", min=1e-3), b.parameter("c", 0.02, unit="N m s/rad", min=0)
    w, torque = b.state("w", unit="rad/s", scale=10), b.input("T", unit="N m")
    b.ode("w", (torque - c * w + b.port("rotor", "inertia", {"speed": w})) / J)
    b.output("w", w, unit="rad/s")
    return b.model()


def repaired(effect, drag):
    return ce.repair(
        rotor(), spun(drag), effects=[effect], starts=1, noise=ce.Noise(w=0.1), progress=False, seed=0
    )


@pytest.mark.parametrize(
    ("effect", "power"),
    [
        (Squared(), 0.5),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((Magnitude(), 1.0), (Odd(), 0.5))),
    ],
)
def test_an_effect_without_a_slope_at_zero_is_found(effect, power):
    found = repaired(effect, 0.002)
    assert (found.verdict, [one.name for one in found.effects]) == ("named", [effect.name])
    one = found.effects[0].amplitude
    assert abs(one.value) == pytest.approx(0.002**power, rel=0.05)
    assert abs(abs(one.value) - 0.002**power) < 4 * one.stderr


def test_an_effect_that_is_not_there_is_said_not_to_be_testable_by_a_slope():
    found = repaired(Squared(), 0.0)
    assert found.verdict == "nothing missing"
    text = " ".join(str(found).split())
    assert "squared_drag at rotor does nothing to first order at amplitude 0" in text
    assert "was looked for from amplitudes of 1e-08 to 1e+06" in text
    assert repaired(Plain(), 0.0).messages == ()


def test_a_negative_amplitude_is_looked_for_where_it_does_something_else():
    found = repaired(Odd(), -0.0005)
    assert found.effects[0].amplitude.value == pytest.approx(-(0.0005**0.5), rel=0.1)


def test_the_smallest_size_of_a_square_is_the_root_of_that_of_its_coefficient():
    fit = ce.estimate(rotor(), spun(0.0), noise=ce.Noise(w=0.1), progress=False)
    plain, squared, odd, size = (
        not_found(screen(fit, [effect]))[0] for effect in (Plain(), Squared(), Odd(), Magnitude())
    )
    # thresholds differ a little: how many are tested, and one side or both
    assert squared.smallest_detectable == pytest.approx(plain.smallest_detectable**0.5, rel=0.1)
    assert odd.smallest_detectable == pytest.approx(plain.smallest_detectable**0.5, rel=0.1)
    assert size.smallest_detectable == pytest.approx(plain.smallest_detectable, rel=0.1)
    assert squared.excluded


def test_bounds_of_an_amplitude_hold_for_the_sizes():
    class Small(Squared):
        name = "small_drag"
        amplitude = ce.effects.Amplitude("root", unit="1", min=0, max=0.02)

    class Tiny(Squared):
        name = "tiny_drag"
        amplitude = ce.effects.Amplitude("root", unit="1", min=-1e-9, max=0)

    for effect, sizes in ((Small(), [10.0**k for k in range(-8, -1)]), (Tiny(), [-1e-9])):
        made = ce.effects.candidates(rotor(), [effect], spun(0.0))
        assert [one.size for one in made] == pytest.approx(sizes)
    assert [one.size for one in ce.effects.candidates(rotor(), [Plain()], spun(0.0))] == [None]
