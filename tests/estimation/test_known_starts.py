"""Where the measurement of a fresh record gives no start, its initial states are looked for from those of the fit."""

from types import SimpleNamespace

import casadi
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.errors import SimulationError
from casadi_engine.estimation.known_starts import found_from_known

TIME = np.linspace(0, 10, 60)


def population():
    """Its logarithm is kept away from that of 0, where it has no slope and every search for a start begins."""
    b = ce.Blueprint("population")
    r, k, n = b.parameter("r", 0.6, min=0.05, max=5), b.parameter("K", 40.0, min=5, max=500), b.state("N")
    b.ode("N", r * n * (1 - n / k))
    b.output("ln", casadi.log(casadi.fmax(n, 1e-3)))
    return b.model()


def counted(name, start, seed, level=None):
    found = solve_ivp(
        lambda _, n: 0.5 * n * (1 - n / 50), (0, 10), [start], t_eval=TIME, rtol=1e-9, atol=1e-9
    )
    ln = np.log(found.y[0]) + 0.05 * np.random.default_rng(seed).standard_normal(len(TIME))
    values = ln if level is None else np.full(len(TIME), level)
    return ce.Experiment.from_arrays(name, time=TIME, units={"ln": "1"}, ln=values)


@pytest.fixture(scope="module")
def fit():
    known = {"a": {"N": 5.0}, "b": {"N": 8.0}}
    data = [counted("a", 5.0, 1), counted("b", 8.0, 2)]
    return ce.estimate(population(), data, initial=known, noise=ce.Noise(ln=0.05), progress=False)


def test_a_right_fit_passes_on_a_fresh_record(fit):
    """It FAILED 40 times of 40, by false reasons."""
    fresh = counted("c", 12.0, 3)
    check = ce.validate(fit, fresh)
    assert check.passed
    assert check.fit.initial["c"]["N"].value == pytest.approx(12.0, rel=0.05)
    band = ce.simulate(fit, fresh, band=True)["ln"]
    assert band.low[0] < np.log(12.0) < band.high[0]


def test_where_no_start_is_found_there_is_no_verdict(fit, monkeypatch):
    lost = counted("d", 12.0, 4)
    monkeypatch.setattr("casadi_engine.estimation.known_starts._MOST", 0)
    # where the search begins at a state of which the output says nothing
    monkeypatch.setattr("casadi_engine.estimation.starts._first_guess", lambda parts, scale: 0 * scale)
    check = ce.validate(fit, lost)
    said = " ".join(str(check).split())
    assert not check.passed
    assert check.failed == ()
    assert "NOT TESTED" in said
    assert "saw nothing beside initial states that were not found (see note)" in said
    assert "Next: look at the record from a start of your own: ce.simulate(fit, record, initial=" in said
    with pytest.raises(SimulationError, match="the initial state could not be fitted"):
        ce.simulate(fit, lost)


@pytest.mark.parametrize(("spent", "searches"), [(0.0, 2), (60.0, 1)])
def test_where_one_search_took_long_no_other_begins(fit, monkeypatch, spent, searches):
    """Of a reactor that lights up elsewhere ``validate`` went on for 72 s, three searches of 20 s each."""
    clock, asked = [0.0], []
    monkeypatch.setattr("casadi_engine.estimation.known_starts.time.process_time", lambda: clock[0])
    lost = SimpleNamespace(converged=False, undetermined=(), cost=9.0)

    def find(warm=None):
        asked.append(warm)
        clock[0] += spent
        return lost if warm is None else SimpleNamespace(converged=True, undetermined=(), cost=1.0)

    found = found_from_known(fit, find, ["c"])
    assert len(asked) == searches
    assert found.converged is (searches == 2)
