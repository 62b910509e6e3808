"""A coloured residual is no noise where it hardly swings, is most of what was measured, or is foretold and seen."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.discrepancy import exchange
from casadi_engine.discrepancy.no_noise import leaves_no_noise, why_no_noise
from casadi_engine.discrepancy.ways import ranked

WAVE = np.sqrt(2) * np.sin(2 * np.pi * 20 * np.arange(2000) / 2000)
# narrow noise, whose swings die out after some twenty samples
NARROW = lfilter([1.0], [1.0, -1.9 * np.cos(0.5), 0.9025], np.random.default_rng(1).standard_normal(2000))
NARROW = NARROW / NARROW.std()
WHITE = np.random.default_rng(0).standard_normal(2000)


@pytest.mark.parametrize(
    ("e", "explained", "innovations", "words"),
    [
        (NARROW, 73.0, 0.05, "is predicted from its own past to within 5 %"),
        (NARROW, 92.0, 0.05, None),  # a person does not see it
        (NARROW, 73.0, 0.3, None),
        (NARROW, 20.0, 0.3, "explains 20 % of y in run, and the rest is coloured"),
        (WHITE, 20.0, 0.99, None),
        (NARROW, None, 0.05, None),
        # nothing periodic is noise, however small
        (WAVE, 92.0, 0.3, "oscillates without decaying, as if the record held 3 independent samples"),
        (WAVE + 0.3 * WHITE, None, 0.3, "oscillates without decaying"),
        (np.sign(np.sin(2 * np.pi * np.arange(2000) / 2000 + 0.3)), 99.0, 0.9, "changes as slowly as if"),
    ],
)
def test_what_is_no_noise(e, explained, innovations, words):
    said = why_no_noise("run", "y", e, explained, innovations)
    assert (said is None) == (words is None)
    assert words is None or words in said
    assert words is None or said.endswith("no noise of that kind can be told from a missing effect")


def of(e, coloured, *, spread=4.0):
    """A model that leaves e of an output with a spread, and the noise that it leaves."""
    measured = {"y": stub(values=spread * np.sqrt(2) * np.cos(np.arange(len(e))))}
    record = stub(name="run", residual={"y": e}, path=stub(grid=stub(measured=measured)), slopes={})
    noise = stub(colour={("run", "y"): object()} if coloured else {}, sigma={"y": 0.05})
    return stub(records=(record,)), noise


@pytest.mark.parametrize(
    ("e", "coloured", "spread", "told"),
    [
        (NARROW, True, 4.0, True),
        (NARROW, False, 4.0, False),
        (NARROW, True, 40, False),
        (WAVE, True, 40, True),
    ],
)
def test_a_model_that_leaves_no_noise(e, coloured, spread, told):
    assert leaves_no_noise(*of(e, coloured, spread=spread)) == told


def tried(key, *, own, cost):
    """A structure with its log likelihood of innovations, and what it leaves."""
    evidence = stub(error={"a": 1.0}, cost=cost)
    made = stub(key=frozenset(key), own=own, evidence=evidence, certainty=lambda one: 5.0)
    made.arrived = stub(cost=cost, values={"a": 5.0}, levels={})
    made.effects = [stub(candidate=stub(key=one), amplitude="a") for one in key]
    return made


@pytest.mark.parametrize(
    ("gain", "cost", "smooth", "weak"),
    [
        (0.0, 90.0, False, True),  # its error by least squares is ten times that of white noise
        (10.0, 90.0, False, False),
        (10.0, 110.0, False, True),  # a wrong way is smooth, and foretells itself
        (0.0, 90.0, True, False),
    ],
)
def test_the_likelihood_of_innovations_tells_what_least_squares_do_not(monkeypatch, gain, cost, smooth, weak):
    """Drag of a pendulum that was beyond doubt by its innovations was no finding by its error."""
    none, drag = tried([], own=1.0, cost=100.0), tried([("drag", "pivot")], own=1.0 + gain, cost=cost)
    null, noise = of(WAVE if smooth else WHITE, smooth)
    path = stub(residuals=lambda effects, arrived: null)
    refits = stub(
        levels=stub(memory={"y": 9.0}), path=path, known={}, pool={one.key: one for one in (none, drag)}
    )
    monkeypatch.setattr(exchange, "estimated_noise", lambda *given, **how: noise)
    monkeypatch.setattr(exchange, "too_large", lambda *given: ())
    monkeypatch.setattr(exchange, "coloured_errors", lambda *given: {"a": 10.0})
    assert exchange.weak_beside_colour(refits, drag) == weak


def structure(*names, log, white, cost=0.0):
    """A structure with its log evidence, and that by samples which are worth fewer independent ones."""
    made = stub(effects=list(names), key=frozenset(names), log=log, beyond=9.0, evidence=stub(log=white))
    made.arrived = stub(cost=cost)
    return made


@pytest.mark.parametrize("memory", [{}, {"y": 9.0}])
def test_fresh_data_are_asked_where_the_likelihoods_do_not_agree(memory):
    """Drag alone foretold the innovations of a pendulum best, and the gap on fresh data grew with it; with dry friction
    it left a quarter less of the residual, and a third of the gap on fresh data."""
    every = [
        structure(log=0.0, white=0.0),
        structure("drag", log=57.9, white=20.0),
        structure("offset", log=56.0, white=1.0),  # near
        structure("drag", "dry", log=47.2, white=55.0),
        structure("dry", log=40.0, white=15.0),  # neither says so
    ]
    pool = {one.key: one for one in every}
    search = stub(pool=pool, best=frozenset(["drag"]), price=1.1, refits=stub(levels=stub(memory=memory)))
    asked = [set(key) for key in ranked(search)]
    more = [{"drag", "dry"}] if memory else []
    assert asked == [{"drag"}, {"offset"}, *more, set()]
