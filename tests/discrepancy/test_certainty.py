"""Whether an amplitude is there: by its slopes, by what chi-squared falls by with it and rises by without it."""

from types import SimpleNamespace as stub

import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.path import Path
from casadi_engine.discrepancy.refit import addition
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.tried import Tried, key_of

ONE = stub(candidate=stub(key=("overflow", "tanks")), amplitude="tanks.overflow.rate")


def tried(*, alone, without=400.0, acts=()):
    evidence = stub(error={ONE.amplitude: 1.0}, alone={ONE.amplitude: alone}, cost=10.0, log=0.0)
    pool = {key_of(()): stub(evidence=stub(cost=without), counted=0.0)}
    found = Tried((ONE,), stub(values={ONE.amplitude: 0.5}), None, evidence, lambda: pool)
    found.acts = dict(acts)
    return found


@pytest.mark.parametrize(
    ("found", "certainty"),
    [
        (tried(alone=0.8), 0.5),  # its slope says that it is nothing
        (tried(alone=0.1), 390**0.5),  # it is there, and the optimum without it elsewhere
        (
            tried(alone=0.8, acts={ONE.amplitude: 12.0}),
            390**0.5,
        ),  # as fast as it likes: without it all is worse
        (tried(alone=0.8, acts={ONE.amplitude: 0.3}), 0.5),
        (tried(alone=0.8, acts={ONE.amplitude: 12.0}, without=10.1), 0.5),  # others do as well
    ],
)
def test_an_amplitude_is_there_if_nothing_in_its_place_is_worse(found, certainty):
    assert found.certainty(ONE) == pytest.approx(certainty)


def test_chi_squared_without_an_amplitude_is_that_of_the_model_without_it(pendulum):
    data = pendulum.decay(lambda t, angle, rate: -0.02 * rate * abs(rate), c=0.3)
    fit = ce.estimate(pendulum.model, data, noise=ce.Noise(y=pendulum.level), progress=False)
    candidates = screen(fit, ["quadratic_drag"], colour=False).candidates
    one = addition(candidates[0], 0.01)
    path = Path(pendulum.refitter(data), {"y": pendulum.level})
    end = path.from_point([one], Start.of(fit))
    bare = path.from_point([], Start(end.values, end.initial))
    without = path.cost_without([one], end, one.amplitude)
    assert without > end.cost + 100
    assert without >= bare.cost - 1e-6  # which is the least
