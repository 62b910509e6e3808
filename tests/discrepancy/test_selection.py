"""Forward selection on problems whose answer is known, and how often half-samples agree."""

import numpy as np
import pytest
from scipy import stats

from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.selection import (
    Proposal,
    Refit,
    effective_samples,
    extended_bic,
    select,
    selection_frequency,
)


def regression(truth, *, seed=0, n=500, correlated=False):
    """A linear problem with callables: columns are the effects."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 8))
    if correlated:
        x[:, 7] = x[:, 0] + x[:, 1] + 0.3 * x[:, 7]
    y = x @ truth + rng.standard_normal(n)

    def refit(_, names):
        columns = x[:, [int(k) for k in names]]
        coefficients = np.linalg.lstsq(columns, y, rcond=None)[0] if names else np.zeros(0)
        rest = y - columns @ coefficients
        return Refit(tuple(names), float(rest @ rest), len(names), state=rest)

    def propose(fit):
        rest, used = fit.state, [int(k) for k in fit.effects]
        q = np.linalg.qr(x[:, used])[0] if used else np.zeros((n, 0))
        s = x - q @ (q.T @ x)
        z = s.T @ rest / np.maximum(np.linalg.norm(s, axis=0), 1e-12)
        z[used] = 0
        order = np.argsort(-np.abs(z))
        return [Proposal(str(k), min(1.0, 8 * 2 * stats.norm.sf(abs(z[k]))), z[k] ** 2) for k in order]

    return refit, propose


def run(truth, **options):
    refit, propose = regression(truth, **options)
    return select(refit(None, ()), propose, refit, alpha=0.01, samples=500, library=8)


def test_two_effects_are_found_in_the_order_of_their_strength():
    truth = np.array([0, 0.5, 0, 0, 0, 0.3, 0, 0])
    found = run(truth)
    assert found.effects == ("1", "5")
    assert found.final.effects == found.effects
    assert found.steps[-1].kept is None
    assert [len(step.tried) for step in found.steps][:2] == [2, 1] or found.steps[0].tried


def test_nothing_is_found_where_nothing_is():
    hits = sum(bool(run(np.zeros(8), seed=s).effects) for s in range(60))
    assert hits <= 3


def test_an_effect_that_stood_for_two_others_is_dropped():
    """Column 7 is almost the sum of 0 and 1, and wins the first round."""
    found = run(np.array([1.0, 1.0, 0, 0, 0, 0, 0, 0]), correlated=True, n=2000)
    assert found.steps[0].tried[0].effects == ("7",)
    assert set(found.effects) == {"0", "1"}
    assert any("7" in step.dropped for step in found.steps)


def test_refits_that_do_not_converge_are_passed_over():
    refit, propose = regression(np.array([0, 0.5, 0, 0, 0, 0.3, 0, 0]))

    def fails(fit, names):
        made = refit(fit, names)
        return Refit(made.effects, made.cost, made.freedom, converged="1" not in names, state=made.state)

    found = select(refit(None, ()), propose, fails, alpha=0.01, samples=500, library=8)
    assert found.effects == ("5",)


def test_the_criterion_counts_how_many_effects_could_have_been_chosen():
    few = extended_bic(100.0, 6, 1, samples=1000, library=10)
    many = extended_bic(100.0, 6, 1, samples=1000, library=1000)
    assert few == pytest.approx(100 + 6 * np.log(1000) + np.log(10))
    assert many - few == pytest.approx(np.log(100))


def test_effective_samples_of_an_autoregression():
    rng = np.random.default_rng(0)
    white = rng.standard_normal(40_000)
    slow = np.empty_like(white)
    slow[0] = white[0]
    for k in range(1, len(white)):
        slow[k] = 0.8 * slow[k - 1] + white[k]
    assert effective_samples(white) == pytest.approx(40_000, rel=0.1)
    assert effective_samples(slow) == pytest.approx(40_000 * 0.2 / 1.8, rel=0.2)
    assert effective_samples(np.zeros(10)) == 10


def test_half_samples_of_cycles_choose_a_strong_effect_every_time(shaft):
    size = 0.8

    def hidden(t, x):
        return size * np.sign(x[1] - x[0]) * np.array([1, -1])

    candidates = shaft.candidates(shaft.model)[:10]
    strong = compress(shaft.null(shaft.data(hidden=hidden, n=800)), candidates, NoiseModel(shaft.sigma))
    found = selection_frequency(strong, halves=20)
    assert next(iter(found)) == ("coulomb_friction", "coupling")
    assert found["coulomb_friction", "coupling"] > 0.7
    noise = compress(shaft.null(shaft.data(n=800)), candidates, NoiseModel(shaft.sigma))
    assert max(selection_frequency(noise, halves=20).values()) < 0.9
    assert sum(found.values()) == pytest.approx(1)


def test_too_few_cycles_have_no_halves(shaft):
    made = compress(shaft.null(shaft.data(n=60)), shaft.candidates(shaft.model)[:2], NoiseModel(shaft.sigma))
    assert selection_frequency(type(made)(**{**vars(made), "parts": made.parts[:3]})) == {}
