"""White noise that is not of one size, or that two sensors share: errors against the scatter that theory gives."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation import varied_noise as varied

TIME = np.linspace(0, 6, 150)


def decay(*outputs):
    """x' = -k x from 5, k = 0.5, seen by these sensors: x, and a gain G = 1 times it."""
    b = ce.Blueprint("decay")
    k, x = b.parameter("k", 0.3, min=0.01, max=20), b.state("x")
    b.ode("x", -k * x)
    b.output("y", x)
    if "z" in outputs:
        b.output("z", b.parameter("G", 1.2, min=0.01, max=50) * x)
    return b.model()


TRUE = 5 * np.exp(-0.5 * TIME)


def fitted(**channels):
    units = dict.fromkeys(channels, "1")
    data = ce.Experiment.from_arrays("r", time=TIME, units=units, **channels)
    return ce.estimate(decay(*channels), data, progress=False)


def sandwich(*sizes, cross=None):
    """Standard errors of [k, x(0)] or [k, G, x(0)] of least squares by the slopes at the truth: noise of these sizes of
    each sensor, over the mean square of which they are weighted; cross : covariance of two sensors."""
    by_k, by_x = -TIME * TRUE, TRUE / 5
    rows = [np.stack([by_k, 0 * TIME, by_x], axis=1), np.stack([by_k, TRUE, by_x], axis=1)]
    rows = [rows[0][:, [0, 2]]] if len(sizes) == 1 else rows
    powers = [np.mean(np.square(size)) for size in sizes]
    bread = np.linalg.inv(sum(r.T @ r / p for r, p in zip(rows, powers, strict=True)))
    filling = sum(
        (r * np.square(size)[:, None]).T @ r / p**2 for r, size, p in zip(rows, sizes, powers, strict=True)
    )
    if cross is not None:
        both = (rows[0] * np.asarray(cross)[:, None]).T @ rows[1] / (powers[0] * powers[1])
        filling = filling + both + both.T
    return np.sqrt(np.diag(bread @ filling @ bread))


@pytest.mark.parametrize("kind", ["share", "quarter"])
def test_errors_are_those_of_noise_that_is_not_of_one_size(kind):
    size = 0.1 * TRUE + 0.01 if kind == "share" else np.where(TIME < 1.5, 0.3, 0.03)
    wanted, found, told = sandwich(size), [], 0
    for seed in range(12):
        fit = fitted(y=TRUE + size * np.random.default_rng(seed).standard_normal(len(TIME)))
        told += any("the size of the residual of r/y" in text for text in fit.messages)
        found.append([fit.stderr["k"], fit.initial["r"]["x"].stderr])
        assert fit.own_noise["r/x"] > 1.3
    assert told >= 11  # once neighbours seem to go together, of the few that are loud
    assert np.mean(found, axis=0) == pytest.approx(wanted, rel=0.2)


@pytest.mark.parametrize("sign", [1, -1])
def test_errors_are_those_of_noise_that_two_sensors_share(sign):
    """What both show is told worse where they go together, their ratio where they go against each other."""
    size, wanted = np.full(len(TIME), np.hypot(0.1, 0.02)), None
    wanted = sandwich(size, size, cross=np.full(len(TIME), sign * 0.01))
    random = np.random.default_rng(2)
    common, own = 0.1 * random.standard_normal(len(TIME)), 0.02 * random.standard_normal((2, len(TIME)))
    fit = fitted(y=TRUE + common + own[0], z=TRUE + sign * common + own[1])
    assert any("the residuals of r/y and r/z are correlated" in text for text in fit.messages)
    errors = np.array([fit.stderr["k"], fit.stderr["G"], fit.initial["r"]["x"].stderr])
    assert (errors > 0.85 * wanted).all()  # none becomes smaller than that of white noise
    larger = wanted > sandwich(size, size)
    assert errors[larger] == pytest.approx(wanted[larger], rel=0.2)


def test_noise_of_one_size_is_hardly_ever_called_otherwise():
    """Twice three in two thousand, for each output; two sensors go together as rarely."""
    told = 0
    for seed in range(60):
        noise = 0.1 * np.random.default_rng(seed).standard_normal((2, len(TIME)))
        fit = fitted(y=TRUE + noise[0], z=TRUE + noise[1])
        told += any("the size of" in text or "are correlated" in text for text in fit.messages)
    assert told <= 2


def test_the_test_of_sizes_has_its_rate():
    """Of the squares of normal noise against a course and its square."""
    random = np.random.default_rng(0)
    found = [varied._goes_with(random.standard_normal(len(TIME)), TRUE) for _ in range(4000)]
    assert np.mean(np.array(found) < 0.01) == pytest.approx(0.01, abs=0.006)
    assert varied._goes_with(np.ones(20), np.arange(20.0)) == 1.0
    assert varied._goes_with(random.standard_normal(20), np.ones(20)) == 1.0


def test_heavy_tails_are_seldom_called_another_size():
    """Of Student's noise with three degrees of freedom: 22 in a hundred by the scatter that normal noise has."""
    random = np.random.default_rng(0)
    found = [varied._goes_with(random.standard_t(3, len(TIME)), TRUE) < 2.5e-3 for _ in range(1000)]
    assert np.mean(found) < 0.08


def test_where_noise_is_coloured_or_robust_that_counts_alone():
    size = 0.1 * TRUE + 0.01
    data = ce.Experiment.from_arrays(
        "r", time=TIME, units={"y": "1"}, y=TRUE + size * np.random.default_rng(0).standard_normal(len(TIME))
    )
    fit = ce.estimate(decay(), data, loss="huber", progress=False)
    assert not any("the size of" in text for text in fit.messages)


def test_errors_count_with_a_sensors_steps():
    """Rounding comes back with a slow motion: 85 of 100 intervals hold the level at which it settles, at steps of eight
    times the noise; those of white noise, 62."""
    b = ce.Blueprint("cooling")
    k, level = b.parameter("k", 0.8, min=0.01, max=20), b.parameter("Ta", 15.0, min=0, max=50)
    x = b.state("T")
    b.ode("T", -k * (x - level))
    b.output("y", x)
    time, held, plain = np.linspace(0, 8, 100), 0, 0
    for seed in range(60):
        random = np.random.default_rng(seed)
        off, noise = random.uniform(0, 0.4), 0.05 * random.standard_normal(100)
        y = 0.4 * np.round((20 + 3 * np.exp(-0.5 * time) + off + noise) / 0.4) - off
        data = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
        fit = ce.estimate(b.model(), data, progress=False)
        one = fit.estimates["Ta"]
        assert any(
            "r/y is read in steps of 0.4: rounding is most of its noise" in text for text in fit.messages
        )
        held += abs(one.value - 20) < 1.985 * one.stderr
        plain += abs(one.value - 20) < 1.985 * one.stderr / fit.own_noise["Ta"]
    assert held >= 50
    assert plain <= 40


def test_steps_that_noise_hides_are_none():
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(TIME))
    y = 0.06 * np.round((TRUE + noise) / 0.06)
    assert varied.steps_of(y, noise) == 0.0
    assert varied.steps_of(TRUE, noise) == 0.0
    assert varied.steps_of(0.3 * np.round((TRUE + noise) / 0.3), noise) == pytest.approx(0.3)
    fit = fitted(y=y)
    assert not any("read in steps" in text for text in fit.messages)


def chain():
    """A <-> B -> C from A alone; A and C are seen at 25 times, most of them late."""
    b = ce.Blueprint("isomer")
    names = {"k1": 0.3, "k2": 0.3, "km": 0.1}
    k1, k2, km = (b.parameter(name, value, unit="1/s", min=1e-3, max=20) for name, value in names.items())
    a, i, c = (b.state(name, unit="mmol/L") for name in "ABC")
    b.ode("A", -k1 * a + km * i)
    b.ode("B", k1 * a - km * i - k2 * i)
    b.ode("C", k2 * i)
    b.output("a", a, unit="mmol/L")
    b.output("c", c, unit="mmol/L")
    return b.model()


@pytest.fixture(scope="module")
def concentrations():
    rates = np.array([[-0.9, 0.3, 0], [0.9, -0.55, 0], [0, 0.25, 0]])
    times = np.concatenate([[0], np.sort(np.random.default_rng(1).uniform(0.1, 14, 24))])
    values, vectors = np.linalg.eig(rates)
    start = np.linalg.solve(vectors, [10.0, 0, 0])
    return times, np.real((vectors * start) @ np.exp(np.outer(values, times)))


@pytest.mark.parametrize("share", [True, False])
def test_errors_of_few_samples_count_with_noise_that_is_a_share_of_what_is_shown(concentrations, share):
    """No test of a record told that noise is not of one size: 95 % held 68 % of the truth, without a word."""
    times, shown = concentrations
    inside, larger = [], []
    for seed in range(10 if share else 4):
        e = np.random.default_rng(1000 + seed).standard_normal((2, len(times)))
        a, c = shown[[0, 2]] * np.exp(0.05 * e) if share else shown[[0, 2]] + np.array([[0.1], [0.2]]) * e
        units = {"a": "mmol/L", "c": "mmol/L"}
        data = ce.Experiment.from_arrays("vial", time=times, units=units, a=a, c=c)
        fit = ce.estimate(chain(), data, initial={"B": 0.0, "C": 0.0}, progress=False)
        larger.append(fit.own_noise.get("k1", 1.0))
        for name, truth in {"k1": 0.9, "k2": 0.25, "km": 0.3}.items():
            own = fit.estimates[name]
            inside.append(abs(own.value - truth) < 2 * (own.stderr or own.quadratic))
    assert bool(np.median(larger) > 1.3) is share
    assert np.mean(inside) > 0.85


def test_outputs_of_a_record_tell_together_whether_noise_is_of_one_size():
    assert varied._chances({}) == {}
    alone = varied._chances({"y": 0.0})["y"]
    assert 0.3 < alone < 0.5
    both = varied._chances({"y": 0.0, "z": 6.0})
    assert both["z"] > both["y"] > alone
    assert varied._chances({"y": -30.0})["y"] < 1e-6
    assert varied._chances({"y": 30.0})["y"] > 1 - 1e-6


def test_noise_that_is_a_share_has_a_likelihood_of_its_own():
    rng, shown = np.random.default_rng(4), np.geomspace(0.1, 10, 40)
    assert varied.as_a_share(0.05 * shown * rng.standard_normal(40), shown) > 10
    assert varied.as_a_share(0.05 * rng.standard_normal(40), shown) < -10
    assert varied.as_a_share(np.zeros(40), shown) == -np.inf
    assert varied.as_a_share(rng.standard_normal(40), np.zeros(40)) == -np.inf
