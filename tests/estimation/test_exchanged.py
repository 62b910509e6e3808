"""Parameters that may be exchanged, on models whose twins are known in closed form."""

from itertools import pairwise

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation import exchanged
from casadi_engine.estimation.record import RecordTerm

TIME = np.linspace(0, 8, 33)
SIGMA = 0.02


def chain(unit="1/s"):
    """A -> B -> C, of which B is measured: with A at the start free, the rates may be exchanged; the second one has
    this unit."""
    b = ce.Blueprint("chain")
    k1 = b.parameter("k1", 1.0, unit="1/s", min=0.01, max=50)
    k2 = b.parameter("k2", 0.4, unit=unit, min=0.01, max=50)
    amount, made = b.state("A"), b.state("B")
    b.ode("A", -k1 * amount)
    b.ode("B", k1 * amount - k2 * made)
    b.output("y", made)
    return b.model()


def measured(seed=0):
    """From A = 1: the closed form, with noise."""
    y = (np.exp(-0.4 * TIME) - np.exp(-TIME)) / 0.6
    noise = SIGMA * np.random.default_rng(seed).standard_normal(len(TIME))
    return ce.Experiment.from_arrays("r", time=TIME, units={"y": "1"}, y=y + noise)


def fitted(model, data, parameters=None, **options):
    options = {"noise": ce.Noise(y=SIGMA), "progress": False, "initial": {"B": 0.0}, **options}
    return ce.estimate(model, data, parameters=parameters, **options)


@pytest.mark.parametrize("start", [(1.0, 0.4), (0.05, 10.0)])
def test_rates_of_a_chain_lose_their_errors_whichever_optimum_is_met(start):
    pars = chain().parameters()
    for name, value in zip(("k1", "k2"), start, strict=True):
        pars[name].set(value)
    fit = fitted(chain(), measured(), pars)
    assert sorted(fit.values.values()) == pytest.approx([0.4, 1.0], rel=0.2)
    assert fit.doubted == ("k1", "k2")
    (said,) = fit.messages
    assert said.startswith("the data are explained as well with k1 and k2 exchanged (chi-squared ")
    assert said.endswith(
        'by bounds, or by pars.constrain("k1 - k2", min=0) or max=0, or call ce.posterior(fit)'
    )


def test_where_the_first_amount_is_known_there_is_one_optimum():
    fit = fitted(chain(), measured(), initial={"A": 1.0, "B": 0.0})
    assert not any("exchanged" in text for text in fit.messages)
    assert fit.stderr["k1"]
    assert fit.stderr["k2"]


@pytest.mark.parametrize("by", ["bounds", "constraint"])
def test_what_tells_them_apart_gives_the_errors_back(by):
    pars = chain().parameters()
    if by == "bounds":
        pars["k1"].set(1.0, min=0.65)
        pars["k2"].set(0.4, max=0.65)
    else:
        pars.constrain("k1 - k2", min=0.0)
    fit = fitted(chain(), measured(), pars)
    assert not any("exchanged" in text for text in fit.messages)
    assert fit.stderr["k1"] or fit.estimates["k1"].interval


def test_other_units_are_not_exchanged():
    fit = fitted(chain("m/s"), measured())
    assert not any("exchanged" in text for text in fit.messages)


def unstated():
    """The same with a time constant and a rate of which neither states its unit."""
    b = ce.Blueprint("flip")
    lag, rate = b.parameter("k1", 2.0, min=0.1, max=40), b.parameter("k2", 0.12, min=0.006, max=2.4)
    g = b.parameter("g", 1.0, min=1e-3, max=1e3)
    gut, blood = b.state("gut"), b.state("blood")
    b.ode("gut", -gut / lag)
    b.ode("blood", gut / lag - rate * blood)
    b.output("y", casadi.log10(g * blood + 1e-9))
    return b.model()


def flip(units, *, bends=False):
    """Absorption and elimination, as a time constant or a rate in these units, seen by the logarithm of an amount or,
    where they bend, by the amount: what is slow may be either."""
    b = ce.Blueprint("flip", time_unit="s")
    if units == ("-", "-"):  # the first one is meant as a time constant
        return unstated()
    sizes = [{"s": 2.0, "1/s": 0.5, "1/min": 30.0, "-": 0.5}[unit] for unit in units]
    symbols = [
        b.parameter(name, size, unit=unit, min=size / 20, max=20 * size)
        for name, unit, size in zip(("k1", "k2"), units, (sizes[0], 0.24 * sizes[1]), strict=True)
    ]
    k1, k2 = (
        1 / own if unit == "s" else own / 60 if unit == "1/min" else own
        for own, unit in zip(symbols, units, strict=True)
    )
    g = b.parameter("g", 1.0, min=1e-3, max=1e3)
    gut, blood = b.state("gut"), b.state("blood")
    b.ode("gut", -k1 * gut)
    b.ode("blood", k1 * gut - k2 * blood / (1 + (1e-5 * blood if bends else 0)))
    b.output("y", g * blood if bends else casadi.log10(g * blood + 1e-9))
    return b.model()


@pytest.mark.parametrize(
    ("units", "bends", "said"),
    [
        (("s", "1/s"), False, "k1 and 1/k2 exchanged"),
        (("1/s", "1/min"), True, "k1 and k2 exchanged"),
        (("1/s", "-"), True, "k1 and k2 exchanged"),
        (("-", "-"), False, "k1 and 1/k2 exchanged"),
    ],
)
def test_a_time_constant_and_a_rate_are_exchanged_too(units, bends, said):
    """8.44 +- 0.07 s for 2 s in 4 of 30 fits, without a word: times and rates had other units, and were no pair."""
    time = np.linspace(0.5, 30, 60)
    amount = 50 / 0.38 * (np.exp(-0.12 * time) - np.exp(-0.5 * time))
    y = amount if bends else np.log10(amount)
    y = y + (1.0 if bends else 0.02) * np.random.default_rng(0).standard_normal(60)
    data = ce.Experiment.from_arrays("r", time=np.append(0.0, time), units={"y": "1"}, y=np.append(np.nan, y))
    start = {"gut": 100.0, "blood": 0.0}
    fit = ce.estimate(flip(units, bends=bends), data, initial=start, progress=False)
    assert any(said in text for text in fit.messages)
    assert fit.stderr.get("k1") is None


def test_a_model_that_is_not_linear():
    """Two springs in a row under a pendulum."""
    b = ce.Blueprint("springs")
    p, q = (
        b.parameter(name, value, unit="1/s2", min=0.1, max=20) for name, value in (("p", 2.0), ("q", 5.0))
    )
    x, v = b.state("x"), b.state("v", unit="1/s")
    b.ode("x", v)
    b.ode("v", -p * q / (p + q) * casadi.sin(x) - 0.1 * (p + q) * v)
    b.output("y", x)
    t = np.linspace(0, 6, 61)
    y = solve_ivp(
        lambda _, s: [s[1], -10 / 7 * np.sin(s[0]) - 0.7 * s[1]], (0, 6), [2.0, 0.0], t_eval=t, rtol=1e-9
    ).y[0]
    data = ce.Experiment.from_arrays(
        "r", time=t, units={"y": "1"}, y=y + 0.01 * np.random.default_rng(0).standard_normal(61)
    )
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=0.01), initial={"x": 2.0, "v": 0.0}, progress=False)
    assert set(fit.doubted) == {"p", "q"}
    assert any("p and q exchanged" in text for text in fit.messages)


def driven(*, fed):
    """u -> A -> B, of which B is measured, u fed with a gain: where that is free the rates may be exchanged."""
    b = ce.Blueprint("driven")
    k1, k2 = (
        b.parameter(name, value, unit="1/s", min=0.01, max=50) for name, value in (("k1", 3), ("k2", 0.3))
    )
    gain = b.parameter("g", 2.0, min=1e-3, max=1e3) if fed else 2.0
    u, amount, made = b.input("u"), b.state("A"), b.state("B")
    b.ode("A", gain * u - k1 * amount)
    b.ode("B", k1 * amount - k2 * made - (0.05 * made**2 if fed == "and bent" else 0.0))
    b.output("y", made)
    return b.model()


@pytest.mark.parametrize("start", [(3.0, 0.3, 2.0), (0.05, 10.0, 1.0)])
def test_another_parameter_may_have_to_follow_an_exchange(start):
    """The exchanged one has the gain of k1 / k2 times the first; twice a step it is met at once."""
    t = np.linspace(0, 10, 81)
    u = np.floor(t / 2) % 2
    y = solve_ivp(
        lambda s, x: [2 * np.interp(s, t, u) - 3 * x[0], 3 * x[0] - 0.3 * x[1]], (0, 10), [0.0, 0.0], t_eval=t,
        rtol=1e-9, atol=1e-10, max_step=0.05,
    ).y[1]  # fmt: skip
    noise = SIGMA * np.random.default_rng(1).standard_normal(81)
    data = ce.Experiment.from_arrays("r", time=t, units={"y": "1", "u": "1"}, u=u, y=y + noise)
    pars = driven(fed="by a gain").parameters()
    for name, value in zip(("k1", "k2", "g"), start, strict=True):
        pars[name].set(value)
    fit = fitted(driven(fed="by a gain"), data, pars, initial={"A": 0.0, "B": 0.0})
    assert set(fit.doubted) == {"k1", "k2", "g"}
    assert any("k1 and k2 exchanged (chi-squared" in text for text in fit.messages)
    told = fitted(driven(fed=None), data, initial={"A": 0.0, "B": 0.0})
    assert not told.doubted
    bent = fitted(driven(fed="and bent"), data, initial={"A": 0.0, "B": 0.0})
    assert not any("exchanged" in text for text in bent.messages)


@pytest.mark.parametrize("start", [(0.6, 0.4, 3.0), (0.2, 1.5, 0.5)])
def test_what_is_divided_by_follows_an_exchange_too(start):
    """A dose that is absorbed and eliminated, seen by its amount over a volume: with the rates exchanged the volume is
    that of their ratio, a fifth or five times as large, and 1/V is what steps are straight in."""
    b = ce.Blueprint("dose")
    ka, ke = (b.parameter(n, v, min=0.01, max=20) for n, v in (("ka", start[0]), ("ke", start[1])))
    volume = b.parameter("V", start[2], min=0.1, max=50)
    gut, blood = b.state("A"), b.state("C")
    b.ode("A", -ka * gut)
    b.ode("C", ka * gut - ke * blood)
    b.output("c", blood / volume)
    t = np.array([0, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24.0])
    c = 10 / 2 * 1.2 / 0.95 * (np.exp(-0.25 * t) - np.exp(-1.2 * t))
    noise = 0.1 * np.random.default_rng(4).standard_normal(len(t))
    data = ce.Experiment.from_arrays("r", time=t, units={"c": "1"}, c=c + noise)
    fit = ce.estimate(b.model(), data, initial={"A": 10.0, "C": 0.0}, progress=False)
    assert set(fit.doubted) == {"ka", "ke", "V"}
    assert any("ka and ke exchanged" in text for text in fit.messages)


def test_two_pairs_are_exchanged_at_once():
    """Two branches in series, each of a resistance and a capacity: which is which is not told."""
    b = ce.Blueprint("battery")
    ohmic = b.parameter("R0", 0.01, unit="ohm", min=1e-4, max=1)
    branches, current = [], b.input("i", unit="A")
    for k, (r, c) in enumerate(((0.01, 1000.0), (0.015, 2000.0)), start=1):
        resistance = b.parameter(f"R{k}", r, unit="ohm", min=1e-4, max=1)
        capacity = b.parameter(f"C{k}", c, unit="F", min=1, max=1e6)
        voltage = b.state(f"V{k}", unit="V")
        b.ode(f"V{k}", current / capacity - voltage / (resistance * capacity))
        branches.append(voltage)
    b.output("u", ohmic * current + branches[0] + branches[1], unit="V")
    t = np.arange(301.0)
    i = 5.0 * (np.floor(t / 60) % 2)

    def rates(s, v):
        at = 5.0 * (np.floor(s / 60) % 2)
        return [at / 1000 - v[0] / 10, at / 2000 - v[1] / 30]

    v = solve_ivp(rates, (0, 300), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-12, max_step=1.0).y
    u = 0.01 * i + v[0] + v[1] + 1e-3 * np.random.default_rng(0).standard_normal(len(t))
    data = ce.Experiment.from_arrays("r", time=t, units={"i": "A", "u": "V"}, hold="zero", i=i, u=u)
    fit = ce.estimate(b.model(), data, noise=ce.Noise(u=1e-3), initial={"V1": 0.0, "V2": 0.0}, progress=False)
    assert set(fit.doubted) == {"R1", "R2", "C1", "C2"}
    assert fit.stderr["R0"]
    assert any("R1 and R2, and C1 and C2 exchanged" in text for text in fit.messages)


def locked_loop(*, known):
    """A phase seen through its cosine: with the other sign of detuning and phase the output is the same."""
    b = ce.Blueprint("loop")
    detuning = b.parameter("detuning", 1.0, unit="rad/s", min=-20, max=20)
    gain = b.parameter("gain", 2.0, unit="rad/s", min=0.1, max=50)
    phase = b.state("phase", unit="rad")
    b.ode("phase", detuning - gain * casadi.sin(phase))
    b.output("x", casadi.cos(phase), unit="1")
    begun = 0.0 if known else 0.4
    time = np.arange(0, 2.01, 0.05)
    truth = solve_ivp(
        lambda _, x: 3.0 - 4.0 * np.sin(x), (0, 2), [begun], t_eval=time, rtol=1e-10, atol=1e-12
    )
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(time))
    data = ce.Experiment.from_arrays("r", time=time, units={"x": "1"}, x=np.cos(truth.y[0]) + noise)
    initial = {"phase": 0.0} if known else None
    return ce.estimate(b.model(), data, noise=ce.Noise(x=0.05), initial=initial, progress=False)


@pytest.mark.parametrize(("known", "names"), [(True, "detuning"), (False, "detuning and of the first phase")])
def test_a_detuning_that_is_seen_through_a_cosine_has_two_signs(known, names):
    fit = locked_loop(known=known)
    assert abs(fit.values["detuning"]) == pytest.approx(3.0, rel=0.2)
    assert fit.estimates["detuning"].stderr is None
    assert any(
        f"explained as well with the other sign of {names} (chi-squared" in text for text in fit.messages
    )


def test_signs_that_bounds_tell_are_not_looked_for():
    fit = fitted(chain(), measured(), initial={"A": 1.0, "B": 0.0})
    assert not any("other sign" in text for text in fit.messages)


def test_gains_of_one_state_change_their_signs_together():
    """A state that is seen by its square, driven by two inputs: neither gain has another sign without the other."""
    b = ce.Blueprint("driven")
    gains = [b.parameter(f"g{k}", start, min=-5, max=5) for k, start in enumerate((1.0, -0.5))]
    x = b.state("x")
    b.ode("x", -x + gains[0] * b.input("u0") + gains[1] * b.input("u1"))
    b.output("y", x**2)
    time, random = np.linspace(0, 6, 61), np.random.default_rng(3)
    drives = np.repeat(random.standard_normal((2, 7)), 10, axis=1)[:, :61]
    right = lambda t, y: -y + drives[:, min(int(t / 0.1 + 1e-9), 60)] @ np.array([1.2, -0.7])  # noqa: E731
    truth, held = [0.5], dict(zip(("u0", "u1"), drives, strict=True))
    for start, end in pairwise(time):
        step = solve_ivp(lambda t, y, s=start: right(s, y), (start, end), truth[-1:], rtol=1e-10, atol=1e-12)
        truth.append(float(step.y[0, -1]))
    y = np.square(truth) + 0.01 * random.standard_normal(61)
    units = dict.fromkeys(("u0", "u1", "y"), "1")
    data = ce.Experiment.from_arrays("r", time=time, units=units, hold="zero", y=y, **held)
    begun = fitted(b.model(), data, noise=ce.Noise(y=0.01), initial={"x": 0.5})
    fit = fitted(b.model(), data, noise=ce.Noise(y=0.01), initial=None, warm=begun)
    assert any("the other sign of g0 and of g1" in text for text in fit.messages)
    assert fit.estimates["g0"].stderr is None


@pytest.mark.parametrize("seen", ["cos", "sin"])
def test_first_samples_of_a_long_record_deny_signs_and_find_none_less(seen, monkeypatch):
    """What they deny is not simulated to its end; what they leave open is."""
    b = ce.Blueprint("loop")
    detuning = b.parameter("detuning", 2.8, unit="rad/s", min=-20, max=20)
    gain = b.parameter("gain", 3.9, unit="rad/s", min=0.1, max=50)
    phase, u = b.state("phase", unit="rad"), b.input("u", unit="rad/s")
    b.ode("phase", detuning * (1 + u / 2) - gain * casadi.sin(phase))
    b.output("x", getattr(casadi, seen)(phase), unit="1")
    time = np.arange(0, 50.001, 0.01)
    truth = solve_ivp(
        lambda t, x: 3.0 * (1 + np.sin(t) / 2) - 4.0 * np.sin(x),
        (0, 50),
        [0.0],
        t_eval=time,
        rtol=1e-10,
        atol=1e-12,
    )
    x = getattr(np, seen)(truth.y[0]) + 0.05 * np.random.default_rng(1).standard_normal(len(time))
    data = ce.Experiment.from_arrays("r", time=time, units={"x": "1", "u": "rad/s"}, x=x, u=np.sin(time))
    worked = []
    settled = exchanged._Exchange.settled

    def noted(self, *arguments):
        cost = settled(self, *arguments)
        worked.append((sum(record.grid.samples for record in self._records), cost))
        return cost

    monkeypatch.setattr(exchanged._Exchange, "settled", noted)
    fit = ce.estimate(b.model(), data, noise=ce.Noise(x=0.05), initial={"phase": 0.0}, progress=False)
    assert any("the other sign of detuning" in text for text in fit.messages) == (seen == "cos")
    assert {samples for samples, _ in worked} == ({1000, 5001} if seen == "cos" else {1000})


def test_the_head_of_a_record_is_its_beginning():
    """Residuals of the first samples, for a linear model, one with a linear core and any other."""
    time = np.arange(0, 40.0, 0.1)
    data = ce.Experiment.from_arrays(
        "r", time=time, units={"y": "1", "u": "1"}, y=np.cos(time), u=np.sin(time)
    )
    for bend in (0.0, 0.1, None):
        b = ce.Blueprint("bent")
        a, x = b.parameter("a", 1.0), b.state("x")
        b.ode("x", -a * x + b.input("u") - (a * x**3 / (1 + x**2) if bend is None else bend * x**3))
        b.output("y", x)
        z = casadi.SX.sym("z")
        whole = RecordTerm(b.model(), data, z, z, length=50, gain=None, method="exact")
        whole.set_sigma(np.ones(1))
        head = whole.head(100, np.ones(1))
        assert head.grid.samples == 100
        at, first = np.array([0.7]), np.array([0.3])
        longer, shorter = (
            exchanged.residual(one, exchanged.response(one, at, first)[0]) for one in (whole, head)
        )
        own = longer.ravel()[whole.observation.where["y"]][:100]
        assert shorter.ravel()[head.observation.where["y"]] == pytest.approx(own, abs=1e-9)
        assert whole.head(400, np.ones(1)) is whole


def swinging(start, **options):
    """x' = -k x + A sin(2 t + phase) of 0.4 and 1.3, by SciPy."""
    b = ce.Blueprint("swing")
    phase = b.parameter("phase", start, unit="rad", min=-10, max=10)
    size = b.parameter("A", 1.0, min=options.pop("least", -10), max=10)
    k = b.parameter("k", 1.0, unit="1/s", min=0)
    x = b.state("x")
    b.ode("x", -k * x + size * casadi.sin(2 * b.time + phase))
    b.output("y", x)
    y = solve_ivp(lambda s, z: -0.7 * z + 1.3 * np.sin(2 * s + 0.4), (0, 8), [0.0], t_eval=TIME, rtol=1e-9).y[
        0
    ]
    y = y + SIGMA * np.random.default_rng(0).standard_normal(len(TIME))
    record = ce.Experiment.from_arrays("r", time=TIME, units={"y": "1"}, y=y)
    return fitted(b.model(), record, initial={"x": 0.0})


def test_half_a_turn_of_a_phase_is_the_other_sign_of_its_amplitude():
    fit = swinging(0.5)
    assert fit.stderr["phase"] is None
    assert any("explained as well" in words for words in fit.messages)
    told = swinging(0.5, least=0)
    assert abs(told.values["phase"] - 0.4) < 4 * told.stderr["phase"]


def test_a_whole_turn_further_is_another_phase():
    fit = swinging(6.0, least=0)
    assert fit.values["phase"] == pytest.approx(0.4 + 2 * np.pi, abs=0.1)
    assert fit.stderr["phase"] is None


@pytest.mark.parametrize(("start", "known"), [(2.0, True), (3.5, False)])
def test_a_frequency_above_half_the_rate_of_the_samples_has_another_one_below(start, known):
    """Samples once a second of a swing of 2.5 rad/s: 2 pi - 2.5 goes through all of them."""
    b = ce.Blueprint("oscillator")
    w, z = b.parameter("w", start, unit="rad/s", min=0.1, max=50), b.parameter("z", 0.1, unit="1/s", min=0)
    x, v = b.state("x"), b.state("v", unit="1/s")
    b.ode("x", v)
    b.ode("v", -(w**2 + z**2) * x - 2 * z * v)
    b.output("y", x)
    time = np.arange(25.0)
    y = np.exp(-0.05 * time) * np.cos(2.5 * time) + SIGMA * np.random.default_rng(1).standard_normal(25)
    record = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
    fit = fitted(b.model(), record, initial=None)
    assert fit.values["w"] == pytest.approx(2.5 if known else 2 * np.pi - 2.5, abs=0.02)
    assert (fit.stderr["w"] is not None) == known


def fall(seed):
    """A parachute: k and the wind are seen through one final speed, along a valley that bends; by SciPy."""
    time = np.arange(0, 15, 0.5)

    def ode(t, x):
        through = x[1] - 1.0
        return [-x[1], 9.81 - 0.3 / 80 * through * abs(through)]

    height = solve_ivp(ode, (0, 15), [1000.0, 0.0], t_eval=time, rtol=1e-9, atol=1e-9).y[0]
    noisy = height + 2 * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays("fall", time=time, units={"h": "m"}, h=noisy)


def parachute():
    b = ce.Blueprint("parachute")
    drag = b.parameter("k", 0.3, unit="kg/m", min=0.01, max=3.0)
    wind = b.parameter("w", 1.0, unit="m/s", min=-10, max=10)
    height, speed = b.state("z", unit="m"), b.state("v", unit="m/s")
    b.ode("z", -speed)
    b.ode("v", 9.81 - drag / 80 * (speed - wind) * casadi.fabs(speed - wind))
    b.output("h", height, unit="m")
    return b.model()


@pytest.mark.parametrize("seed", [5, 12, 14])
def test_a_place_along_a_valley_that_bends_is_no_other_optimum(seed):
    """The chord between the two leaves the valley, so that the other sign of the wind or of the first speed took all
    errors away."""
    fit = ce.estimate(parachute(), fall(seed), progress=False)
    assert not any("the other sign" in text for text in fit.messages)
    assert all(fit.estimates[name].stderr or fit.estimates[name].interval for name in ("k", "w"))


def test_no_other_place_is_compared_where_one_run_does_not_follow(monkeypatch):
    """What falls over is followed from interval to interval; one run from its first states runs away, and what runs
    away less was said to be a better optimum, by a billion of chi-squared."""
    real = exchanged._Exchange.cost

    def cost(self, v):
        return real(self, v) + (1e9 if self._limit == 0.0 else 0.0)  # the run at the optimum itself

    assert any("exchanged" in text for text in fitted(chain(), measured()).messages)
    monkeypatch.setattr(exchanged._Exchange, "cost", cost)
    assert not any("exchanged" in text for text in fitted(chain(), measured()).messages)


def two_lags():
    """Two lags whose shares of an input sum to one; their units let the rates alone be exchanged."""
    b = ce.Blueprint("two_lags")
    u = b.input("u", unit="V")
    k1, k2 = (
        b.parameter(name, size, unit="1/s", min=0.01, max=50) for name, size in (("k1", 1.0), ("k2", 8.0))
    )
    a, c = b.parameter("a", 0.4, unit="A", min=0, max=1), b.parameter("c", 0.6, unit="m", min=0, max=1)
    x, y = b.state("x", unit="V"), b.state("y", unit="V")
    b.ode("x", k1 * (u - x))
    b.ode("y", k2 * (u - y))
    b.output("shown", a * x + c * y, unit="V")
    return b.model()


def test_what_is_exchanged_is_held_by_an_equation():
    """Two sites of a molecule, whose shares sum to one: 9 of 30 fits told nothing of an exact exchange, as the steps to
    it left the equation."""
    rng, t = np.random.default_rng(0), 0.05 * np.arange(400)
    u, x, k = np.repeat(rng.uniform(-1, 1, 20), 20), np.zeros((400, 2)), np.array([1.2, 7.0])
    for i in range(399):
        x[i + 1] = u[i] + (x[i] - u[i]) * np.exp(-0.05 * k)
    data = ce.Experiment.from_arrays(
        "r", time=t, units={"u": "V", "shown": "V"}, hold={"u": "zero"}, u=u,
        shown=x @ [0.35, 0.65] + 0.02 * rng.standard_normal(400),
    )  # fmt: skip
    parameters = two_lags().parameters()
    parameters.constrain("a + c", 1, 1)
    fit = ce.estimate(
        two_lags(),
        data,
        parameters=parameters,
        noise=ce.Noise(shown=0.02),
        initial={"x": 0.0, "y": 0.0},
        progress=False,
    )
    assert {"k1", "k2", "a", "c"} <= set(fit.doubted)
    assert (
        "the data are explained as well with k1 and k2 exchanged (chi-squared at most 0 higher)"
        in " ".join(fit.messages)
    )
