"""Models that are far from the motion: what follows it shows what the library's effects are worth, and fresh data tell
functions from each other."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import additions, law_on_fresh, law_race, law_refit
from casadi_engine.discrepancy.elsewhere_families import unused_everywhere
from casadi_engine.discrepancy.exchange import is_rounding
from casadi_engine.discrepancy.families import costs_of, families_of
from casadi_engine.discrepancy.law_step import in_place_of_function
from casadi_engine.discrepancy.random_families import TIME, smooth_family


def surge():
    """A tank at the end of a tunnel, without what the tunnel loses: it swings for ever."""
    b = ce.Blueprint("surge")
    inertance = b.parameter("I", 6.3e4, unit="Pa s2/m3", min=1e3)
    area = b.parameter("A", 24.0, unit="m2", min=1)
    flow, level = b.state("Q", unit="m3/s"), b.state("z", unit="m")
    drawn = b.input("q", unit="m3/s")
    b.input("valve", unit="1")  # recorded, and in no equation
    tunnel = b.port("tunnel", "inertia", {"speed": flow})
    b.ode("Q", (tunnel - 9810.0 * level) / inertance)
    b.ode("z", (flow - drawn) / area)
    b.output("y", level, unit="m")
    return b.model()


def surged(seed, name):
    """By SciPy: 5e4 Pa s2/m3, 20 m2, and a loss of 180 Pa s2/m6."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 800.0, 4.0)
    held = np.repeat(rng.choice([2.0, 5.0, 8.0, 12.0], 20), 10)
    drawn = np.convolve(np.pad(held, 2, mode="edge"), np.ones(5) / 5, mode="valid")

    def ode(t, x):
        return [(-9810 * x[1] - 180 * x[0] * abs(x[0])) / 5e4, (x[0] - np.interp(t, time, drawn)) / 20]

    start = [drawn[0], -180 * drawn[0] ** 2 / 9810]
    level = solve_ivp(ode, (0, 800), start, t_eval=time, rtol=1e-9, atol=1e-9, max_step=4.0).y[1]
    noisy = level + 0.1 * rng.standard_normal(len(time))
    units = {"q": "m3/s", "valve": "1", "y": "m"}
    valve = np.repeat(rng.random(20), 10)
    return ce.Experiment.from_arrays(name, time=time, units=units, q=drawn, valve=valve, y=noisy)


@pytest.fixture(scope="module")
def began():
    """The refits of the surge tank before its first round."""
    kept = []

    class AskedError(Exception):
        """The search got there."""

    def kept_and_ended(self):
        kept.append(self)
        raise AskedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(additions.Additions, "run", kept_and_ended)
        with pytest.raises(AskedError):
            ce.repair(surge(), surged(1, "data"), starts=1, progress=False)
    return kept[0]


def test_one_step_in_the_place_of_a_function_tells_the_law_that_it_stands_for(began):
    """Along the simulation of the model without the loss it comes behind offsets and steps."""
    refits, screened = began.refits, began.station.screened
    families = families_of(screened)
    functions = law_refit.leading(refits)
    assert ("tunnel", "speed") in functions
    step, start, least = in_place_of_function(refits, functions, screened, families)
    cost = costs_of(screened, step, families)
    assert min(cost, key=cost.__getitem__) == ("quadratic_drag", "tunnel")
    assert cost["quadratic_drag", "tunnel"] < 2 * least
    others = [own for key, own in cost.items() if key[0] != "quadratic_drag"]
    assert min(others) > 3 * cost["quadratic_drag", "tunnel"]
    assert set(start.values) == {"I", "A"}
    assert start.values["I"] == pytest.approx(5e4, rel=0.1)
    assert in_place_of_function(refits, [("tunnel", "nothing")], screened, families) is None


def test_it_is_the_first_that_is_refitted_then(began):
    made = additions.Additions(began.refits, began.here, began.station, {}, lambda words: None)
    made.screened, made.families = began.station.screened, families_of(began.station.screened)
    rest, done = made._in_turn(list(made.families), None, np.inf)
    assert done
    assert rest[0] == ("quadratic_drag", "tunnel")
    assert made.left_out  # what comes nowhere near by that step
    assert not set(rest) & set(made.left_out)


def test_nothing_leads_where_nothing_is_left_to_refit(began):
    made = additions.Additions(began.refits, began.here, began.station, {}, lambda words: None)
    made.screened, made.families = began.station.screened, families_of(began.station.screened)
    assert made._in_turn([], None, np.inf) == ([], True)


def test_functions_have_as_long_as_refits_have_taken(began, monkeypatch):
    """Beside a model that is refitted in no time they took half a minute."""
    made = additions.Additions(began.refits, began.here, began.station, {}, lambda words: None)
    asked = []

    def slow(self, rest, best):
        asked.append(rest)
        raise additions.TimeUp

    monkeypatch.setattr(additions.Additions, "_led", slow)
    assert made._in_turn([("a", "b")], None, np.inf) == ([("a", "b")], False)
    monkeypatch.setattr(additions, "late", lambda: True)
    with pytest.raises(additions.TimeUp):
        made._in_turn([("a", "b")], None, np.inf)
    assert len(asked) == 2


def test_inputs_that_act_on_nothing_are_asked_where_something_may_act():
    found = {(one.port, one.signal) for one in unused_everywhere(surge(), ["I"])}
    assert found == {("tunnel", "valve"), ("parameter_I", "valve")}


def test_short_windows_that_the_model_follows_tell_no_function(began):
    race, none = law_race.Race.of(began.refits), began.refits.pool[frozenset()]
    assert law_race.tells(began.refits, none)
    kept = race.plain[none.key]
    race.plain[none.key] = (1.1 * kept[1], kept[1])
    try:
        assert not law_race.tells(began.refits, none)
        assert law_refit.leading(began.refits) == []
    finally:
        race.plain[none.key] = kept


def test_a_model_that_follows_with_some_function_lacks_no_other_start(began):
    law_refit.leading(began.refits)
    assert law_refit.follows_by_function(began.refits)
    far = stub(race=law_race.Race(whole={("tunnel", "speed"): None}))
    assert not law_refit.follows_by_function(far)


def test_fresh_data_tell_a_function_of_what_acts_from_one_of_time(began):
    """In one record a function of time does what any other does; in the next it has to be another one, and is paid for
    again."""
    refits = began.refits
    none = refits.pool[frozenset()]
    blank = np.array([0.0, 1.0])
    law = smooth_family("tunnel", "speed", blank)
    drift = smooth_family("sensor_y", TIME, blank)
    setups = [
        *(one for one in law_race.setups_at(refits, none, refits.refitter.model.ports["tunnel"])),
        *law_race.setups_elsewhere(refits, none, drift),
    ]
    found = []
    for setup in setups:
        begun = law_race.short(refits, none, setup.model, setup.parameters)
        found.append(law_race.followed(refits, law_race.Begun(setup, *begun)))
    assert [one.setup.at for one in found] == [("tunnel", "speed"), ("sensor_y", TIME)]
    both = law_on_fresh.by_all_data(refits, found, [surged(2, "fresh")])
    assert [one.setup.at for one in both] == [("tunnel", "speed"), ("sensor_y", f"{TIME} of each record")]
    assert len(both[1].setup.terms) == 2 * len(found[1].setup.terms)
    alone, together = ([one.log(own[0].levels)[0] for one in own] for own in (found, both))
    assert together[0] - together[1] > alone[0] - alone[1] > 0
    assert law_on_fresh.by_all_data(refits, found, []) is None
    assert law_on_fresh.by_all_data(refits, found[:1], [surged(2, "fresh")]) is None
    assert law.port == "tunnel"


def test_fresh_data_are_asked_of_functions_that_they_may_yet_prefer():
    """Functions that the data of the search exclude for good cost as much again there."""

    def followed(left, odds):
        return stub(left=left, levels="levels", log=lambda levels: (odds, None))

    best, near, far = followed(1.0, 0.0), followed(2.0, -8.9), followed(3.0, -9.1)
    assert law_refit._open([far, best, near]) == [best, near]
    assert law_refit._open([far]) == [far]
    assert law_refit._open([]) == []


def corner(name, port="p", shape=(), signal="v"):
    effect = stub(nuisance=dict.fromkeys(shape))
    candidate = stub(key=(name, port), port=port, source=stub(effect=effect), signal=signal)
    return stub(candidate=candidate, key=f"{port}.{name}")


@pytest.mark.parametrize(
    ("felt", "gain", "held", "port", "is_it"),
    [
        (0.0, 5.0, (), "p", False),  # nothing is felt of corners
        (40.0, 30.0, (), "p", True),  # no more than sharper ones may gain
        (40.0, 300.0, (), "p", False),
        (np.nan, 300.0, ("p.fading.speed",), "p", True),  # not known, and a shape at its bound
        (np.nan, 300.0, (), "p", False),
        (40.0, 30.0, (), "elsewhere", False),
    ],
)
def test_what_only_sharpens_a_rounded_corner_is_no_effect(monkeypatch, felt, gain, held, port, is_it):
    """Friction that fades within the width of the corner of dry friction was named beside it."""
    monkeypatch.setattr("casadi_engine.discrepancy.exchange.moving", lambda candidate: {candidate.signal})
    dry, fading = corner("dry"), corner("fading", port, ("speed",))
    here = stub(key=frozenset({dry.candidate.key}), effects=(dry,), arrived=stub(cost=1000.0))
    one = stub(
        key=here.key | {fading.candidate.key}, effects=(dry, fading), newest=lambda _: fading,
        arrived=stub(cost=1000.0 - gain, held=frozenset(held)),
    )  # fmt: skip
    refits = stub(rounding_felt=lambda effects: felt, path=stub(cornered=lambda effects: True))
    assert is_rounding(refits, here, one) is is_it
    assert not is_rounding(refits, one, here)
