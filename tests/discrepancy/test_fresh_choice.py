"""Effects beside what no effect explains are confirmed one by one: by stand-ins for fits and fresh data."""

from types import SimpleNamespace as stub

import pytest

from casadi_engine.deadline import TimeUp
from casadi_engine.discrepancy import fresh_choice as module
from casadi_engine.discrepancy.fresh import Judgement
from casadi_engine.discrepancy.fresh_choice import FreshChoice

WORDS = "{} is left out: more is missing than effects explain, and fresh data do not confirm it by itself"


def stations_of(names, events=()):
    """The model without effects, and one with each further effect."""
    effects = tuple(stub(label=name, name=name, moves=name in events) for name in names)
    return [
        stub(fit=f"fit {count}", effects=effects[:count], screened=f"screened {count}", lead=None)
        for count in range(len(names) + 1)
    ]


def confirmed(monkeypatch, stations, says, *, missing=True, unfit=False, unseen=(), lost=()):
    """What is left of the stations, what is said, and which were held against each other.

    says : name of the last effect -> what fresh data say of it; missing : whether more is missing than effects
    explain, in the data of the search; unfit : in the fresh ones; unseen : names of those that close nothing that a
    person sees; lost : fits that cannot be simulated on the fresh data
    """
    asked = []

    def judged(self, old, new, here):
        asked.append((old, new))
        return Judgement(None, says[here.effects[-1].label])

    seen = []
    monkeypatch.setattr(
        module, "unknown_of", lambda one: seen.append(one) or ("something" if missing else None)
    )
    monkeypatch.setattr(FreshChoice, "_on_fresh", lambda self, one: None if one.fit in lost else one.fit)
    monkeypatch.setattr(FreshChoice, "_judged", judged)
    monkeypatch.setattr(FreshChoice, "_misfit", lambda self, one, pairs, **_: 2.0 if unfit else 1.0)
    monkeypatch.setattr(
        FreshChoice, "_seen", lambda self, old, new, here: here.effects[-1].label not in unseen
    )
    monkeypatch.setattr(module, "_seen_by_itself", lambda base, last: last.effects[-1].label not in unseen)
    said = []
    found = FreshChoice(None, None, print, said)._each_confirmed(stations)
    assert all(one in [station.screened for station in stations] for one in seen)
    return found, said, asked


def test_an_effect_that_fresh_data_do_not_confirm_by_itself_is_left_out(monkeypatch):
    stations = stations_of(["dry", "drag"])
    found, said, asked = confirmed(monkeypatch, stations, {"drag": False})
    assert found == stations[:2]
    assert said == [WORDS.format("drag")]
    assert asked == [("fit 1", "fit 2")]  # against the structure without it


def test_the_last_effects_go_one_by_one_up_to_one_that_is_confirmed(monkeypatch):
    stations = stations_of(["dry", "drag", "offset", "gain"])
    says = {"gain": False, "offset": False, "drag": True, "dry": False}
    found, said, asked = confirmed(monkeypatch, stations, says)
    assert found == stations[:3]
    assert said == [WORDS.format("gain"), WORDS.format("offset")]
    assert asked == [("fit 3", "fit 4"), ("fit 2", "fit 3"), ("fit 1", "fit 2")]


def test_the_first_effect_is_held_against_none_elsewhere(monkeypatch):
    stations = stations_of(["dry", "drag"])
    found, _, asked = confirmed(monkeypatch, stations, {"drag": False, "dry": False})
    assert found == stations[:2]
    assert len(asked) == 1
    for few in (stations[:1], stations[:2]):
        assert confirmed(monkeypatch, few, {}) == (few, [], [])


def test_where_nothing_more_is_missing_all_of_them_stay(monkeypatch):
    stations = stations_of(["dry", "drag"])
    assert confirmed(monkeypatch, stations, {"drag": False}, missing=False) == (stations, [], [])


@pytest.mark.parametrize("answer", [True, None])
def test_what_fresh_data_confirm_or_cannot_tell_of_stays(monkeypatch, answer):
    stations = stations_of(["dry", "drag"])
    found, said, asked = confirmed(monkeypatch, stations, {"drag": answer})
    assert (found, said, len(asked)) == (stations, [], 1)


def test_an_event_stays_which_no_other_record_can_confirm(monkeypatch):
    stations = stations_of(["dry", "load"], events=["load"])
    assert confirmed(monkeypatch, stations, {"load": None})[:2] == (stations, [])


@pytest.mark.parametrize("missing", [True, False])
def test_where_more_is_missing_an_effect_stays_only_if_a_person_sees_it(monkeypatch, missing):
    """What is beyond chance, and a hundredth of what nothing explains, bends to that."""
    stations = stations_of(["dry", "drag"])
    given = {"missing": missing, "unfit": not missing, "unseen": ["drag"]}
    found, said, _ = confirmed(monkeypatch, stations, {"drag": True}, **given)
    assert found == stations[:2]
    assert said == [
        "drag is left out: more is missing than effects explain, and fresh data show next to nothing of it"
    ]
    load = stations_of(["dry", "load"], events=["load"])
    found, said, _ = confirmed(
        monkeypatch, load, {"load": None}, missing=missing, unfit=True, unseen=["load"]
    )
    assert found == load[:2]
    assert said == [WORDS.format("load")]


def test_where_nothing_more_is_missing_nobody_has_to_see_it(monkeypatch):
    stations = stations_of(["dry", "drag"])
    found, _, _ = confirmed(monkeypatch, stations, {"drag": True}, missing=False, unseen=["drag"])
    assert found == stations


@pytest.mark.parametrize("lost", ["fit 1", "fit 2"])
def test_what_cannot_be_simulated_on_fresh_data_says_nothing(monkeypatch, lost):
    stations = stations_of(["dry", "drag"])
    assert confirmed(monkeypatch, stations, {"drag": False}, lost=[lost]) == (stations, [], [])


@pytest.mark.parametrize(
    ("p", "says", "moves", "left"),
    [
        (3e-3, False, False, 2),  # chance does as much, and fresh data do not confirm it
        (1e-5, False, False, 3),
        (3e-3, True, False, 3),
        (3e-3, None, False, 3),
        (3e-3, None, True, 2),  # no other record can confirm an event
        (1e-5, None, True, 3),
    ],
)
def test_a_further_effect_that_chance_may_make_is_confirmed_or_left_out(monkeypatch, p, says, moves, left):
    stations = stations_of(["dry", "load"], events=["load"] if moves else [])
    stations[1].screened, stations[2].lead = stub(alpha=0.01, pooled=lambda number: p), 7
    found, said, _ = confirmed(monkeypatch, stations, {"load": says}, missing=False)
    assert found == stations[:left]
    words = "load is left out: chance may make it, and fresh data do not confirm it by itself"
    assert said == ([words] if left == 2 else [])


def test_the_stations_that_were_given_stay_as_they_are(monkeypatch):
    stations = stations_of(["dry", "drag"])
    confirmed(monkeypatch, stations, {"drag": False})
    assert len(stations) == 3


# ---- what takes the place of the chosen structure


class Search:
    """Structures by the names of their effects in order, all of them fitted; ``cases`` : law -> its special case."""

    def __init__(self, best, **cases):
        self.best, self.cases, self.misfit, self.preferred = frozenset(best), cases, 1.0, []
        self.logs = {}
        self.ways = {frozenset(best): stations_of(best)}
        self.known(best[:1])

    def known(self, names):
        self.ways[frozenset(names)] = stations_of(names)

    @property
    def pool(self):
        """The structures, each with its log evidence and how certain its effects are."""
        return {key: stub(key=key, log=self.logs.get(key, 0.0), beyond=9.0) for key in self.ways}

    def way(self, key):
        found = self.ways[frozenset(key)]
        for station in found:
            for one in station.effects:
                one.candidate = stub(key=one.label)
            station.fit = " + ".join(one.label for one in station.effects) or "none"
        return found

    def prefer(self, key, *, without):
        self.preferred.append((set(key), set(without)))
        self.best = key

    def special_cases_of(self, key):
        return [key - {law} | {case} for law, case in self.cases.items() if law in key]


def shortened(monkeypatch, search, *, misfit, stand=1, seen=True):
    """The chosen structure after ``_shortened``, of which the first ``stand`` effects stand by themselves."""
    monkeypatch.setattr(FreshChoice, "_on_fresh", lambda self, one: one.fit)
    monkeypatch.setattr(FreshChoice, "_misfit", lambda self, one, pairs, **_: misfit)
    monkeypatch.setattr(FreshChoice, "_seen", lambda self, old, new, here: seen)
    monkeypatch.setattr(FreshChoice, "_each_confirmed", lambda self, stations: stations[: stand + 1])
    monkeypatch.setattr(module, "unknown_of", lambda one: None)
    FreshChoice(search, None, print, [])._shortened(["without effects"])
    return set(search.best)


@pytest.mark.parametrize(
    ("log", "stands", "named"), [(-5.0, True, "dry"), (-20.0, True, ""), (-5.0, False, "")]
)
def test_a_rival_that_stands_as_a_whole_takes_the_place_of_one_that_does_not(monkeypatch, log, stands, named):
    """Fading friction with drag was more probable than dry friction with drag, and fresh data bore out the dry one's
    drag alone: what was left of the first was named, and the second, right, was not asked."""
    search = Search(["fading", "drag"])
    search.known(["dry", "drag"])
    search.logs[frozenset(["dry", "drag"])] = log
    whole = frozenset(["dry", "drag"]) if stands else frozenset()

    def confirmed(self, stations):
        names = {one.label for one in stations[-1].effects}
        return stations if names == whole else stations[:2]

    monkeypatch.setattr(FreshChoice, "_each_confirmed", confirmed)
    choice = FreshChoice(search, None, print, [])
    assert choice._whole_rival() == (whole if named else None)


def test_what_is_left_of_a_structure_is_preferred_without_what_was_left_out(monkeypatch):
    search = Search(["dry", "offset", "load"])
    assert shortened(monkeypatch, search, misfit=7.0) == {"dry"}
    assert search.preferred == [({"dry"}, {"offset", "load"})]
    assert search.misfit == 7.0  # evidence counts by as much less


@pytest.mark.parametrize(
    ("misfit", "seen", "named"), [(7.0, False, "dry"), (7.0, True, "uneven"), (1.0, False, "uneven")]
)
def test_a_law_gives_way_to_its_special_case_where_it_is_not_seen_to_do_more(
    monkeypatch, misfit, seen, named
):
    """Where the fresh data are described, its further numbers stay what they are: beyond chance."""
    search = Search(["uneven"], uneven="dry")
    search.known(["dry"])
    assert shortened(monkeypatch, search, misfit=misfit, seen=seen) == {named}


def test_without_fresh_data_nothing_takes_its_place(monkeypatch):
    search = Search(["uneven"], uneven="dry")
    FreshChoice(search, None, print, [])._shortened(None)
    assert search.best == {"uneven"}


# ---- weights that the time does not allow


def test_weights_that_were_not_all_asked_weigh_nothing(monkeypatch):
    """What fresh data said of the first structures alone would be held against the others."""
    null = stub(screened=stub(request=stub(blind=False), choice=stub(scatter=())))
    asked, unasked = stub(fresh=-12.0), stub(fresh=0.0)
    search = stub(
        null=null,
        best="none",
        pool={"asked": asked, "unasked": unasked},
        way=lambda key: [null],
    )
    monkeypatch.setattr(module, "ranked", lambda _: iter(["none"]))

    def run(self, *, sure):
        raise TimeUp

    monkeypatch.setattr(module.FreshWeights, "run", run)
    monkeypatch.setattr(FreshChoice, "_on_fresh", lambda self, one: ["the model without effects there"])
    monkeypatch.setattr(FreshChoice, "_confirms", lambda self, before: True)
    said = []
    found = FreshChoice(search, stub(fresh=("a record",)), print, said)._judged_in_order()
    assert (asked.fresh, unasked.fresh) == (0.0, 0.0)
    assert said == ["fresh data weigh no structure against another, as the time was up"]
    assert found.kept == (null,)
    assert found.before == ["the model without effects there"]


# ---- while the search goes on


@pytest.mark.parametrize(
    ("says", "idle"), [({"drag": True}, set()), ({"drag": False}, {"drag"}), (None, set())]
)
def test_the_effects_that_would_be_left_out_in_the_end_are_told_to_the_search(monkeypatch, says, idle):
    """Without a way to the structure (says None) nothing is told of it."""
    stations = stations_of(["dry", "drag"])
    for name, one in zip(("dry", "drag"), stations[-1].effects, strict=True):
        one.candidate = stub(key=name)
    monkeypatch.setattr(module, "unknown_of", lambda one: "something")
    monkeypatch.setattr(FreshChoice, "_on_fresh", lambda self, one: one.fit)
    monkeypatch.setattr(FreshChoice, "_judged", lambda self, old, new, here: Judgement(None, says["drag"]))
    monkeypatch.setattr(FreshChoice, "_misfit", lambda self, one, pairs, **_: 1.0)
    monkeypatch.setattr(FreshChoice, "_seen", lambda *_: True)
    null = stub(screened=stub(request=stub(blind=False)))
    search = stub(
        null=null, pool={frozenset({"dry"}): stub()}, way=lambda key: None if says is None else stations
    )
    choice = FreshChoice(search, stub(fresh=("a record",)), print, [])
    assert choice.idle(frozenset({"dry", "drag"})) == idle
    assert FreshChoice(search, stub(fresh=()), print, []).idle(frozenset({"dry", "drag"})) == set()
    null.screened.request.blind = True  # of sensors and stated numbers alone: never judged
    assert choice.idle(frozenset({"dry", "drag"})) == set()


# ---- effects of one port that bend to a law together


@pytest.mark.parametrize(
    ("ports", "port", "more", "left"),
    [
        (["spring", "spring"], "spring", (), 1),
        (["spring", "load"], "spring", (), 2),  # the last one is elsewhere
        (["load", "spring"], "spring", (), 2),  # and none beside it there
        (["spring", "spring"], None, (), 2),  # nothing is left, or no function
        (["spring", "spring", "spring"], "spring", (), 1),
        (["spring", "spring"], "spring", (2,), 2),  # the last does what no function of the twist does
        (["spring", "spring", "spring"], "spring", (2,), 2),
    ],
)
def test_effects_that_leave_a_function_of_their_own_signal_come_down_to_the_first(
    monkeypatch, ports, port, more, left
):
    """A spring of an exponential had come out as one that hardens and a play of a thousandth of its way."""
    effects = tuple(stub(name=f"{k} at {at}", candidate=stub(port=at)) for k, at in enumerate(ports))
    stations = [stub(effects=effects[:k], screened=k) for k in range(len(effects) + 1)]
    unknown = None if port is None else stub(port=port, signal="twist")
    monkeypatch.setattr(module, "unknown_of", lambda screened: unknown)
    asked = []

    def answer(refits, tried, last, port, signal):
        asked.append((last, port, signal))
        return len(tried) in more

    monkeypatch.setattr(module, "does_more", answer)
    monkeypatch.setattr(module, "key_of", len)
    said = []
    search = stub(pool={k: range(k) for k in range(len(effects) + 1)}, refits=None)
    found = FreshChoice(search, None, print, said)._bent_together(stations)
    assert all(one == (effects[-k - 1], "spring", "twist") for k, one in enumerate(asked))
    assert len(found) == left + 1
    assert len(said) == len(ports) - left
    assert all("is left out: with it, too, what is left depends on twist there" in words for words in said)


@pytest.mark.parametrize(
    ("said", "then", "confirmed", "refused"),
    [
        (True, 1.99, True, False),
        (True, 2.01, False, False),  # its parameters may move, and still the gap grows
        (None, 2.01, None, False),
        (None, 2.3, False, True),
    ],
)
def test_a_gap_that_grows_confirms_nothing(monkeypatch, said, then, confirmed, refused):
    """A drag that acts in one record alone was "confirmed" on two others, in which the gap grew."""
    monkeypatch.setattr(module, "judge", lambda old, new, noise: Judgement(None, said))
    monkeypatch.setattr(module, "_rmse", lambda nulls, noise: {"old": 2.0, "new": then}[nulls[0]])
    monkeypatch.setattr(module, "told_by_both", lambda one, other: (one, other))
    here = stub(effects=(stub(placed=False),), screened=stub(noise=None))
    choice = FreshChoice(None, stub(source="records"), print, [])
    found = choice._judged([("fit", "old")], [(stub(converged=True), "new")], here)
    assert (found.confirmed, found.refused) == (confirmed, refused)
    assert (found.why is not None) == (confirmed is False)
    assert found.why is None or "the gap there grows by" in found.why


def in_order(monkeypatch, says, costs, *, late=False):
    """The structure that fresh data leave of those in order of evidence, each of one effect; and what is said.

    says : name -> what they say of it; costs : name -> chi-squared; it is 1000 without effects
    """
    names = list(says)
    pool = {frozenset({n}): stub(name=n, label=n, evidence=stub(cost=costs[n])) for n in names}
    pool[frozenset()] = stub(evidence=stub(cost=1000.0))
    ways = {frozenset({n}): stations_of([n]) for n in names}
    null = stub(screened=stub(request=stub(blind=False), choice=stub(scatter=True)))
    search = stub(null=null, way=ways.get, pool=pool, best=frozenset({names[0]}))
    monkeypatch.setattr(module, "ranked", lambda _: list(ways))
    monkeypatch.setattr(FreshChoice, "_on_fresh", lambda self, one: "pairs")
    monkeypatch.setattr(FreshChoice, "_shortened", lambda self, before: None)
    monkeypatch.setattr(FreshChoice, "_each_confirmed", lambda self, stations: stations)
    monkeypatch.setattr(
        FreshChoice,
        "_of_structure",
        lambda self, stations, before: (says[stations[-1].effects[-1].name], "pairs"),
    )
    monkeypatch.setattr(module, "late", lambda: late)
    said = []
    found = FreshChoice(search, stub(fresh=["a record"]), print, said)._judged_in_order()
    return found.kept[-1].effects[-1].name, said


OPEN, SURE = Judgement(None, False, False, "chance may make it"), Judgement(None, True)
NO = Judgement(None, False, True, "fresh data refuse it")


@pytest.mark.parametrize(
    ("says", "costs", "kept"),
    [
        ({"dry": OPEN, "viscous": SURE}, (10, 12), "viscous"),
        ({"dry": OPEN, "viscous": SURE}, (10, 200), "dry"),  # which closes much less
        ({"dry": OPEN, "viscous": OPEN}, (10, 12), "dry"),
        ({"dry": OPEN, "square": NO, "viscous": SURE}, (10, 12, 14), "viscous"),
        ({"dry": NO, "square": OPEN, "viscous": SURE}, (10, 12, 14), "viscous"),
        ({"dry": SURE, "viscous": SURE}, (10, 12), "dry"),
    ],
)
def test_what_fresh_data_confirm_stands_before_what_they_do_not(monkeypatch, says, costs, kept):
    """A flexible arm without its damper: the data of the search preferred friction that is dry by 4 % of chi-squared,
    the fresh ones made it worse than none, and the damper was not asked."""
    found, said = in_order(monkeypatch, says, dict(zip(says, costs, strict=True)))
    assert found == kept
    assert (kept == "viscous") == any(words.endswith(module.CONFIRMED_ALONE) for words in said)


def test_no_more_is_asked_of_fresh_data_once_the_time_is_up(monkeypatch):
    says = {"dry": OPEN, "viscous": SURE}
    assert in_order(monkeypatch, says, {"dry": 10, "viscous": 12}, late=True) == (
        "dry",
        ["chance may make it"],
    )
    many = {**{f"law {k}": OPEN for k in range(6)}, "viscous": SURE}
    assert in_order(monkeypatch, many, dict.fromkeys(many, 10))[0] == "law 0"


@pytest.mark.parametrize(
    ("p", "estimated", "much", "noise"),
    [
        pytest.param(0.5, True, 2.0, True, id="white"),
        pytest.param(1e-6, True, 2.0, False, id="coloured"),
        pytest.param(None, True, 2.0, False, id="not known"),
        pytest.param(0.5, False, 2.0, False, id="of a stated level"),
        pytest.param(0.5, True, 30.0, False, id="no noise is so loud"),
    ],
)
def test_louder_fresh_noise_is_no_effect_that_is_missing(monkeypatch, p, estimated, much, noise):
    """Dry friction beside drag was left out, as a fresh record was half as noisy again."""
    white = stub(whiteness_p={"fresh": {"y": p, "z": None}})
    monkeypatch.setattr(module, "side", lambda *_, **__: white)
    station = stub(fit=stub(noise={"y": (1.0, estimated)}), screened=stub(choice=None))
    assert FreshChoice._is_noise(station, (), much) is noise
