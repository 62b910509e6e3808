"""What is added to a structure is added to the rivals of the one before too."""

from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy.beside_rivals import beside_rivals
from casadi_engine.discrepancy.start import Start


def effect(name):
    key = (name, "at")
    return SimpleNamespace(candidate=SimpleNamespace(key=key), key=name, label=name)


LATE_HEATER, LATE_SENSOR, GAIN, STORAGE = (effect(name) for name in ("heater", "sensor", "gain", "storage"))


class Structure(SimpleNamespace):
    def __init__(self, *effects, cost, log=0.0, failed=False):
        values = {"C": cost, **{f"{one.key}.size": cost / 10 for one in effects}}
        arrived = SimpleNamespace(cost=cost, values=values, initial={"run": 1.0})
        super().__init__(effects=effects, arrived=arrived, log=log, failed=failed)
        self.key = frozenset(one.candidate.key for one in effects)
        self.label = " + ".join(one.label for one in effects)

    def newest(self, here):
        return next(one for one in self.effects if one.candidate.key not in here.key)


class Refits:
    def __init__(self, *pool, filters=()):
        self.pool = {one.key: one for one in pool}
        self.filters = {one.key: one for one in filters}
        self.asked = []

    def tried(self, effects, start):
        self.asked.append((tuple(one.label for one in effects), start))
        return [Structure(*effects, cost=1.0)]


HERE = Structure(LATE_HEATER, cost=100.0, log=-50.0)
ADDED = [
    Structure(LATE_HEATER, GAIN, cost=20.0),
    Structure(LATE_HEATER, STORAGE, cost=10.0),
]


def asked(*pool, filters=()):
    refits, told = Refits(HERE, *ADDED, *pool, filters=filters), []
    made = beside_rivals(refits, HERE, ADDED, told.append)
    assert len(made) == len(refits.asked) == len(told)
    return refits.asked


def test_a_rival_gets_what_was_added_the_best_first_from_where_that_ended():
    (first, start), (second, _) = asked(Structure(LATE_SENSOR, cost=99.0))
    assert (first, second) == (("sensor", "storage"), ("sensor", "gain"))
    # parameters as they ended with the storage, the rival's own numbers as it ended by itself
    assert isinstance(start, Start)
    assert start.values == {"C": 10.0, "storage.size": 1.0, "sensor.size": 9.9}


@pytest.mark.parametrize(
    ("rival", "tried"),
    [
        (Structure(LATE_SENSOR, cost=110.0, log=-51.0), True),  # worse by less than the odds
        (Structure(LATE_SENSOR, cost=110.0, log=-51.0, failed=True), False),
        (
            Structure(LATE_SENSOR, cost=108.0, log=-90.0),
            True,
        ),  # by little of the 90 that were taken away then
        (
            Structure(LATE_SENSOR, cost=99.0, log=-51.0, failed=True),
            True,
        ),  # more than the whole of a gap explained
        (Structure(LATE_SENSOR, cost=150.0, log=-75.0), False),
        (Structure(LATE_SENSOR, GAIN, cost=5.0), False),  # no rival of the one before
    ],
)
def test_who_is_a_rival(rival, tried):
    assert bool(asked(rival)) == tried


def test_one_that_was_no_answer_alone_may_be_one_with_another():
    assert asked(filters=[Structure(LATE_SENSOR, cost=99.0)])


def test_what_is_known_or_the_rival_has_is_not_refitted():
    known = Structure(LATE_SENSOR, STORAGE, cost=9.0)
    assert [labels for labels, _ in asked(Structure(LATE_SENSOR, cost=99.0), known)] == [("sensor", "gain")]
    assert [labels for labels, _ in asked(Structure(GAIN, cost=99.0))] == [("gain", "storage")]
