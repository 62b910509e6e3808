"""Other parameters with which a linear model does exactly the same, whatever their units."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation import same_response


def oral(*, most=20.0, second=None):
    """A dose that is absorbed with rate ka into a volume V and cleared by CL; second : a measured gut too."""
    b = ce.Blueprint("oral", time_unit="h")
    ka = b.parameter("ka", 1.0, unit="1/h", min=0.01, max=most)
    volume = b.parameter("V", 20.0, unit="L", min=0.5, max=500)
    clearance = b.parameter("CL", 3.0, unit="L/h", min=0.1, max=50)
    gut, amount = b.state("gut", unit="mg"), b.state("amount", unit="mg")
    b.ode("gut", -ka * gut)
    b.ode("amount", ka * gut - clearance / volume * amount)
    b.output("conc", amount / volume, unit="mg/L")
    if second:
        b.output("left", gut, unit="mg")
    return b.model()


def dosed(*, second=None, free=False):
    t = np.linspace(0, 24, 40)
    run = solve_ivp(
        lambda _, x: [-1.2 * x[0], 1.2 * x[0] - 0.16 * x[1]], (0, 24), [100.0, 0.0], t_eval=t, rtol=1e-10
    )
    noise = np.random.default_rng(0).standard_normal((2, 40))
    channels = {"conc": run.y[1] / 25 + 0.05 * noise[0]}
    units = {"time": "h", "conc": "mg/L"}
    if second:
        channels["left"], units["left"] = run.y[0] + noise[1], "mg"
    data = ce.Experiment.from_arrays("dose", time=t, units=units, **channels)
    initial = {"amount": 0.0} if free else {"gut": 100.0, "amount": 0.0}
    return ce.estimate(oral(second=second), data, initial=initial, progress=False)


def notes(fit):
    return " ".join(fit.messages)


def test_absorption_and_elimination_may_be_exchanged():
    fit = dosed()
    found = fit.estimates
    assert (found["ka"].stderr, found["V"].stderr) == (None, None)
    assert found["CL"].stderr == pytest.approx(0.027, rel=0.2)  # the same in both
    rate = fit.values["CL"] / fit.values["V"]
    words = f"ka = {rate:.4g} and V = {fit.values['CL'] / fit.values['ka']:.4g}"
    assert words in notes(fit)


def test_a_measured_gut_tells_them_apart():
    assert all(one.stderr is not None for one in dosed(second=True).estimates.values())


def test_bounds_tell_them_apart():
    data = dosed().data
    model = oral()
    pars = model.parameters()
    pars["ka"].set(min=0.5)
    fit = ce.estimate(model, data, parameters=pars, initial={"gut": 100.0, "amount": 0.0}, progress=False)
    assert all(one.stderr is not None for one in fit.estimates.values())


def cell():
    b = ce.Blueprint("cell")
    r0 = b.parameter("R0", 0.02, unit="ohm", min=1e-3, max=1)
    r1 = b.parameter("R1", 0.01, unit="ohm", min=1e-3, max=1)
    c1 = b.parameter("C1", 1000.0, unit="F", min=10, max=1e5)
    r2 = b.parameter("R2", 0.015, unit="ohm", min=1e-3, max=1)
    tau = b.parameter("tau2", 80.0, unit="s", min=1, max=1000)
    one, two, current = b.state("v1", unit="V"), b.state("v2", unit="V"), b.input("I", unit="A")
    b.ode("v1", (current - one / r1) / c1)
    b.ode("v2", (r2 * current - two) / tau)
    b.output("u", r0 * current + one + two, unit="V")
    return b.model()


def driven(*, initial):
    t = np.arange(600.0)
    current = 2 * np.sign(np.sin(2 * np.pi * (t + 0.5) / 90)) + np.sin(2 * np.pi * t / 400)

    def rate(s, x):
        flow = np.interp(s, t, current)
        return [(flow - x[0] / 0.012) / 900, (0.02 * flow - x[1]) / 120]

    run = solve_ivp(rate, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-12, max_step=1.0)
    u = 0.025 * current + run.y.sum(axis=0) + 5e-4 * np.random.default_rng(0).standard_normal(t.size)
    data = ce.Experiment.from_arrays("drive", time=t, units={"I": "A", "u": "V"}, I=current, u=u)
    return ce.estimate(cell(), data, initial=initial, progress=False)


@pytest.mark.parametrize("initial", [{"v1": 0.0, "v2": 0.0}, None])
def test_two_branches_of_unlike_numbers_may_be_exchanged(initial):
    fit = driven(initial=initial)
    found = fit.values
    assert [name for name, one in fit.estimates.items() if one.stderr is not None] == ["R0"]
    assert f"C1 = {found['tau2'] / found['R2']:.4g}" in notes(fit)
    assert f"tau2 = {found['R1'] * found['C1']:.3g}" in notes(fit)


def test_a_posterior_has_both_and_evidence_for_both():
    fit = driven(initial={"v1": 0.0, "v2": 0.0})
    drawn = ce.posterior(fit, progress=False)
    assert [round(one.mass, 1) for one in drawn.modes] == [0.5, 0.5]
    taus = sorted(one.values["tau2"] for one in drawn.modes)
    assert taus == pytest.approx([fit.values["R1"] * fit.values["C1"], fit.values["tau2"]], rel=1e-3)


def test_what_is_told_has_no_other_point():
    """Two masses by one speed and one torque: five numbers, and nothing else that does the same."""
    fit = ce.estimate(*_two_masses(), progress=False)
    assert all(one.stderr is not None for one in fit.estimates.values())


def _two_masses():
    t = 0.01 * np.arange(1000)
    torque = np.sin(2 * np.pi * 0.7 * t) + np.sign(np.sin(2 * np.pi * 0.31 * t + 0.1))
    b = ce.Blueprint("masses")
    j1, j2 = b.parameter("J1", 0.5, unit="kg m2", min=0.01), b.parameter("J2", 0.8, unit="kg m2", min=0.01)
    k, c = b.parameter("k", 30.0, unit="N m/rad", min=0.1), b.parameter("c", 0.2, unit="N m s/rad", min=0)
    twist, w1, w2 = b.state("twist", unit="rad"), b.state("w1", unit="rad/s"), b.state("w2", unit="rad/s")
    drive = b.input("T", unit="N m")
    b.ode("twist", w1 - w2)
    b.ode("w1", (drive - k * twist - c * (w1 - w2)) / j1)
    b.ode("w2", (k * twist + c * (w1 - w2)) / j2)
    b.output("w1", w1, unit="rad/s")

    def rate(s, x):
        pull = np.interp(s, t, torque)
        inner = 40 * x[0] + 0.3 * (x[1] - x[2])
        return [x[1] - x[2], (pull - inner) / 0.6, inner / 0.9]

    run = solve_ivp(rate, (0, t[-1]), [0.0, 0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.01)
    w = run.y[1] + 0.02 * np.random.default_rng(1).standard_normal(t.size)
    data = ce.Experiment.from_arrays("run", time=t, units={"T": "N m", "w1": "rad/s"}, T=torque, w1=w)
    return b.model(), data


class _OneNumberTwice:
    """The cube of the sum of two numbers: its normal matrix is singular everywhere, and many steps are taken."""

    def at(self, q):
        sums = q.sum(axis=1)[:, None, None] * np.ones((1, 1, 4), dtype=complex)
        return sums**3, np.repeat(3 * sums[:, None] ** 2, 2, axis=1)

    def drawn(self, count):
        return np.linspace(-3.0, -1.0, count)[:, None] * np.ones(2)

    def inside(self, q):
        return q


def test_a_singular_search_ends_without_an_error():
    """Its damping fell with every step until the matrix was singular in numbers of 64 bits, and a repair was lost."""
    found = same_response._searched(_OneNumberTwice(), np.zeros((1, 4), dtype=complex), np.ones((1, 4)))
    assert len(found)
    assert np.allclose(found.sum(axis=1), 0.0, atol=1e-2)
