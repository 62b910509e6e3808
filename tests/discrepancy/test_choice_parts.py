"""Parts of the choice by stand-ins: which structure leads where the time was up, fits made anew, and the way there."""

import math
from types import SimpleNamespace as stub

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.discrepancy import choice as module
from casadi_engine.discrepancy import ways
from casadi_engine.discrepancy.choice import BEYOND, FACTOR, TIME_UP, Choice
from casadi_engine.discrepancy.screening import screen
from tests.quick import few

PRICE = 2.0
NONE = frozenset()


def key_of(*names):
    return frozenset((name, "p") for name in names)


def tried(*names, log=0.0, beyond=BEYOND + 1, failed=False):
    """A structure of effects of these names."""
    effects = tuple(
        stub(candidate=stub(key=(name, "p")), key=f"p.{name}", label=name, nuisance={}, width=None)
        for name in names
    )
    arrived = stub(values={}, initial={})
    return stub(
        key=key_of(*names), effects=effects, log=log, beyond=beyond, failed=failed, arrived=arrived,
        evidence=stub(cost=-2 * log), fresh=0.0,
        label=" + ".join(names),
    )  # fmt: skip


def choice_of(monkeypatch, *structures, best=NONE, refused=()):
    """A choice with these in its pool and none fitted but the model without effects; refused : keys whose whole fit
    does not converge."""
    found = Choice(None, None, 4, print)
    found.refits = stub(
        pool={one.key: one for one in structures}, improved=set(), tried=lambda *_: [], blur=0.0
    )
    found.stations[NONE] = stub(fit="null fit", screened=stub(candidates=[], second_names={}))
    found.best = best
    found.asked = []

    def station(self, one):
        self.asked.append(one.key)
        if one.key not in refused and one.key not in self.stations:
            self.stations[one.key] = stub(
                fit=f"fit of {one.label}", screened=stub(candidates=[], second_names={})
            )
        return self.stations.get(one.key)

    monkeypatch.setattr(Choice, "station_of", station)
    monkeypatch.setattr(Choice, "price", PRICE)
    return found


# ---- where the time was up


@pytest.mark.parametrize(("gain", "leads"), [(1.01, True), (0.99, False)])
def test_a_structure_that_is_far_more_probable_leads_where_the_time_was_up(monkeypatch, gain, leads):
    """By a factor of 20, after every effect is paid for."""
    more = PRICE + gain * math.log(FACTOR)
    structures = tried(log=-500.0), tried("a", log=-100.0), tried("a", "b", log=-100.0 + more)
    found = choice_of(monkeypatch, *structures, best=key_of("a"))
    found.failed["a round"] = TIME_UP
    found._most_probable_of_all()
    assert found.best == (key_of("a", "b") if leads else key_of("a"))
    assert found.asked == ([key_of("a", "b")] if leads else [])


def test_the_most_probable_is_so_after_its_effects_are_paid_for(monkeypatch):
    structures = (
        tried(log=-50.0),
        tried("a", log=0.0),
        tried("a", "b", log=1.5 * PRICE),
        tried("c", log=0.6 * PRICE),
    )
    found = choice_of(monkeypatch, *structures)
    found.failed["a round"] = TIME_UP
    found._most_probable_of_all()
    assert found.best == key_of("c")


def test_a_structure_of_which_an_effect_is_none_does_not_lead(monkeypatch):
    found = choice_of(
        monkeypatch, tried(log=-50.0), tried("a", log=-10.0), tried("a", "b", log=0.0, beyond=BEYOND)
    )
    found.failed["a round"] = TIME_UP
    found._most_probable_of_all()
    assert found.best == key_of("a")


def test_a_structure_whose_whole_fit_does_not_converge_does_not_lead(monkeypatch):
    found = choice_of(
        monkeypatch, tried(log=-50.0), tried("a", log=-20.0), tried("b", log=0.0), best=key_of("a"),
        refused=[key_of("b")],
    )  # fmt: skip
    found.failed["a round"] = TIME_UP
    found._most_probable_of_all()
    assert (found.best, found.asked) == (key_of("a"), [key_of("b")])


def test_where_nothing_else_was_refitted_the_model_stays(monkeypatch):
    found = choice_of(monkeypatch, tried(log=-50.0))
    found.failed["a round"] = TIME_UP
    found._most_probable_of_all()
    assert (found.best, found.asked) == (NONE, [])


@pytest.mark.parametrize(("gain", "leads"), [(1.01, True), (0.99, False)])
def test_where_it_was_not_one_of_fewer_effects_leads_that_is_far_more_probable(monkeypatch, gain, leads):
    """Rounds add effects, and pass by what two others do as well as three."""
    three = tried("a", "b", "c", log=0.0)
    two = tried("d", "c", log=gain * math.log(FACTOR) - PRICE)
    found = choice_of(monkeypatch, tried(log=-500.0), tried("e", log=-300.0), two, three, best=three.key)
    found._most_probable_of_all()
    assert found.best == (two.key if leads else three.key)


def test_a_structure_that_an_exchange_found_is_kept_when_its_corners_are_sharpened(monkeypatch):
    """It has other effects than what the round began with: no addition leads there again."""
    here, added = tried("fading", log=-100.0), tried("fading", "gain", log=-50.0)
    better = tried("dry", "gain", log=0.0)
    found = choice_of(monkeypatch, tried(log=-500.0), here, added, better, best=here.key)
    found.refits.levels = stub(memory={})
    found.refits.settled, found.refits.blunted = (lambda: None), (lambda: False)
    sharp = iter([True, False])
    monkeypatch.setattr(Choice, "_exchanged", lambda self, best, here: better)
    for name in ("_special_cases_of", "_again_without", "_told"):
        monkeypatch.setattr(Choice, name, lambda *_: None)
    monkeypatch.setattr(module, "weak_beside_colour", lambda *_: False)
    monkeypatch.setattr(module, "is_rounding", lambda *_: False)
    monkeypatch.setattr(module, "vanished", lambda *_: False)
    monkeypatch.setattr(module, "simpler", lambda now, *_: now)
    for name in ("in_its_parts", "late_otherwise"):
        monkeypatch.setattr(module, name, lambda _, best, *__: best)
    scores = stub(testable=np.array([True]))
    screened = stub(scores=scores, significant=(0,), noise=stub(colour={}), choice=stub(rounded={}))

    def sharpened(self, best):  # afterwards what was added alone fails, as a special case of the other does
        added.failed, added.log = True, -math.inf
        return next(sharp)

    monkeypatch.setattr(Choice, "_sharpened", sharpened)
    assert found._chosen_of(here, stub(screened=screened), [added]) is better


def test_a_structure_that_was_refitted_meanwhile_is_refused_once(monkeypatch):
    """An exchange had made it anew: its whole fit failed, and the one of before was asked for until the time was up."""
    here, stale = tried("drag", log=-100.0), tried("drag", "step", log=-50.0)
    anew = tried("drag", "step", log=-50.0)
    found = choice_of(monkeypatch, tried(log=-500.0), here, anew, best=here.key, refused=[anew.key])
    found.refits.levels, found.refits.blunted = stub(memory={}), (lambda: False)
    exchanges = []

    def exchanged(self, best, here):
        exchanges.append(best)
        assert len(exchanges) < 5, "the same structure again"
        return anew

    monkeypatch.setattr(Choice, "_exchanged", exchanged)
    for name in ("_special_cases_of", "_again_without", "_told"):
        monkeypatch.setattr(Choice, name, lambda *_: None)
    monkeypatch.setattr(Choice, "_sharpened", lambda *_: False)
    monkeypatch.setattr(
        Choice, "_most_probable", lambda self, made: next((t for t in made if not t.failed), None)
    )
    monkeypatch.setattr(module, "weak_beside_colour", lambda *_: False)
    monkeypatch.setattr(module, "is_rounding", lambda *_: False)
    monkeypatch.setattr(module, "simpler", lambda now, *_: now)
    for name in ("in_its_parts", "late_otherwise"):
        monkeypatch.setattr(module, name, lambda _, best, *__: best)
    scores = stub(testable=np.array([True]))
    screened = stub(scores=scores, significant=(0,), noise=stub(colour={}), choice=stub(rounded={}))
    assert found._chosen_of(here, stub(screened=screened), [stale]) is None
    assert len(exchanges) == 1


FEW = ["coulomb_friction", "constant_torque"]
DRY = frozenset({("coulomb_friction", "pivot")})


@pytest.mark.parametrize("late", few([True, False], True))
def test_a_round_that_the_time_ends_leaves_what_it_has_refitted(pendulum, monkeypatch, late):
    """A real search; where a round ends by itself, what it does not take is no answer."""
    data = pendulum.decay(lambda t, angle, rate: -0.6 * np.tanh(rate / 0.02), samples=300)
    deadline = Deadline(spare=600.0)

    def refits_alone(self, here, station):
        self._added(here, station)
        self.refits.weigh()
        if late:
            deadline.stop()
            raise TimeUp

    monkeypatch.setattr(Choice, "_round", refits_alone)
    fit = ce.estimate(pendulum.model, data, noise=ce.Noise(y=pendulum.level), progress=False)
    made = Choice(pendulum.refitter(data), lambda fit: screen(fit, FEW), 4, lambda _: None, deadline=deadline)
    with deadline:
        made.run(fit)
    assert made.best == (DRY if late else NONE)
    assert (TIME_UP in made.failed.values()) == late
    assert made.chosen.fit.converged


# ---- a fit made anew


def test_what_failed_beside_a_poor_optimum_is_asked_again_beside_a_better_one(monkeypatch):
    here, other = tried("a"), tried("b", failed=True)
    found = choice_of(monkeypatch, tried(), here, other, best=here.key)
    found.stations[here.key] = "the poor one"
    found.refits.improved |= {here.key, other.key}
    assert found._renewed(here).fit == "fit of a"
    assert found.stations[here.key].fit == "fit of a"
    assert not other.failed
    assert found.refits.improved == set()


def test_where_that_fit_does_not_converge_everything_stays(monkeypatch):
    here, other = tried("a"), tried("b", failed=True)
    found = choice_of(monkeypatch, tried(), here, other, best=here.key, refused=[here.key])
    found.stations[here.key] = "the poor one"
    found.refits.improved.add(here.key)
    assert found._renewed(here) is None
    assert found.stations[here.key] == "the poor one"
    assert other.failed


def test_where_no_better_optimum_was_found_nothing_is_fitted(monkeypatch):
    here, other = tried("a"), tried("b", failed=True)
    found = choice_of(monkeypatch, tried(), here, other, best=here.key)
    found.stations[here.key] = "as it was"
    found.refits.improved.add(other.key)
    assert found._renewed(here) is None
    assert (found.asked, other.failed) == ([], True)
    assert found.refits.improved == {other.key}


# ---- the way to a structure


def on_the_way(monkeypatch, known, waits=True):
    """Effects a and b, of which a is the more telling; known : names of effects -> names of candidates there."""
    structures = [tried(log=-50.0), tried("a", log=-20.0), tried("b", log=-30.0), tried("a", "b", log=0.0)]
    found = choice_of(monkeypatch, *structures)
    for names, candidates in known.items():
        own = [stub(key=(name, "p")) for name in candidates]
        screened = stub(candidates=own, choice=stub(waits=waits), second_names={})
        found.stations[key_of(*names)] = stub(fit=names, screened=screened)
    monkeypatch.setattr(ways, "reached", lambda before, station, own, members: station)
    return found


def test_the_way_has_a_station_for_every_effect(monkeypatch):
    found = on_the_way(monkeypatch, {(): "ab", ("a",): "b", ("a", "b"): ""})
    assert [one.fit for one in found.way(key_of("a", "b"))] == [(), ("a",), ("a", "b")]
    assert [one.fit for one in found.way(NONE)] == [()]


def test_where_the_time_is_up_the_way_is_the_best_of_which_every_part_is_fitted(monkeypatch):
    """No fit is made: in another order the parts may be there, and else a structure of fewer effects is the answer."""
    found = on_the_way(monkeypatch, {(): "ab", ("b",): "a", ("a", "b"): ""})
    assert [one.fit for one in ways.way_so_far(found)] == [(), ("b",), ("a", "b")]
    found = on_the_way(monkeypatch, {(): "ab", ("b",): "a"})
    assert [one.fit for one in ways.way_so_far(found)] == [(), ("b",)]
    found = on_the_way(monkeypatch, {(): "ab", ("a", "b"): ""})  # neither of its parts is
    assert [one.fit for one in ways.way_so_far(found)] == [()]
    found = on_the_way(monkeypatch, {(): "b", ("a",): ""})  # an effect that does nothing of its own
    assert [one.fit for one in ways.way_so_far(found)] == [()]
    assert found.asked == []


def test_what_fresh_data_prefer_is_scored_in_the_colour_of_its_noise_as_the_chosen_one_is(monkeypatch):
    found = on_the_way(monkeypatch, {(): "ab", ("a",): "b", ("a", "b"): ""}, waits=False)
    coloured = []
    monkeypatch.setattr(Choice, "_in_colour", lambda self, key: coloured.append(key))
    found.way(key_of("a", "b"))
    assert coloured == [key_of("a", "b")]
    found.way(NONE)
    assert coloured[1:] == [NONE]


@pytest.mark.parametrize(
    ("known", "fitted"),
    [({(): "b", ("b",): "c"}, ["b"]), ({(): "ab", ("a",): "c", ("b",): "c"}, ["a", "b"]), ({(): ""}, [])],
)
def test_there_is_no_way_by_an_effect_that_is_no_candidate_at_the_station_before(monkeypatch, known, fitted):
    """It does nothing of its own there, so that nothing can be said of it."""
    found = on_the_way(monkeypatch, known)
    assert found.way(key_of("a", "b")) is None
    assert found.asked == [key_of(name) for name in fitted]


def test_there_is_another_way_where_one_effect_alone_has_no_fit(monkeypatch):
    """A slow thermometer and a wrong capacity: the fit with the thermometer alone ran to a bound, and the pair, 1e5
    times as probable by fresh data, was given up."""
    found = on_the_way(monkeypatch, {(): "ab", ("b",): "a", ("a", "b"): ""})
    plain = Choice.station_of
    monkeypatch.setattr(
        Choice, "station_of", lambda self, one: None if one.key == key_of("a") else plain(self, one)
    )
    assert [one.fit for one in found.way(key_of("a", "b"))] == [(), ("b",), ("a", "b")]
    # where it does nothing of its own at first, but beside the other one it does
    found = on_the_way(monkeypatch, {(): "b", ("b",): "a", ("a", "b"): ""})
    assert [one.fit for one in found.way(key_of("a", "b"))] == [(), ("b",), ("a", "b")]


def test_no_other_way_is_tried_once_the_time_is_up(monkeypatch):
    found = on_the_way(monkeypatch, {(): "ab", ("b",): "a", ("a", "b"): ""})
    monkeypatch.setattr(Choice, "station_of", lambda self, one: found.asked.append(one.key))
    monkeypatch.setattr(ways, "late", lambda: True)
    assert found.way(key_of("a", "b")) is None
    assert found.asked == [key_of("a")]


def test_there_is_no_way_by_a_fit_that_does_not_converge(monkeypatch):
    found = on_the_way(monkeypatch, {(): "ab"})
    monkeypatch.setattr(Choice, "station_of", lambda self, one: None)
    assert found.way(key_of("a", "b")) is None


@pytest.mark.parametrize(("weak", "leads"), [((), "b"), (("b",), "c"), (("b", "c"), "a")])
def test_two_effects_that_are_no_findings_beside_their_colour_stand_in_no_ones_place(
    monkeypatch, weak, leads
):
    """A force and a load, each within twice its error, were more probable than the friction that does the same."""
    one = tried("a", log=-100.0)
    pairs = {"b": tried("b", "d", log=-50.0), "c": tried("c", "d", log=-60.0)}
    found = choice_of(monkeypatch, tried(log=-500.0), one, *pairs.values(), best=one.key)
    found.refits.weigh = lambda: None
    monkeypatch.setattr(module, "families_of", lambda screened: {})
    monkeypatch.setattr(module, "tried_in_two", lambda *_: list(pairs.values()))
    gone = [pairs[name] for name in weak]
    monkeypatch.setattr(module, "weak_beside_colour", lambda refits, other: other in gone)
    monkeypatch.setattr(Choice, "_exchanged", lambda self, best, here: best)
    found._in_two()
    assert found.best == (one if leads == "a" else pairs[leads]).key
    assert [name for name in pairs if pairs[name].failed] == list(weak)


@pytest.mark.parametrize(("fits", "leads"), [(True, "c"), (False, "b")])
def test_each_of_two_effects_in_the_place_of_one_is_exchanged(monkeypatch, fits, leads):
    """A step at the evaporator and a slow sensor stood for a step in the air and that sensor, "confirmed"."""
    pair, better = tried("b", "d", log=-50.0), tried("c", "d", log=-40.0)
    found = choice_of(monkeypatch, tried(log=-500.0), one := tried("a", log=-100.0), pair, best=one.key)
    found.refits.weigh = lambda: None
    monkeypatch.setattr(module, "families_of", lambda screened: {})
    monkeypatch.setattr(module, "tried_in_two", lambda *_: [pair])
    monkeypatch.setattr(module, "weak_beside_colour", lambda *_: False)
    monkeypatch.setattr(Choice, "_exchanged", lambda *_: better)
    plain = Choice.station_of
    monkeypatch.setattr(
        Choice, "station_of", lambda self, t: (stub() if fits else None) if t is better else plain(self, t)
    )
    found._in_two()
    assert found.best == {"b": pair, "c": better}[leads].key


# ---- a round whose effect does nothing on fresh data


def in_rounds(monkeypatch, *structures):
    """A choice whose rounds find these, one after the other."""
    found = choice_of(monkeypatch, tried(log=-500.0), *structures)
    found.stations |= {t.key: stub(screened=stub()) for t in structures}
    found.refits.weigh = found.refits.exactly = lambda *_: None
    found.refits.known = {}
    made, preferred = iter((*structures, None)), []
    monkeypatch.setattr(Choice, "_asks", lambda *_: True)
    monkeypatch.setattr(Choice, "_by_windows", lambda *_: None)
    monkeypatch.setattr(Choice, "_round", lambda *_: next(made))
    monkeypatch.setattr(Choice, "_most_probable_first", lambda *_: None)
    monkeypatch.setattr(Choice, "_in_two", lambda *_: None)
    monkeypatch.setattr(module, "special_cases", lambda *_: None)
    monkeypatch.setattr(module, "known_twins", lambda *_: None)
    monkeypatch.setattr(Choice, "prefer", lambda self, key, without: preferred.append((key, without)))
    return found, preferred


@pytest.mark.parametrize("idle", [False, True])
def test_a_round_whose_effect_fresh_data_would_leave_out_is_the_last(monkeypatch, idle):
    found, preferred = in_rounds(
        monkeypatch,
        tried("a", log=-100.0),
        tried("a", "b", log=-50.0),
        tried("a", "b", "c", log=-10.0),
    )
    monkeypatch.setattr(Choice, "_another", lambda *_: None)
    asked = []

    def told(key):
        asked.append(key)
        return key_of("b") if idle else NONE

    found.idle_on_fresh = told
    found._rounds(found.pool[NONE])
    if idle:
        assert asked == [key_of("a", "b")]  # the first effect is judged in the end alone
        assert preferred == [(key_of("a"), key_of("b"))]
        assert found.best == key_of("a")
    else:
        assert asked == [key_of("a", "b"), key_of("a", "b", "c")]
        assert preferred == []
        assert found.best == key_of("a", "b", "c")


def test_what_closes_a_part_of_the_gap_takes_the_place_of_what_fresh_data_would_leave_out(monkeypatch):
    """A delay of half a sample was more probable than friction that fades, and does nothing one can see elsewhere."""
    found, preferred = in_rounds(monkeypatch, tried("a", log=-100.0), tried("a", "b", log=-50.0))
    other = tried("a", "c", log=-60.0)
    found.refits.pool[other.key] = other
    found.stations[other.key] = stub(screened=stub())
    monkeypatch.setattr(Choice, "_another", lambda self, here: other)
    found.idle_on_fresh = lambda key: key_of("b") if key == key_of("a", "b") else NONE
    found._rounds(found.pool[NONE])
    assert preferred == [(key_of("a"), key_of("b"))]
    assert found.best == key_of("a", "c")


def test_what_leaves_more_than_the_stated_noise_is_not_held_against_fresh_data_yet(monkeypatch):
    found, preferred = in_rounds(monkeypatch, tried("a", log=-100.0), tried("a", "b", log=-50.0))
    monkeypatch.setattr(module, "leaves_more", lambda refits, one: True)
    monkeypatch.setattr(Choice, "_from_others", lambda self: None)
    found.idle_on_fresh = lambda key: key_of("b")
    found._rounds(found.pool[NONE])
    assert preferred == []
    assert found.best == key_of("a", "b")


@pytest.mark.parametrize("cost", [5.0, 150.0])
def test_a_search_goes_on_from_other_structures_where_nothing_helps_beside_the_best(monkeypatch, cost):
    """Two effects that bend to the place of a third leave none for it; from two others it is found, or nothing is."""
    first, pair, other = tried("a", log=-100.0), tried("a", "b", log=-50.0), tried("b", "c", log=-60.0)
    far, three = tried("a", "d", log=-70.0), tried("b", "c", "d", log=-10.0)
    for one, size in ((first, 900.0), (pair, 100.0), (other, 120.0), (far, 201.0), (three, cost)):
        one.arrived = stub(cost=size)
    found, _ = in_rounds(monkeypatch, first, pair)
    found.most = 4
    found.refits.pool |= {other.key: other, far.key: far}
    begun = []

    def grown(self, here):
        begun.append(here.key)
        if here is other:
            self.refits.pool[three.key], self.best = three, three.key

    monkeypatch.setattr(module, "leaves_more", lambda refits, one: True)
    monkeypatch.setattr(Choice, "station_of", lambda self, one: stub())
    monkeypatch.setattr(Choice, "_grown", grown)
    found.best = pair.key
    found._from_others()
    assert begun == [other.key]
    assert found.best == (three.key if cost < 100 else pair.key)


@pytest.mark.parametrize(("cost", "chosen"), [(80.0, True), (82.0, False)])
def test_only_what_closes_a_tenth_of_the_gap_is_another(monkeypatch, cost, chosen):
    here, other = tried("a", log=-100.0), tried("a", "c", log=-60.0)
    here.arrived, other.arrived = stub(cost=100.0), stub(cost=cost)
    found = choice_of(monkeypatch, tried(log=-500.0), here, other)
    found.stations[here.key] = stub(screened=stub())
    monkeypatch.setattr(Choice, "_chosen_of", lambda self, own, station, made: made[0])
    assert found._another(here) is (other if chosen else None)


@pytest.mark.parametrize("linear", [False, True])
def test_what_a_step_left_out_is_refitted_where_the_leader_is_refused(monkeypatch, linear):
    """A step in the place of a load step said that friction comes to nothing, and the load step was no answer."""
    here, lead, other = tried(log=-100.0), tried("step", log=-120.0), tried("dry", log=-10.0)
    found = choice_of(monkeypatch, here, lead, other, best=here.key)
    found.refits.path, found.refits.weigh = stub(linear=linear), lambda *_: None

    def added(self, here, station, *, again=False):
        self._left_out = () if again else (("dry at pivot", 200.0),)
        return [other] if again else [lead]

    monkeypatch.setattr(Choice, "_added", added)
    monkeypatch.setattr(Choice, "_without_idle", lambda *_: [])
    monkeypatch.setattr(
        Choice, "_chosen_of", lambda self, here, station, ready: other if other in ready else None
    )
    assert found._round(here, stub()) is (None if linear else other)
