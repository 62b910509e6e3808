"""A parameter that rests on its bound where the likelihood is nearly as high elsewhere: the others have no ±."""

import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import casadi_engine as ce
from casadi_engine.deadline import Deadline, TimeUp, ask
from casadi_engine.errors import EstimationError
from casadi_engine.estimation import behind_a_bound
from casadi_engine.estimation.behind_a_bound import NOT_TOLD, _further, told_from_their_bounds
from casadi_engine.estimation.fit import Estimate

SEEDS = (4, 6)


@dataclass(frozen=True)
class Found:
    """What is asked of a fit."""

    estimates: dict[str, Estimate]
    cost: float = 100.0
    sigma: float = 1.0
    converged: bool = True
    own_noise: dict[str, float] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    gain: Any = None
    timing: dict[str, float] = field(default_factory=lambda: {"total": 2.0})
    initial: dict[str, dict[str, Estimate]] = field(
        default_factory=lambda: {"a": {"T": Estimate(20.0, 0.5, "degC"), "U": Estimate(21.0, 0.5, "degC")}}
    )
    start: dict[str, float] = field(default_factory=lambda: {"C": 700.0, "G": 4.0, "H": 3.0})
    fit_percent: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)

    @property
    def free(self):
        return tuple(self.estimates)

    @property
    def values(self):
        return {name: one.value for name, one in self.estimates.items()}

    @property
    def noise(self):
        return {"T": (self.sigma, True)}

    @property
    def traces(self):
        return {"a": {"T": SimpleNamespace(mask=np.ones(100, dtype=bool))}}


class Held:
    """A set in which a parameter can be fixed, and the fit that is made of it."""

    def __init__(self, other, bounds=(10.0, np.inf)):
        self.other, self.fixed, self.bounds = other, [], bounds

    def __getitem__(self, name):
        return SimpleNamespace(min=self.bounds[0], max=self.bounds[1])

    def copy(self):
        return self

    def fix(self, name, value):
        self.fixed.append((name, value))

    def again(self, changes):
        assert changes == {"parameters": self, "warm": None}
        if self.other is None:
            raise EstimationError("no", seen="no", allowed="no", cure="no")
        return self.other


def on_its_bound(**changed):
    estimates = {
        "C": Estimate(10.0, None, "J/K", at_bound="min"),
        "G": Estimate(0.06, 0.001, "W/K"),
        "H": Estimate(3.0, 0.1, "W/K"),
    }
    return Found(estimates, **changed)


def elsewhere(fit, **changed):
    moved = {"C": 700.0, "G": 3.4, "H": 3.05}
    estimates = {name: replace(one, value=moved[name]) for name, one in fit.estimates.items()}
    states = {**fit.initial["a"], "U": Estimate(23.0, 0.5, "degC")}
    return replace(fit, estimates=estimates, initial={"a": states}, **changed)


def test_what_is_elsewhere_has_no_error():
    fit = on_its_bound()
    held = Held(elsewhere(fit, cost=101.5))
    found = told_from_their_bounds(fit, held, held.again)
    assert held.fixed == [("C", pytest.approx(700.0))]
    assert (found.estimates["G"].stderr, found.estimates["G"].quadratic) == (None, 0.001)
    assert found.estimates["H"].stderr == 0.1
    states = found.initial["a"]
    assert (states["U"].stderr, states["U"].quadratic, states["T"].stderr) == (None, 0.5, 0.5)
    assert found.messages[0].startswith(f"C {NOT_TOLD} with C = 700 chi-squared is 1.5 higher and G = 3.4: ")
    assert "do not tell C from G; fix C where it is known" in found.messages[0]


@pytest.mark.parametrize(
    ("cost", "sigma", "ratio", "doubted"),
    [(105.0, 1.0, 1.0, False), (105.0, 1.0, 2.0, True), (100.0, 1.03, 1.0, False), (100.0, 1.01, 1.0, True)],
)
def test_chi_squared_counts_in_the_noise_that_there_is(cost, sigma, ratio, doubted):
    """100 samples: a level that is 3 % higher is worth 5.9, one of 1 % 2."""
    fit = on_its_bound(own_noise={"G": ratio})
    held = Held(elsewhere(fit, cost=cost, sigma=sigma))
    found = told_from_their_bounds(fit, held, held.again)
    assert (found.estimates["G"].stderr is None) == doubted
    # each time half-way to the bound, by the logarithm, where chi-squared does not fall
    halves = [10 * 70 ** (1 / 2**k) for k in range(1 if doubted else 5)]
    assert [value for _, value in held.fixed] == pytest.approx(halves)


@pytest.mark.parametrize(
    ("printed", "there", "gone"),
    [
        # at a rise of 1 the region there is 2 errors times the root of 3/4, and 2 of its own here: 1.25 of these may be
        ({"stderr": 0.1}, {"value": 3.07, "stderr": 0.1}, False),
        ({"stderr": 0.1}, {"value": 3.08, "stderr": 0.1}, True),
        ({"stderr": 0.1}, {"value": 3.0, "stderr": 0.14}, False),
        ({"stderr": 0.1}, {"value": 3.0, "stderr": 0.15}, True),
        ({"stderr": None, "interval": (2.9, 3.4)}, {"value": 3.3, "stderr": 0.1}, False),
        ({"stderr": None, "interval": (2.9, 3.4)}, {"value": 3.4, "stderr": 0.1}, True),
        ({"stderr": None, "interval": (2.9, 3.4)}, {"value": 2.9, "stderr": 0.1}, True),
    ],
)
def test_an_error_is_no_error_where_the_region_off_the_bound_reaches_beyond_it(printed, there, gone):
    """A solar cell whose resistance rests at its upper bound: nVt 1.418 +- 0.038 covered the truth in 0.77 of fits."""
    here = replace(on_its_bound().estimates["H"], **printed)
    fit = on_its_bound()
    fit = replace(fit, estimates={**fit.estimates, "G": replace(fit.estimates["G"], stderr=None), "H": here})
    other = replace(elsewhere(fit, cost=101.0), initial=fit.initial)
    other = replace(other, estimates={**other.estimates, "H": replace(here, interval=None, **there)})
    held = Held(other)
    found = told_from_their_bounds(fit, held, held.again)
    assert (found.estimates["H"].stderr, found.estimates["H"].interval) == (
        (None, None) if gone else (here.stderr, here.interval)
    )


@pytest.mark.parametrize("other", [None, "not converged"])
def test_a_fit_that_cannot_be_made_says_nothing(other):
    fit = on_its_bound()
    held = Held(None if other is None else elsewhere(fit, converged=False))
    assert told_from_their_bounds(fit, held, held.again) is fit


def test_what_was_not_seen_in_time_is_said(monkeypatch):
    """A stiff culture of 23 samples: the look behind a bound took four times as long as the fit."""
    fit = on_its_bound()
    monkeypatch.setattr(behind_a_bound, "_SECONDS", -5.0)

    class Slow(Held):
        def again(self, changes):
            ask()
            raise AssertionError("there was time")

    held = Slow(elsewhere(fit))
    found = told_from_their_bounds(fit, held, held.again)
    assert found.estimates == fit.estimates
    assert found.messages[-1].startswith(
        "the errors are those with C on its bound; whether the data allow it"
    )
    with pytest.raises(TimeUp), Deadline(-1.0):  # that of who has asked is his
        told_from_their_bounds(fit, held, held.again)


def test_no_other_fit_where_nothing_rests_on_a_bound():
    fit = on_its_bound()
    inside = replace(
        fit, estimates={name: replace(one, at_bound=False) for name, one in fit.estimates.items()}
    )
    held = Held(elsewhere(fit))
    assert told_from_their_bounds(inside, held, held.again) is inside
    assert held.fixed == []


def test_a_fit_that_hardly_follows_its_data_is_not_looked_at_behind_its_bounds():
    """A growth curve in 24 samples took a minute of it, at an optimum that was wrong by 43 times the noise."""
    coloured = ("the residual of a/T is not white (neighbours correlate by 0.9)",)
    fit = replace(on_its_bound(), fit_percent={"a": {"T": {"simulation": 20.0}}}, messages=coloured)
    held = Held(elsewhere(fit))
    assert told_from_their_bounds(fit, held, held.again) is fit
    assert held.fixed == []


class Risen(Held):
    """Fits that rise with a power of the distance from the bound."""

    def __init__(self, other, power):
        super().__init__(other)
        self.power = power

    def again(self, changes):
        far = self.fixed[-1][1] - 10
        return replace(elsewhere(self.other), cost=100 + 0.05 * far**self.power)


@pytest.mark.parametrize("power", [0.6, 1.0, 2.0])
def test_a_far_start_is_left_for_a_place_that_the_data_allow(power):
    """Whatever the power with which chi-squared rises, a few fits lead to a place within the 95 % region."""
    fit = on_its_bound(start={"C": 1e4, "G": 4.0, "H": 3.0})
    held = Risen(fit, power)
    found = told_from_their_bounds(fit, held, held.again)
    assert found.estimates["G"].stderr is None
    assert 2 <= len(held.fixed) <= 5
    far = held.fixed[-1][1] - 10
    assert 0.05 * far**power <= 4


def test_from_a_start_on_the_bound_the_search_behind_it_begins_at_the_other_bound():
    fit = on_its_bound(start={"C": 10.0, "G": 4.0, "H": 3.0})
    held = Held(elsewhere(fit, cost=101.5), bounds=(10.0, 800.0))
    found = told_from_their_bounds(fit, held, held.again)
    assert held.fixed == [("C", pytest.approx(800.0))]
    assert found.estimates["G"].stderr is None
    without = Held(elsewhere(fit, cost=101.5), bounds=(10.0, np.inf))
    assert told_from_their_bounds(fit, without, without.again) is fit


def oven(seed):
    """A plate that warms the air of a chamber, which alone is measured: 500 samples, noise of a colour."""
    rng = np.random.default_rng(seed)
    levels, lengths = rng.uniform(0, 600, 40), rng.integers(15, 60, 40)
    room = np.interp(np.arange(500), np.arange(0, 500, 25), 295 + 3 * rng.standard_normal(20))
    drives = np.column_stack([np.repeat(levels, lengths)[:500], room])
    a = np.array([[-4.0 / 900, 4.0 / 900], [4.0 / 2500, -7.0 / 2500]])
    b = np.array([[1 / 900, 0.0], [0.0, 3.0 / 2500]])
    a, b, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 2))), 10.0)
    x = [np.array([296.0, 296.0])]
    for u in drives[:-1]:
        x.append(a @ x[-1] + b @ u)
    air = np.array(x)[:, 1]
    noise = lfilter([0.8], [1.0, -0.6], rng.standard_normal(500)) * np.std(air) * 10 ** (-24 / 20)
    channels = {"W": drives[:, 0], "T0": drives[:, 1], "T": air + noise}
    return ce.Experiment.from_arrays(
        "a", time=10.0 * np.arange(500), units={"W": "W", "T0": "K", "T": "K"}, hold="zero", **channels
    )


def test_a_heater_whose_capacity_the_air_hardly_tells():
    """Of the plate's capacity and conductance the air tells the ratio: conductances had been 50 errors off."""
    b = ce.Blueprint("oven")
    start = {"Ch": 700.0, "Ca": 3400.0, "Gh": 6.0, "Ga": 4.0}
    bounds = {"Ch": ("J/K", 10.0), "Ca": ("J/K", 10.0), "Gh": ("W/K", 0.0), "Ga": ("W/K", 0.0)}
    ch, ca, gh, ga = (b.parameter(n, start[n], unit=u, min=low) for n, (u, low) in bounds.items())
    plate, air = b.state("plate", unit="K", scale=300), b.state("air", unit="K", scale=300)
    heat, room = b.input("W", unit="W"), b.input("T0", unit="K")
    b.ode("plate", (heat - gh * (plate - air)) / ch)
    b.ode("air", (gh * (plate - air) - ga * (air - room)) / ca)
    b.output("T", air, unit="K")
    model, truth, held = b.model(), {"Ch": 900.0, "Ca": 2500.0, "Gh": 4.0, "Ga": 3.0}, 0
    for seed in SEEDS:
        fit = ce.estimate(model, oven(seed), progress=False)
        if fit.estimates["Ch"].at_bound:
            held += 1
            assert any(words.startswith(f"Ch {NOT_TOLD}") for words in fit.messages)
            assert "rests on its bound: widen it" not in " ".join(str(fit).split())
        for name, true in truth.items():
            error = fit.estimates[name].stderr
            assert error is None or abs(fit.values[name] - true) < 4 * error
    assert held


class Lower(Held):
    """Inside, chi-squared is lower; from there a search ends inside too."""

    def again(self, changes):
        if changes["warm"] is None:
            return self.other
        assert changes["warm"] is self.other
        assert changes["parameters"] is self
        return replace(
            self.other,
            estimates={
                name: replace(one, at_bound=False, stderr=0.2) for name, one in self.other.estimates.items()
            },
        )


def test_a_lower_optimum_inside_takes_the_place_of_the_one_on_the_bound():
    fit = on_its_bound()
    held = Lower(elsewhere(fit, cost=95.0))
    found = told_from_their_bounds(fit, held, held.again)
    assert (found.cost, found.values["C"], found.estimates["C"].stderr) == (95.0, 700.0, 0.2)
    alike = Lower(elsewhere(fit, cost=99.95))
    assert told_from_their_bounds(fit, alike, alike.again).estimates["G"].stderr is None


class Valley(Held):
    """As high as on the bound up to a place from which on the others are elsewhere."""

    def again(self, changes):
        there = elsewhere(self.other, cost=101.0)
        return there if self.fixed[-1][1] > 1000 else replace(self.other, cost=101.0)


def test_a_place_that_says_nothing_leads_on_away_from_the_bound():
    fit = on_its_bound()
    held = Valley(fit, bounds=(10.0, 1e6))
    found = told_from_their_bounds(fit, held, held.again)
    places = [value for _, value in held.fixed]
    assert places == sorted(places)
    assert places[0] == pytest.approx(700)
    assert places[-1] > 1000
    assert found.estimates["G"].stderr is None
    assert _further(10.0, -2.0, SimpleNamespace(min=0.0, max=10.0), by_logarithm=True) == -2.25  # no log of 0
    assert _further(10.0, 5.0, SimpleNamespace(min=10.0, max=math.inf), by_logarithm=False) == 5.625
    near = Valley(fit, bounds=(10.0, 700.0))  # which is the other bound
    assert told_from_their_bounds(fit, near, near.again) is fit
    assert len(near.fixed) == 1
