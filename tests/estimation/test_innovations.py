"""Fits of predictors against an independent likelihood, written with SciPy alone, and under missing samples."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from tests.quick import few

H, Q, SIGMA = 5e-3, (1.0, 0.6), (0.05, 0.08)
NAMES = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
TRUTH = {"J_eng": 0.4, "J_load": 0.18, "K_el": 120.0, "C_el": 0.2, "C_eng": 0.15}
STATES = ("omega_eng", "omega_load", "twist")


def matrices(p):
    je, jl, k, c, d = (p[name] for name in NAMES)
    a = np.array([[-(c + d) / je, c / je, k / je], [c / jl, -c / jl, -k / jl], [-1.0, 1.0, 0.0]])
    return a, np.array([[1 / je, 0.0], [0.0, -1 / jl], [0.0, 0.0]])


def discrete(p, q=(0.0, 0.0), h=H):
    """F, response to held and rising drives, noise of a step."""
    a, b = matrices(p)
    big = np.zeros((7, 7))
    big[:3, :3], big[:3, 3:5], big[3:5, 5:] = a * h, b * h, np.eye(2)
    big = expm(big)
    loan = np.zeros((6, 6))
    loan[:3, :3], loan[:3, 3:], loan[3:, 3:] = -a * h, np.diag([q[0] ** 2, q[1] ** 2, 0.0]) * h, a.T * h
    loan = expm(loan)
    return big[:3, :3], big[:3, 3:5], big[:3, 5:], loan[3:, 3:].T @ loan[:3, 3:]


def record(seed=0, *, n=1500, two=False, missing=0.0, stride=1, name="shaken"):
    rng = np.random.default_rng(seed)
    t = np.arange(n) * H
    tones = 2 * np.pi * np.array([0.5, 1.3, 2.9, 4.1, 5.3, 7.7])[:, None]
    phase = np.random.default_rng(99).uniform(0, 6, (2, 6, 1))
    u = np.array([20 + 8 * np.sin(tones * t + phase[0]).sum(0), 15 + 4 * np.sin(tones * t + phase[1]).sum(0)])
    f, held, ramp, q = discrete(TRUTH, Q)
    values, vectors = np.linalg.eigh((q + q.T) / 2)
    w = (vectors * np.sqrt(np.maximum(values, 0))) @ rng.standard_normal((3, n))
    x = np.empty((n, 3))
    x[0] = [100.0, 100.0, -0.1]
    for k in range(n - 1):
        x[k + 1] = f @ x[k] + held @ u[:, k] + ramp @ (u[:, k + 1] - u[:, k]) + w[:, k]
    y = x[:, :2] + rng.standard_normal((n, 2)) * SIGMA
    y[rng.random((n, 2)) < missing] = np.nan
    y[np.arange(n) % stride > 0] = np.nan
    outputs = {"omega": y[:, 0], "omega_load": y[:, 1]} if two else {"omega": y[:, 0]}
    units = {"T": "N m", "T_load": "N m", **dict.fromkeys(outputs, "rad/s")}
    data = ce.Experiment.from_arrays(name, time=t, units=units, T=u[0], T_load=u[1], **outputs)
    return SimpleNamespace(data=data, u=u, y=np.array(list(outputs.values())), n=n)


def innovations(points, made, starts, lifts):
    """(P, ny, N) y - y_hat at many points at once, NaN where not measured; ``lifts``: set of outputs -> (P, 3, ny)."""
    steps = [discrete(p) for p in points]
    f, held, ramp = (np.array([step[k] for step in steps]) for k in range(3))
    ny, x = len(made.y), np.array(starts, dtype=float)
    forced = held @ made.u[:, :-1] + ramp @ np.diff(made.u)
    e = np.full((len(x), *made.y.shape), np.nan)
    kinds = [tuple(row) for row in np.isfinite(made.y).T]
    gains = {kind: lifts(kind) for kind in set(kinds)}
    for k, kind in enumerate(kinds):
        e[:, :, k] = made.y[:, k] - x[:, :ny]
        if any(kind):
            x = x + np.einsum("pij,pj->pi", gains[kind], np.where(kind, e[:, :, k], 0.0))
        if k < made.n - 1:
            x = np.einsum("pij,pj->pi", f, x) + forced[:, :, k]
    return e


def by_kind(made, e):
    """Sets of outputs measured together, and the innovations of these samples, (P, outputs, samples)."""
    seen = np.isfinite(made.y).T
    for kind in {tuple(row) for row in seen}:
        if any(kind):
            yield kind, e[:, :, (seen == np.array(kind)).all(axis=1)][:, np.flatnonzero(kind)]


def kalman(p, q, r, ny, every=1):
    """Gain and innovations' covariance for each set of outputs, from the error covariance of full measurement."""
    f, _, _, noise = discrete(p, q, H * every)
    c, r = np.eye(ny, 3), np.diag(np.square(r))
    cov = solve_discrete_are(f.T, c.T, (noise + noise.T) / 2, r)

    def size(seen):
        some = np.flatnonzero(seen)
        return c[some] @ cov @ c[some].T + r[np.ix_(some, some)]

    def lift(seen):
        gain, some = np.zeros((3, ny)), np.flatnonzero(seen)
        if len(some):
            gain[:, some] = cov @ c[some].T @ np.linalg.inv(size(seen))
        return gain

    return lift, size


def minus_log_likelihood(points, noises, starts, made, every=1):
    """(P,) of points with process and measurement noise (q, r) each."""
    predictors = [kalman(p, q, r, len(made.y), every) for p, (q, r) in zip(points, noises, strict=True)]
    e = innovations(points, made, starts, lambda seen: np.array([lift(seen) for lift, _ in predictors]))
    total = np.zeros(len(points))
    for kind, own in by_kind(made, e):
        for i, (_, size) in enumerate(predictors):
            s = size(kind)
            total[i] += 0.5 * np.einsum("ik,ik", own[i], np.linalg.solve(s, own[i]))
            total[i] += 0.5 * own.shape[2] * np.linalg.slogdet(s)[1]
    return total


def vector(fit, name="shaken"):
    """Everything that was estimated, relative to its size, and its errors."""
    start = fit.initial[name]
    values = np.concatenate([fit.z, [start[s].value for s in STATES]])
    errors = np.concatenate([np.sqrt(np.diag(fit.covariance)), [start[s].stderr for s in STATES]])
    return values, errors


def unpack(fit, x):
    found = dict(zip(fit.free, x, strict=False))
    p = {name: found.get(name, TRUTH[name]) for name in NAMES}
    return found, p, x[len(fit.free) :]


def curvature(f, x, steps):
    """Gradient and Hessian by central differences, in units of ``steps``; f takes many points at once."""
    k, e = len(x), np.diag(steps)
    i, j = np.triu_indices(k)
    corners = [x + a * e[i] + b * e[j] for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    values = f(np.concatenate([x + e, x - e, *corners]))
    gradient = (values[:k] - values[k : 2 * k]) / 2
    pp, pm, mp, mm = values[2 * k :].reshape(4, -1)
    hessian = np.zeros((k, k))
    hessian[i, j] = hessian[j, i] = (pp - pm - mp + mm) / 4
    return gradient, hessian


def parameters(model, free=("J_eng", "K_el")):
    pars = model.parameters()
    for name in NAMES:
        pars[name].set(TRUTH[name])
        if name not in free:
            pars.fix(name)
    return pars


CASES = {
    "one output": {},
    "one output with gaps": {"missing": 0.2},
    "every third sample": {"stride": 3, "n": 2400},
    "two outputs": {"two": True, "n": 900},
    "two outputs with gaps": {"two": True, "n": 900, "missing": 0.2},
}


@pytest.mark.parametrize("name", few(CASES, "one output with gaps", "two outputs"))
def test_noise_covariances_maximise_the_likelihood(shaft_model, name):
    made, two = record(**CASES[name]), CASES[name].get("two", False)
    model = shaft_model(two)
    fit = ce.estimate(
        model, made.data, parameters=parameters(model), noise=ce.Noise(process="estimate"), errors="quadratic",
        progress=False,
    )  # fmt: skip
    assert fit.status == "converged"
    every = CASES[name].get("stride", 1)
    outputs = ("omega", "omega_load")[: len(made.y)]

    def noises(found):
        q = (found["process.omega_eng"], found["process.omega_load"])
        return q, [found[f"noise.{output}"] for output in outputs]

    def f(many):
        found, points, starts = zip(*[unpack(fit, x) for x in many], strict=True)
        return minus_log_likelihood(points, [noises(one) for one in found], starts, made, every)

    x, errors = vector(fit)
    gradient, hessian = curvature(f, x, 0.02 * errors)
    # in standard errors: the optimum is met far within one, and the errors are those of the likelihood
    off = np.linalg.solve(hessian, gradient) * 0.02
    assert np.abs(off).max() < 0.01
    own = np.sqrt(np.diag(np.linalg.inv(hessian))) * 0.02
    np.testing.assert_allclose(own, 1.0, rtol=0.12)
    found, p, start = unpack(fit, x)
    lift, size = kalman(p, *noises(found), len(made.y), every)
    np.testing.assert_allclose(fit.gain, lift((True,) * len(made.y)), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(fit.innovations.kalman, discrete(p)[0] @ fit.gain, rtol=1e-9)
    np.testing.assert_allclose(
        list(fit.innovations.sigma.values()), np.sqrt(np.diag(size((True,) * len(made.y)))), rtol=1e-7
    )
    assert fit.innovations.every == every
    # the contract's cost is the sum of squared whitened innovations
    e = innovations([p], made, [start], lambda seen: lift(seen)[None])
    chi2 = sum(
        np.einsum("ik,ik", own[0], np.linalg.solve(size(kind), own[0])) for kind, own in by_kind(made, e)
    )
    assert fit.cost == pytest.approx(chi2, rel=1e-6)
    for k, output in enumerate(outputs):
        trace = fit.traces["shaken"][output]
        np.testing.assert_allclose(trace.residual[trace.mask], e[0, k][trace.mask], atol=1e-8)
        assert fit.noise[output] == (fit.values[f"noise.{output}"], True)
    for name_, truth in (*zip(("process.omega_eng", "process.omega_load"), Q, strict=True),
                         *((f"noise.{o}", s) for o, s in zip(outputs, SIGMA, strict=False))):  # fmt: skip
        assert abs(fit.values[name_] - truth) < 4 * fit.stderr[name_]


@pytest.mark.slow
def test_a_doubted_noise_level_takes_the_error_of_the_gain_with_it(shaft_model):
    """Of two outputs with gaps the noise levels are not known to a quadratic."""
    made, model = record(**CASES["two outputs with gaps"]), shaft_model(True)
    options = {"parameters": parameters(model), "noise": ce.Noise(process="estimate"), "progress": False}
    plain = ce.estimate(model, made.data, errors="quadratic", **options)
    checked = ce.estimate(model, made.data, **options)
    assert np.isfinite(plain.innovations.stderr).all()
    assert any(checked.estimates[name].quadratic for name in checked.free if name not in NAMES)
    assert np.isnan(checked.innovations.stderr).all()
    np.testing.assert_allclose(checked.innovations.kalman, plain.innovations.kalman, rtol=1e-9)


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_the_innovations_form_minimises_the_prediction_error(shaft_model, missing):
    made, model = record(missing=missing), shaft_model(False)
    options = {"noise": ce.Noise(omega="innovations"), "errors": "quadratic", "progress": False}
    fit = ce.estimate(model, made.data, parameters=parameters(model), **options)
    assert fit.status == "converged"
    gains = [f"gain.omega.{state}" for state in STATES]

    def f(many):
        found, points, starts = zip(*[unpack(fit, x) for x in many], strict=True)
        columns = np.array([[[one[g]] for g in gains] for one in found])
        e = innovations(points, made, starts, lambda seen: columns * seen[0])
        return 0.5 * np.nansum(e**2, axis=(1, 2)) / fit.noise["omega"][0] ** 2

    x, errors = vector(fit)
    gradient, hessian = curvature(f, x, 0.02 * errors)
    assert np.abs(np.linalg.solve(hessian, gradient) * 0.02).max() < 0.01
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(hessian))) * 0.02, 1.0, rtol=0.15)
    np.testing.assert_allclose(fit.gain[:, 0], [fit.values[g] for g in gains])
    assert 2 * f([x])[0] == pytest.approx(fit.cost, rel=1e-9)
    p = unpack(fit, x)[1]
    radius = np.abs(np.linalg.eigvals(discrete(p)[0] @ (np.eye(3) - fit.gain @ np.eye(1, 3)))).max()
    assert fit.innovations.radius == pytest.approx(radius, rel=1e-9)
    assert radius < 1
    if not missing:
        true_lift = kalman(TRUTH, Q, SIGMA[:1], 1)[0]((True,))
        at = [fit.free.index(g) for g in gains]
        gap = fit.gain[:, 0] - true_lift[:, 0]
        assert gap @ np.linalg.solve(fit.covariance[np.ix_(at, at)], gap) < 16.3  # chi-squared, 3, 0.1 %
        slope = discrete(p)[0]
        np.testing.assert_allclose(
            fit.innovations.stderr[:, 0],
            np.sqrt(np.diag(slope @ fit.covariance[np.ix_(at, at)] @ slope.T)),
            rtol=0.05,  # K also hangs on the physical parameters, little
        )


def test_the_innovations_form_beats_output_error_under_process_noise(shaft_model):
    made, model = record(n=3000), shaft_model(False)
    pars = parameters(model, NAMES)
    simple = ce.estimate(model, made.data, parameters=pars, noise=ce.Noise(), progress=False)
    fit = ce.estimate(model, made.data, parameters=pars, noise=ce.Noise(omega="innovations"), progress=False)

    def distance(found):
        return max(abs(found.values[n] / TRUTH[n] - 1) for n in ("J_eng", "C_eng"))

    assert distance(fit) < distance(simple)
    assert any("is not white" in message for message in simple.messages)
    assert not any("is not white" in message for message in fit.messages)
    assert ce.validate(fit).passed
    assert not ce.validate(simple).passed
    percents = fit.fit_percent["shaken"]["omega"]
    assert percents["prediction"] > percents["simulation"]
    fresh = ce.validate(fit, record(5, n=2000).data)
    assert fresh.passed
    np.testing.assert_allclose(fresh.fit.gain, fit.gain)


def test_known_covariances_add_no_parameters(shaft_model):
    made, model = record(), shaft_model(False)
    noise = ce.Noise(omega=SIGMA[0], process={"omega_eng": Q[0], "omega_load": Q[1]})
    fit = ce.estimate(model, made.data, parameters=parameters(model), noise=noise, progress=False)
    assert fit.free == ("J_eng", "K_el")
    assert fit.noise == {"omega": (SIGMA[0], False)}
    lift, size = kalman({**TRUTH, **{n: fit.values[n] for n in fit.free}}, Q, SIGMA[:1], 1)
    np.testing.assert_allclose(fit.gain, lift((True,)), rtol=1e-7)
    assert fit.innovations.sigma["omega"] == pytest.approx(float(np.sqrt(size((True,))[0, 0])))
    assert fit.cost / fit.n == pytest.approx(1, abs=0.15)
    held = ce.validate(fit, record(3).data)
    assert held.fit.cost / held.fit.n == pytest.approx(1, abs=0.15)


def test_noise_on_a_drive_is_noise_on_its_states(shaft_model):
    made, model = record(n=600), shaft_model(False)
    pars = parameters(model, ())
    by_drive = ce.Noise(omega=0.05, process={"T": 0.4, "T_load": 0.108})
    by_state = ce.Noise(omega=0.05, process={"omega_eng": 0.4 / 0.4, "omega_load": 0.108 / 0.18})
    fits = [
        ce.estimate(model, made.data, parameters=pars, noise=n, progress=False) for n in (by_drive, by_state)
    ]
    np.testing.assert_allclose(fits[0].gain, fits[1].gain, rtol=1e-10)
    assert fits[0].cost == pytest.approx(fits[1].cost, rel=1e-10)
    free = ce.Noise(omega=0.05, process={"T": "estimate"})
    fit = ce.estimate(model, made.data, parameters=pars, noise=free, progress=False)
    assert fit.estimates["process.T"].unit == "N m sqrt(s)"
    assert 0.2 < fit.values["process.T"] < 0.8


def test_one_output_corrects_and_the_other_does_not(shaft_model):
    made, model = record(two=True, n=800), shaft_model(True)
    noise = ce.Noise(omega="innovations", omega_load=0.5)
    fit = ce.estimate(model, made.data, parameters=parameters(model), noise=noise, progress=False)
    assert fit.status == "converged"
    assert [name for name in fit.free if "gain" in name] == [f"gain.omega.{state}" for state in STATES]
    assert not fit.gain[:, 1].any()
    assert fit.noise["omega_load"] == (0.5, False)


def test_entries_of_the_gain_are_parameters_like_others(shaft_model):
    made, model = record(), shaft_model(False)
    pars = parameters(model)
    pars.add("gain.omega.twist", 0.0, unit="rad/(rad/s)", vary=False)
    fit = ce.estimate(model, made.data, parameters=pars, noise=ce.Noise(omega="innovations"), progress=False)
    assert fit.gain[2, 0] == 0.0
    assert "gain.omega.twist" not in fit.free
    same = {"parameters": pars, "noise": ce.Noise(omega="innovations"), "progress": False}
    again = ce.estimate(model, made.data, warm=fit, **same)
    assert again.iterations < fit.iterations
    np.testing.assert_allclose(again.z, fit.z, rtol=1e-6)
    # a later fit without process noise does not stumble over what this one left in the set
    plain = ce.estimate(model, made.data, parameters=fit.parameters, noise=ce.Noise(), progress=False)
    assert plain.innovations is None
    assert plain.free == ("J_eng", "K_el")


def test_two_records_share_gain_and_covariances(shaft_model):
    model = shaft_model(False)
    data = [record(0, n=800, name="a").data, record(1, n=800, name="b").data]
    for noise in (ce.Noise(omega="innovations"), ce.Noise(process="estimate")):
        same = {"parameters": parameters(model), "noise": noise, "errors": "quadratic", "progress": False}
        fit, one = (ce.estimate(model, records, **same) for records in (data, data[0]))
        assert fit.status == "converged"
        assert fit.free == one.free
        assert fit.stderr["J_eng"] < 0.85 * one.stderr["J_eng"]


def test_the_estimated_predictor_stays_stable():
    # y = x + e[k] - e[k-1]: the best predictor has its zero on the unit circle, and the sample's optimum lies at it
    rng = np.random.default_rng(3)
    time, e = np.arange(300) * 0.02, rng.standard_normal(301)
    a, torque = np.exp(-0.02 * 0.5 / 0.4), 10 + 5 * np.sign(np.sin(3 * np.arange(300) * 0.02))
    x = np.empty(300)
    x[0] = 20.0
    for k in range(299):
        x[k + 1] = a * x[k] + (1 - a) / 0.5 * torque[k]
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays(
        "over", time=time, units=units, hold="zero", T=torque, omega=x + np.diff(e)
    )
    fit = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega="innovations"), progress=False)
    assert fit.status == "converged"
    assert 0.995 < fit.innovations.radius < 1.0
    assert fit.gain[0, 0] < 0
    assert any("held by constraints: the predictor is stable" in message for message in fit.messages)


# ---- what cannot be


def test_refusals(shaft_model, refused):
    made, model = record(n=100), shaft_model(False)

    def fit(noise, **more):
        ce.estimate(model, made.data, noise=noise, progress=False, **more)

    with refused(EstimationError, "neither a state nor a drive", seen="'omega'", allowed="omega_eng, omega_load",
                 cure="model.table()"):  # fmt: skip
        fit(ce.Noise(process={"omega": 1.0}))
    with refused(EstimationError, "a robust loss does not go with noise covariances", cure='omega="innovations"',
                 seen="process=", allowed="square"):  # fmt: skip
        fit(ce.Noise(process="estimate"), loss="huber")


def test_a_nonlinear_model_has_no_such_predictor(refused, misfire):
    model = ce.two_mass(cylinders=4)
    for noise in (ce.Noise(omega="innovations"), ce.Noise(process="estimate")):
        with refused(EstimationError, "needs a linear model", seen="two_mass", allowed="linear in its states",
                     cure="the linear form of the model"):  # fmt: skip
            ce.estimate(model, misfire(1, 1), noise=noise, progress=False)


def test_a_model_whose_mode_is_not_seen_has_no_stable_gain(refused):
    b = ce.Blueprint("unseen")
    p, x, u = b.parameter("p", 1.0), b.state("x"), b.input("u")
    b.state("z")
    b.ode("x", u - p * x)
    b.ode("z", u)
    b.output("y", x)
    model, rng = b.model(), np.random.default_rng(0)
    data = ce.Experiment.from_arrays(
        "r",
        time=np.arange(50) * 0.1,
        units={"u": "1", "y": "1"},
        u=rng.normal(size=50),
        y=rng.normal(size=50),
    )
    for noise in (ce.Noise(y="innovations"), ce.Noise(process="estimate")):
        with refused(EstimationError, "no stable gain at the start values", seen="p=1",
                     allowed="a model whose outputs show every mode", cure="measure one more output"):  # fmt: skip
            ce.estimate(model, data, noise=noise, progress=False)


def test_covariances_go_with_one_stride_of_the_outputs(shaft_model):
    model = shaft_model(two=False)
    records = [record(n=300).data, record(1, n=300, stride=3, name="slow").data]
    with pytest.raises(EstimationError) as caught:
        ce.estimate(
            model, records, parameters=parameters(model), noise=ce.Noise(process="estimate"), progress=False
        )
    assert "one distance between samples, and these records have several" in str(caught.value)
    assert "an output at every 1., 3. step of the inputs" in str(caught.value)
    assert "resample them alike" in str(caught.value)


def warmed(seed):
    """A body of 50 J/K behind 2 K/W without much noise of its own, by its closed form over a sample."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 600, 5.0)
    power = np.where((time // 100) % 2 == 0, 10.0, 2.0)
    decay, x, found = np.exp(-5 / 100), 0.0, []
    moved = 0.02 * np.sqrt((1 - decay**2) / (2 / 100))
    for k in range(len(time)):
        found.append(x)
        x = decay * x + (1 - decay) * 2 * power[k] + moved * rng.standard_normal()
    y = np.array(found) + 0.1 * rng.standard_normal(len(time))
    units = {"P": "W", "y": "K"}
    return ce.Experiment.from_arrays("r", time=time, units=units, hold={"P": "zero"}, P=power, y=y)


def body():
    b = ce.Blueprint("body")
    r = b.parameter("R", 2.0, unit="K/W", min=0.1)
    c = b.parameter("C", 50.0, unit="J/K", min=1)
    above, power = b.state("T", unit="K"), b.input("P", unit="W")
    b.ode("T", (power - above / r) / c)
    b.output("y", above, unit="K")
    return b.model()


def test_a_predictor_at_the_limit_of_its_stability_has_no_errors():
    """A gain below zero is none that noise has; R had an error six times too small beside it."""
    fit = ce.estimate(body(), warmed(1106), noise=ce.Noise(y="innovations"), progress=False)
    assert fit.innovations.radius > 0.999
    assert fit.messages[0].startswith("the predictor rests at the limit of its stability")
    assert all(fit.estimates[name].stderr is None for name in fit.free)
    fit = ce.estimate(body(), warmed(1004), noise=ce.Noise(y="innovations"), progress=False)
    assert fit.innovations.radius < 0.9
    assert fit.estimates["R"].stderr


@pytest.mark.parametrize("noise", [{"process": {"T": "estimate"}, "y": 0.1}, {"y": "innovations"}])
def test_a_profile_beside_a_predictor_agrees_with_the_errors_of_its_fit(noise):
    """Its levels were those of the measurement alone: the interval had no width."""
    fit = ce.estimate(body(), warmed(1004), noise=ce.Noise(**noise), progress=False)
    low, high = ce.profile(fit, "R", points=3).intervals["R"]
    half = 0.5 * (high - low)
    assert half == pytest.approx(1.98 * fit.estimates["R"].stderr, rel=0.2)
    assert 0.5 * (high + low) == pytest.approx(fit.values["R"], abs=0.1 * half)


def test_a_profile_of_a_predictor_that_has_another_optimum_is_refused():
    fit = ce.estimate(body(), warmed(1004), noise=ce.Noise(y="innovations"), progress=False)
    one = fit.estimates["R"]
    moved = dataclasses.replace(one, value=one.value + one.stderr)
    other = dataclasses.replace(fit, estimates={**fit.estimates, "R": moved})
    with pytest.raises(EstimationError, match=r"(?s)has another optimum.*R elsewhere.*ce\.posterior"):
        ce.profile(other, "R", points=3)
