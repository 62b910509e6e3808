"""Coloured noise: what is estimated of it, and how much that may be trusted, against dense matrices and brute force."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.linalg import toeplitz
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.compression import candidate_columns, compress, white_levels
from casadi_engine.discrepancy.freedom import freedom_of
from casadi_engine.discrepancy.noise_choice import choose_noise, innovation_p
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel, estimated_noise
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.score import score, upper_tail
from casadi_engine.discrepancy.screening import _cannot_tell as cannot_tell
from casadi_engine.discrepancy.screening import screen
from casadi_engine.errors import EstimationError


def coloured(seed, count, phi, sigma=1.0):
    rng = np.random.default_rng(seed)
    return sigma * lfilter([1.0], [1.0, -phi], rng.standard_normal(count + 500))[500:]


@pytest.fixture(scope="module")
def setting(shaft):
    """Null model, candidates and columns; the residuals are replaced by what a test needs."""
    null = shaft.null(shaft.data(n=300, seed=5))
    candidates = shaft.candidates(shaft.model)[:10]
    columns = {r.name: candidate_columns(r, candidates) for r in null.records}
    return null, candidates, columns


def slow(null, with_residual, phi, seed, sigma):
    record = null.records[0]
    e = {o: coloured(seed + k, len(v), phi, sigma[o]) for k, (o, v) in enumerate(record.residual.items())}
    return with_residual(null, {record.name: e})


def test_colour_beside_columns_is_that_of_the_restricted_likelihood(shaft, with_residual):
    """One autoregression beside six slow columns, against the dense likelihood's optimum; what is left is whiter."""
    null = shaft.null(shaft.data(n=300, seed=5))
    record, phi = null.records[0], 0.9
    t = np.linspace(0, 1, 300)
    slopes = np.cos(np.pi * np.arange(6) * t[:, None])
    errors, plain = [], []
    for seed in range(3, 7):
        e = coloured(seed, 300, phi)
        still = {
            o: e if o == "omega" else np.zeros(300) + 1e-3 * coloured(99, 300, 0.0) for o in record.outputs
        }
        explained = {record.name: {o: slopes * (o == "omega") for o in record.outputs}}
        made = estimated_noise(with_residual(null, {record.name: still}), explained=explained, colour=True)
        found = made.colour[record.name, "omega"]
        own = np.sum(-found.predictors[-1][1:])  # its power at frequency zero

        def likelihood(a, e=e):
            v = toeplitz(a ** np.arange(300)) / (1 - a**2)
            white = np.linalg.inv(np.linalg.cholesky(v))
            x, y = white @ slopes, white @ e
            q, r = np.linalg.qr(x)
            rest = y - q @ (q.T @ y)
            return 294 * np.log(rest @ rest) + np.linalg.slogdet(v)[1] + 2 * np.log(np.abs(np.diag(r))).sum()

        best = optimize.minimize_scalar(likelihood, bounds=(0.3, 0.999), method="bounded").x
        if found.order == 1:
            errors.append(own - best)
            rest = e - slopes @ np.linalg.lstsq(slopes, e, rcond=None)[0]
            plain.append(rest[1:] @ rest[:-1] / (rest[:-1] @ rest[:-1]) - best)
    assert len(errors) >= 3
    assert np.abs(errors).max() < 0.01
    assert np.mean(plain) < -0.04  # what fitting the remainder alone gives


def test_degrees_of_freedom_are_those_of_the_variance_of_the_estimate(setting, shaft):
    """Score variances move with the coefficient as dense matrices say."""
    null, _, columns = setting
    phi, step = 0.9, 1e-5
    record = null.records[0]
    sigma = {"omega": shaft.sigma["omega"], "omega_load": 1e4}  # as good as not measured

    def model(a, covariance):
        colour = Colour((np.ones(1), np.array([1.0, -a])), np.array([1 / (1 - a**2), 1.0]), covariance)
        return NoiseModel(sigma, {(record.name, "omega"): colour}, {}, "estimated", {"omega": 1e12})

    found = freedom_of(null, columns, model(phi, np.array([[4e-4]])))
    outputs = record.outputs
    s = np.concatenate([record.slopes[o] for o in outputs])
    c = np.concatenate([columns[record.name][o] for o in outputs])

    def variances(a):
        """Of the estimated amplitudes: (s'M s)^-1."""
        blocks = [
            sigma[o] ** 2 * (toeplitz(a ** np.arange(300)) / (1 - a**2) if o == "omega" else np.eye(300))
            for o in outputs
        ]
        white = [np.linalg.inv(np.linalg.cholesky(b)) for b in blocks]
        st = np.concatenate([w @ s[300 * k : 300 * (k + 1)] for k, w in enumerate(white)])
        ct = np.concatenate([w @ c[300 * k : 300 * (k + 1)] for k, w in enumerate(white)])
        q = np.linalg.qr(st / np.linalg.norm(st, axis=0))[0]
        rest = ct - q @ (q.T @ ct)
        return 1 / (rest**2).sum(axis=0)

    slope = (np.log(variances(phi + step)) - np.log(variances(phi - step))) / (2 * step)
    wanted = 2 / (slope**2 * 4e-4)
    assert found == pytest.approx(wanted, rel=1e-4)
    assert found.min() < 0.2 * found.max()  # slow candidates are known least
    assert np.isinf(freedom_of(null, columns, NoiseModel(shaft.sigma))).all()


def test_white_levels_and_scores_are_those_of_students_t(setting, shaft, with_residual):
    null, candidates, columns = setting
    record = null.records[0]
    drawn, spread = [], []
    rng = np.random.default_rng(3)
    rough = NoiseModel({"omega": 1.0, "omega_load": 7.0})
    for _ in range(120):
        e = {o: shaft.sigma[o] * rng.standard_normal(300) for o in record.outputs}
        moved = with_residual(null, {record.name: e})
        sigma, freedom = white_levels(compress(moved, candidates, rough, columns=columns))
        made = compress(moved, candidates, NoiseModel(sigma, {}, {}, "estimated", freedom), columns=columns)
        drawn.append(score(made).p_value[1])
        spread.append([(sigma[o] / shaft.sigma[o]) ** 2 for o in record.outputs])
    assert sum(freedom.values()) == pytest.approx(600 - 8 - 10 + 0, abs=1e-6)
    assert np.mean(spread, axis=0) == pytest.approx(1, abs=4 * np.sqrt(2 / 290 / 120))
    assert stats.kstest(drawn, "uniform").pvalue > 1e-3


def test_another_level_of_white_noise_only_scales(setting, shaft):
    null, candidates, columns = setting
    rough = compress(null, candidates, NoiseModel({"omega": 1.0, "omega_load": 2.0}), columns=columns)
    noise = NoiseModel(shaft.sigma, {}, {}, "estimated", {"omega": 50.0, "omega_load": 80.0})
    one, other = score(rough.relevelled(noise)), score(compress(null, candidates, noise, columns=columns))
    assert one.z == pytest.approx(other.z, rel=1e-9, abs=1e-12)
    assert one.p_value == pytest.approx(other.p_value, rel=1e-9)
    assert one.freedom == pytest.approx(np.full(10, 50.0))


def test_tails_are_normal_where_the_noise_is_known():
    z = np.array([0.5, 3.0])
    assert upper_tail(z, None) == pytest.approx(stats.norm.sf(z))
    assert upper_tail(z, np.array([np.inf, 5.0])) == pytest.approx([stats.norm.sf(0.5), stats.t.sf(3.0, 5)])


@pytest.fixture(scope="module")
def inertia():
    """seed, friction, phi, count -> the fit of one inertia without friction."""
    model = ce.one_inertia()
    made = {}

    def fit(seed, friction, phi, count=400, noise="estimate"):
        key = (seed, friction, phi, count, noise)
        if key not in made:
            t = np.arange(count) * 0.01
            torque = 10 * np.sin(1.5 * t) + 6 * np.sin(4.1 * t)
            exp = ce.Experiment.from_arrays("run", time=t, units={"T": "N m"}, T=torque)
            lossy = model
            if friction:
                lossy = model.with_effect(
                    ce.effects.CoulombFriction(), at="engine", values={"torque": friction}
                )
            omega = ce.simulate(lossy, exp, initial={"omega_eng": 0.0})["omega"].values
            omega = omega + coloured(seed, count, phi, 0.05 * np.sqrt(1 - phi**2))
            units = {"T": "N m", "omega": "rad/s"}
            data = ce.Experiment.from_arrays("run", time=t, units=units, T=torque, omega=omega)
            made[key] = ce.estimate(model, data, noise=ce.Noise(omega=noise), progress=False)
        return made[key]

    return fit


@pytest.mark.parametrize("draws", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_coloured_noise_is_no_effect(inertia, draws):
    """Short records, in four of ten of which the colour of the remainder alone raised an alarm at 1 %."""
    made = [screen(inertia(seed, 0, 0.9)) for seed in range(draws)]
    assert all(one.noise.colour for one in made)
    assert sum(one.alarm for one in made) <= draws // 8
    assert all(np.median(one.scores.freedom) < 40 for one in made)


def test_a_friction_in_coloured_noise_is_found(inertia):
    screened = screen(inertia(1, 0.5, 0.9, 1000))
    assert screened.noise.colour
    assert "friction" in screened.candidates[screened.significant[0]].effect
    assert screened.alarm


@pytest.mark.parametrize("draws", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_white_noise_stays_white(inertia, draws):
    made = [screen(inertia(seed, 0, 0.0)) for seed in range(draws)]
    assert not any(one.noise.colour for one in made)
    assert not any(one.alarm for one in made)
    assert made[0].scores.freedom.min() > 250


@pytest.mark.slow
def test_a_friction_in_white_noise_is_not_taken_for_colour(inertia):
    screened = screen(inertia(2, 0.3, 0.0, 1000))
    assert not screened.noise.colour
    assert screened.noise.sigma["omega"] == pytest.approx(0.05, rel=0.1)
    assert "friction" in screened.candidates[screened.significant[0]].effect


def test_the_innovations_of_coloured_noise_are_white(inertia):
    null = null_model(inertia(0, 0, 0.9))
    record = null.records[0]
    colour = Colour((np.ones(1), np.array([1.0, -0.9])), np.array([1 / 0.19, 1.0]))
    noise = NoiseModel({"omega": 0.05 * np.sqrt(0.19)}, {("run", "omega"): colour})
    e, slopes = record.residual["omega"], record.slopes["omega"]
    assert innovation_p(record, "omega", e, slopes, noise) > 1e-3
    assert innovation_p(record, "omega", e, slopes, NoiseModel({"omega": 0.05})) < 1e-10


def test_a_coloured_residual_larger_than_the_stated_noise_is_an_alarm(inertia):
    stated = screen(inertia(3, 0, 0.9, noise=0.02))
    assert stated.choice.larger == (("run", "omega"),)
    assert stated.choice.stated.sigma["omega"] == 0.02
    assert "run/omega/whiteness" in stated.leftover.alarms
    right = screen(inertia(3, 0, 0.9, noise=0.05))
    assert right.choice.larger == ()
    assert right.choice.stated is None


@pytest.mark.parametrize("colour", ["red", 1, None, 0.5])
def test_a_colour_that_is_none_is_refused(inertia, colour):
    with pytest.raises(EstimationError) as caught:
        screen(inertia(0, 0, 0.9), colour=colour)
    assert str(caught.value) == (
        f'colour is not acceptable; seen: {colour!r}; allowed: True, False or "auto"; do: leave it out: "auto" '
        "counts with an autoregression where the residual is not white"
    )


@pytest.mark.parametrize("scatter", ["all", 3, ["cylinder_9"]])
def test_cylinders_that_are_none_are_refused(inertia, scatter):
    with pytest.raises(EstimationError) as caught:
        screen(inertia(0, 0, 0.9), scatter=scatter)
    assert str(caught.value) == (
        f'scatter is not acceptable; seen: {scatter!r}; allowed: "assumed", None, or a sequence of cylinder ports '
        '(the model has none); do: leave it out: "assumed" takes the cylinders whose pressure was assumed'
    )


def test_scatter_may_be_none(inertia):
    assert screen(inertia(0, 0, 0.0), scatter=None).choice.scatter == ()


def test_choosing_needs_no_second_compression_of_white_noise(inertia):
    fit = inertia(0, 0, 0.0)
    null = null_model(fit)
    choice = choose_noise(null, (), {"run": {"omega": np.zeros((400, 0))}}, fit.noise, data=fit.data)
    assert choice.compressed is not None
    assert choice.compressed.sigma == dict(choice.noise.sigma)


def test_a_record_too_short_for_its_noise_says_so(inertia):
    long = screen(inertia(1, 0.5, 0.9, 1000))
    assert long.choice.messages == (
        "the residual is coloured: the score tests count with an autoregression of the noise",
    )
    count = len(long.candidates)
    few = replace(long.scores, freedom=np.where(np.arange(count) < 0.6 * count, 3.0, 9.0))
    (said,) = cannot_tell(few)
    assert said.startswith("strongly autocorrelated noise: few effective samples. The scores of ")
    assert said.endswith(
        "candidates have fewer than 5 degrees of freedom, so that these effects were not found says little; record for "
        "longer"
    )
    assert cannot_tell(replace(few, freedom=None)) == ()
