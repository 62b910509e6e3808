"""Log evidence against Bayesian linear regression with dense matrices, and what must not change it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from scipy.signal import lfilter

from casadi_engine.discrepancy.evidence import Levels, Prior, digest, evidence, levels_left
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.discrepancy.tried import Tried

SCALES = st.floats(-6, 6).map(lambda power: 10.0**power)
SIGMA = {"speed": 0.3, "angle": 2.0}


def linear(columns=2, *, states=1, records=("a", "b"), seed=0, n=30, moved=0.2):
    """A linear model at its least-squares optimum, as a refit leaves it: two outputs, first states of every record."""
    rng = np.random.default_rng(seed)
    names = tuple(f"p{k}" for k in range(columns))
    made = []
    for name in records:
        slopes = {out: rng.standard_normal((n, columns + states)) for out in SIGMA}
        noise = {out: (1 + moved) * s * rng.standard_normal(n) for out, s in SIGMA.items()}
        made.append(record(name, noise, slopes, states))
    null = model(names, made, 1 + rng.random(columns))
    return replace(null, records=tuple(at_optimum(null)))


def record(name, residual, slopes, states):
    return RecordNull(
        name=name,
        path=None,
        residual=residual,
        time={},
        index={},
        length={},
        cycle={},
        slopes=slopes,
        starts=tuple(f"x{k}" for k in range(states)),
    )


def model(names, records, values):
    size = len(names)
    units = ("1",) * size
    return NullModel(
        None, names, units, np.asarray(values), np.eye(size), np.zeros((0, size + 1)), tuple(records)
    )


def stacked(null, levels=SIGMA):
    """Whitened columns [parameters | first states by record] and residual."""
    n_theta = null.turn.shape[1]
    wide = n_theta + sum(len(r.starts) for r in null.records)
    rows, first = [], n_theta
    for r in null.records:
        for out in r.outputs:
            own = np.zeros((len(r.residual[out]), wide + 1))
            own[:, :n_theta] = r.slopes[out][:, :n_theta]
            own[:, first : first + len(r.starts)] = r.slopes[out][:, n_theta:]
            own[:, -1] = r.residual[out]
            rows.append(own / levels[out])
        first += len(r.starts)
    rows = np.concatenate(rows)
    return rows[:, :-1], rows[:, -1]


def at_optimum(null):
    """The records with what their columns explain taken out of the residuals."""
    x, e = stacked(null)
    rest, start = e - x @ np.linalg.lstsq(x, e, rcond=None)[0], 0
    for r in null.records:
        residual = {}
        for out in r.outputs:
            count = len(r.residual[out])
            residual[out] = rest[start : start + count] * SIGMA[out]
            start += count
        yield replace(r, residual=residual)


def dense(x, e, variances):
    """log N(e; 0, 1 + x V x') but for the constant of all models."""
    law = stats.multivariate_normal(np.zeros(len(e)), np.eye(len(e)) + x * variances @ x.T)
    return law.logpdf(e) + 0.5 * len(e) * np.log(2 * np.pi)


def wide(null, deviation=3.0):
    return {name: Prior(deviation) for name in null.parameters}


def log_of(null, priors=None, levels=None, **options):
    priors = wide(null) if priors is None else priors
    return evidence(digest(null, priors, **options), Levels(SIGMA) if levels is None else levels).log


def test_the_evidence_is_that_of_bayesian_linear_regression():
    """Priors about the optimum, first states with ten times their scale."""
    null = linear()
    x, e = stacked(null)
    found = evidence(digest(null, wide(null)), Levels(SIGMA))
    assert found.log == pytest.approx(dense(x, e, np.array([9, 9, 100, 100])), abs=1e-9)
    assert found.cost == pytest.approx(e @ e)
    errors = np.sqrt(np.diag(np.linalg.inv(x.T @ x + np.diag([1 / 9, 1 / 9, 1e-2, 1e-2]))))
    np.testing.assert_allclose([found.error["p0"], found.error["p1"]], errors[:2])


@given(seed=st.integers(0, 10_000), columns=st.integers(0, 3), states=st.integers(0, 2))
@settings(max_examples=15, deadline=None)
def test_any_linear_model_has_its_closed_form(seed, columns, states):
    null = linear(columns, states=states, seed=seed)
    x, e = stacked(null)
    variances = np.array([9.0] * columns + [100.0] * 2 * states)
    wanted = dense(x, e, variances) if len(variances) else -0.5 * e @ e
    assert log_of(null) == pytest.approx(wanted, abs=1e-8)


def test_a_prior_of_the_user_counts_beside_the_weak_one():
    """Much tighter than the weak one it is the only one: known mean and error of a parameter."""
    null, mean, spread = linear(1, states=0), 0.4, 0.05
    x, e = stacked(null)
    # the optimum of data and prior, and the data as it is seen from there
    about = mean - null.values[0]
    step = np.linalg.solve(x.T @ x + 1 / spread**2, x.T @ e + about / spread**2)
    records, start = [], 0
    for r in null.records:
        residual = {}
        for out in r.outputs:
            rows = slice(start, start + len(r.residual[out]))
            residual[out] = (e - x @ step)[rows] * SIGMA[out]
            start = rows.stop
        records.append(replace(r, residual=residual))
    prior = np.array([[1 / spread, (about - step[0]) / spread]])
    there = replace(null, values=null.values + step, records=tuple(records), prior=prior)
    wanted = dense(x, e - x @ [about], np.array([spread**2]))
    assert log_of(there, {"p0": Prior(1e4)}) == pytest.approx(wanted, abs=1e-6)


def test_random_amplitudes_are_part_of_the_covariance():
    null = linear()
    rng = np.random.default_rng(5)
    random = {r.name: {out: rng.standard_normal((30, 4)) for out in r.outputs} for r in null.records}
    x, e = stacked(null)
    drawn = np.zeros((len(e), 8))
    for k, r in enumerate(null.records):
        for j, out in enumerate(r.outputs):
            rows = slice(60 * k + 30 * j, 60 * k + 30 * j + 30)
            drawn[rows, 4 * k : 4 * k + 4] = random[r.name][out] / SIGMA[out]
    known = np.array([9.0, 9, 100, 100])
    for scatter in (0.2, 3.0):
        wanted = dense(np.hstack([x, drawn]), e, np.concatenate([known, np.full(8, scatter**2)]))
        assert log_of(null, levels=Levels(SIGMA, {}, scatter), random=random) == pytest.approx(
            wanted, abs=1e-8
        )
    assert log_of(null, random=random) == pytest.approx(log_of(null))


def test_samples_that_remember_count_for_as_many_independent_ones():
    null = linear()
    by_memory = log_of(null, levels=Levels(SIGMA, {"speed": 4.0, "angle": 9.0}))
    by_level = log_of(null, levels=Levels({"speed": 2 * SIGMA["speed"], "angle": 3 * SIGMA["angle"]}))
    assert by_memory == pytest.approx(by_level)


# ---- what each free number costs


def with_column(null, name, column, value=1.0):
    """The model with one more parameter; column : one for all records and outputs, in levels."""
    records, start = [], 0
    for r in null.records:
        slopes = {}
        for out, own in r.slopes.items():
            rows = slice(start, start + len(own))
            start = rows.stop
            slopes[out] = np.insert(own, null.turn.shape[1], column[rows] * SIGMA[out], axis=1)
        records.append(replace(r, slopes=slopes))
    return model((*null.parameters, name), records, [*null.values, value])


def test_a_number_that_the_data_say_nothing_of_costs_nothing():
    null = linear()
    more = with_column(null, "phase", np.zeros(120))
    found = evidence(digest(more, wide(more)), Levels(SIGMA))
    assert found.log == pytest.approx(log_of(null))
    assert found.error["phase"] == pytest.approx(3.0)


def test_a_number_costs_how_much_better_it_is_known_than_before():
    """log(prior deviation / error), where the data tell it and nothing else moves as it does."""
    null = linear()
    other = np.column_stack(stacked(null))  # neither what is known nor the noise looks like it
    column = np.random.default_rng(8).standard_normal(120)
    column -= other @ np.linalg.lstsq(other, column, rcond=None)[0]
    more = with_column(null, "k", column)
    for deviation in (1.0, 30.0):
        priors = wide(null) | {"k": Prior(deviation)}
        found = evidence(digest(more, priors), Levels(SIGMA))
        price = np.log(deviation / found.error["k"])
        assert log_of(null) - found.log == pytest.approx(price, rel=1e-6)


@pytest.mark.parametrize("sided", [False, True])
@pytest.mark.parametrize("size", [0.3, 2.0, 40.0])
def test_an_amplitude_has_a_prior_with_heavy_tails_about_zero(size, sided):
    """Against the integral over Cauchy's law, or over its half."""
    null, deviation = linear(1, states=0), 2.0
    null = replace(null, values=np.array([size]))
    x, e = stacked(null)
    error = 1 / np.linalg.norm(x)
    law = stats.halfcauchy(scale=deviation) if sided else stats.cauchy(scale=deviation)

    def density(value):
        return np.exp(-0.5 * ((value - size) / error) ** 2) * law.pdf(value)

    area, _ = integrate.quad(density, size - 10 * error, size + 10 * error, points=[size])
    found = log_of(null, {"p0": Prior(deviation, True, sided)})
    assert found == pytest.approx(-0.5 * e @ e + np.log(area), abs=0.02)


def without_column(null, k, moved=0.0):
    """The model with a parameter held so far from its value."""
    kept = [j for j in range(len(null.parameters)) if j != k]
    return replace(
        null,
        parameters=tuple(null.parameters[j] for j in kept),
        values=null.values[kept],
        turn=np.eye(len(kept)),
        prior=np.zeros((0, len(kept) + 1)),
        records=tuple(
            replace(
                r,
                residual={out: r.residual[out] + moved * own[:, k] for out, own in r.slopes.items()},
                slopes={out: np.delete(own, k, axis=1) for out, own in r.slopes.items()},
            )
            for r in null.records
        ),
    )


@pytest.mark.parametrize("beyond", [0.0, 0.3, 2.0, 6.0])
def test_a_parameter_at_its_bound_is_averaged_over_the_allowed_side(beyond):
    null = linear(3)
    priors = wide(null)
    deviation = priors["p1"].deviation
    error = evidence(digest(null, priors), Levels(SIGMA)).alone["p1"]
    at_bound = replace(  # where the data would have it beyond the bound
        null,
        records=tuple(
            replace(
                r,
                residual={out: r.residual[out] + beyond * error * own[:, 1] for out, own in r.slopes.items()},
            )
            for r in null.records
        ),
    )

    def density(inside):
        return np.exp(log_of(without_column(at_bound, 1, inside)) - top) * stats.norm.pdf(
            inside, scale=deviation
        )

    top = log_of(without_column(at_bound, 1))
    area, _ = integrate.quad(density, 0, 40 * error, points=[error, 5 * error])
    found = evidence(digest(at_bound, priors, held=frozenset({"p1"})), Levels(SIGMA))
    assert found.log == pytest.approx(top + np.log(area), abs=1e-5)
    assert found.error["p1"] == np.inf
    assert found.error["p0"] == pytest.approx(
        evidence(digest(without_column(null, 1), priors), Levels(SIGMA)).error["p0"]
    )


def test_the_choice_among_whole_numbers_is_paid_for():
    null = linear()
    assert log_of(null) - log_of(null, choices=12.0) == pytest.approx(np.log(12))


def test_records_without_parameters_or_states_have_their_likelihood_alone():
    null = linear(0, states=0)
    _, e = stacked(null)
    found = evidence(digest(null, {}), Levels(SIGMA))
    assert found.log == pytest.approx(-0.5 * e @ e)
    assert not found.error


# ---- units


@given(first=SCALES, second=SCALES, turned=st.booleans())
@settings(max_examples=20, deadline=None)
def test_units_of_parameters_do_not_count(first, second, turned):
    """Neither where the slopes are in the new unit, nor where only the way from directions to parameters is."""
    null, size = linear(), np.array([first, second])
    priors = {"p0": Prior(3.0, True), "p1": Prior(0.5)}
    scaled = {
        name: replace(one, deviation=one.deviation * s)
        for (name, one), s in zip(priors.items(), size, strict=True)
    }
    if turned:
        other = replace(null, values=null.values * size, turn=np.diag(size))
    else:
        slim = np.append(size, 1.0)  # the last column is that of the first state
        other = replace(
            null,
            values=null.values * size,
            records=tuple(
                replace(r, slopes={out: own / slim for out, own in r.slopes.items()}) for r in null.records
            ),
        )
    before, after = (evidence(digest(one, p), Levels(SIGMA)) for one, p in ((null, priors), (other, scaled)))
    assert after.log == pytest.approx(before.log, abs=1e-6)
    for name, s in zip(priors, size, strict=True):
        assert after.error[name] == pytest.approx(before.error[name] * s)


@given(scale=SCALES)
@settings(max_examples=15, deadline=None)
def test_units_of_outputs_do_not_count(scale):
    null = linear()
    records = tuple(
        replace(
            r,
            residual=r.residual | {"speed": r.residual["speed"] * scale},
            slopes=r.slopes | {"speed": r.slopes["speed"] * scale},
        )
        for r in null.records
    )
    levels = Levels(SIGMA | {"speed": SIGMA["speed"] * scale}, {"speed": 2.0})
    found = log_of(replace(null, records=records), levels=levels)
    assert found == pytest.approx(log_of(null, levels=Levels(SIGMA, {"speed": 2.0})), abs=1e-6)


@given(scale=st.floats(-2, 2).map(lambda power: 10.0**power))
@settings(max_examples=15, deadline=None)
def test_scales_of_states_do_not_count_between_models(scale):
    """They move the evidence of all models by the same."""
    null = linear()
    more = with_column(null, "k", np.random.default_rng(8).standard_normal(120))

    def gain(factor):
        def written(one):
            slim = np.append(np.ones(one.turn.shape[1]), factor)
            return replace(
                one,
                records=tuple(
                    replace(r, slopes={out: own * slim for out, own in r.slopes.items()}) for r in one.records
                ),
            )

        return log_of(written(more)) - log_of(written(null))

    assert gain(scale) == pytest.approx(gain(1.0), abs=1e-2)


# ---- the noise that a model leaves


def drawn(shaft, with_residual, sigma, *, phi=0.0, seed=2):
    """A null model with residuals of given noise, its slopes' part left in."""
    null = shaft.null(shaft.data(seed=seed, n=600))
    rng = np.random.default_rng(seed)

    def noise(out, count):
        white = rng.standard_normal(count + 200)
        return sigma[out] * lfilter([np.sqrt(1 - phi**2)], [1, -phi], white)[200:]

    residuals = {r.name: {out: noise(out, len(e)) for out, e in r.residual.items()} for r in null.records}
    return with_residual(null, residuals)


def test_white_noise_has_its_level_and_no_memory(shaft, with_residual):
    found = levels_left(drawn(shaft, with_residual, shaft.sigma), {}, 0.1, None)
    for out, sigma in shaft.sigma.items():
        assert found.sigma[out] == pytest.approx(sigma, rel=0.1)
    assert not found.memory
    assert found.scatter == 0.1


def test_the_level_is_no_lower_than_what_was_stated(shaft, with_residual):
    found = levels_left(drawn(shaft, with_residual, shaft.sigma), {"omega": 0.4}, 0.0, None)
    assert found.sigma["omega"] == 0.4
    assert found.sigma["omega_load"] == pytest.approx(shaft.sigma["omega_load"], rel=0.1)


def test_coloured_noise_has_the_memory_of_its_autoregression(shaft, with_residual):
    found = levels_left(drawn(shaft, with_residual, shaft.sigma, phi=0.8), {}, 0.0, None)
    for out in shaft.sigma:
        assert found.memory[out] == pytest.approx(1.8 / 0.2, rel=0.4)
        assert found.weight(out) == pytest.approx(1 / (found.sigma[out] * np.sqrt(found.memory[out])))


def test_errors_where_all_others_are_known():
    """Of two parameters that only a factor tells apart either is known well where the other is."""
    null = linear(2, seed=3)
    record = null.records[0]
    for one in null.records:
        for out, slopes in one.slopes.items():
            slopes[:, 1] = slopes[:, 0] + 1e-4 * slopes[:, 1]
            assert one.residual[out].shape == (len(slopes),)
    priors = {name: Prior(1e6) for name in null.parameters}
    found = evidence(digest(null, priors), Levels(SIGMA))
    x, _ = stacked(null)
    for k, name in enumerate(null.parameters):
        assert found.alone[name] == pytest.approx(1 / np.linalg.norm(x[:, k]), rel=1e-6)
        assert found.error[name] > 1e3 * found.alone[name]
    assert record.starts


def test_an_amplitude_that_shares_a_factor_with_others_counts_by_what_it_gains():
    """The drag of a motor is known but for the factor of all inertias and torques; its share of them is not small."""

    def known(size, error, alone):
        one = SimpleNamespace(candidate=SimpleNamespace(key=("drag", "load")), amplitude="load.drag.c")
        arrived = SimpleNamespace(values={"load.drag.c": size}, cost=2000.0)
        own = SimpleNamespace(
            log=0.0, cost=2000.0, error={"load.drag.c": error}, alone={"load.drag.c": alone}
        )
        none = SimpleNamespace(evidence=SimpleNamespace(cost=8000.0), own=None)
        pool = {frozenset(): none}
        return Tried((one,), arrived, None, own, lambda: pool).certainty(one)

    assert known(1.0, 3.0, 0.01) == pytest.approx(6000**0.5)
    assert known(1e-3, 3.0, 0.01) == pytest.approx(1e-3 / 3.0)  # it is none, whatever was gained on the way
    assert known(1.0, 1e-3, 1e-3) == pytest.approx(1000.0)


def test_slopes_that_run_off_make_a_model_improbable_and_no_error():
    """The drift of a heated house that was held against a structure: "SVD did not converge", and no answer."""
    null = linear()
    made = digest(null, wide(null))
    parts = tuple(
        (output, np.where(np.arange(rows.size).reshape(rows.shape) == 0, np.nan, rows))
        for output, rows in made.parts
    )
    found = evidence(replace(made, parts=parts), Levels(SIGMA))
    assert (found.log, found.cost) == (-np.inf, np.inf)
    assert found.error.get("p0", np.inf) == np.inf


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
def test_an_effects_own_state_may_start_anywhere_that_it_goes(scale):
    """No user gave it a scale: in other units, where it goes so much farther, the evidence is the same."""
    null = linear(1, states=1)
    x, e = stacked(null)
    records = [
        replace(
            one,
            begins={"x0": (0.0, 0.7 * scale)},
            slopes={out: rows / np.array([1.0, scale]) for out, rows in one.slopes.items()},
        )
        for one in null.records
    ]
    wanted = dense(x, e, np.array([9.0, 0.49, 0.49]))
    assert log_of(replace(null, records=tuple(records))) == pytest.approx(wanted, abs=1e-7)


def test_an_effects_own_state_that_begins_far_from_what_it_follows_is_improbable():
    """As a normal law has it, where it is and not where a linear step would take it."""
    null = linear(1, states=1)

    def log(off):
        records = tuple(replace(one, begins={"x0": (off, 0.5)}) for one in null.records)
        return log_of(replace(null, records=records))

    assert log(0.0) - log(2.0) == pytest.approx(len(null.records) * 0.5 * 4.0**2)
    assert log(1e14) < -1e28


def test_an_amplitude_may_be_expected_elsewhere_than_at_zero():
    """A channel that is late is so with all of it: nothing is paid at 1, for less by the tails of the law."""
    null = linear(1, states=0)

    def log(value):
        return log_of(replace(null, values=np.array([value])), {"p0": Prior(0.1, True, centre=1.0)})

    assert log(1.0) - log(0.6) == pytest.approx(np.log(1 + 4.0**2))
    assert log(1.3) == pytest.approx(log(0.7))


def test_a_parameter_without_bounds_pays_for_running_away():
    """A store of 232 000 m2 for 20, behind which the structure's own store was the declared one by another name."""
    null = linear(1, states=0)

    def log(value, **known):
        return log_of(replace(null, values=np.array([value])), {"p0": Prior(200.0, centre=20.0, **known)})

    assert log(20.0, open=True) - log(20.0 + 2e5, open=True) == pytest.approx(np.log(1 + 1000.0**2))
    assert log(60.0, open=True) == pytest.approx(log(20.0, open=True), abs=0.05)
    assert log(2e5) == pytest.approx(log(20.0))  # within bounds it may be anywhere
