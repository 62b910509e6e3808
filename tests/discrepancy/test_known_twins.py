"""What is known to do the same as an effect of a structure is tried in its place."""

from types import SimpleNamespace as stub

import pytest

from casadi_engine.discrepancy import exchange as module


def effect(name):
    return stub(
        label=name, amplitude=f"{name}.size", candidate=stub(key=(name, "port"), effect=name), key=name
    )


def structure(effects, cost, label):
    arrived = stub(cost=cost, values={one.amplitude: 1.0 for one in effects})
    key = frozenset(one.candidate.key for one in effects)
    return stub(key=key, effects=effects, arrived=arrived, label=label, log=-0.5 * cost)


class Pool:
    """Structures that were refitted, by name and chi-squared; what is tried further."""

    def __init__(self, **costs):
        self.pool, self.asked = {}, []
        for names, cost in costs.items():
            effects = tuple(effect(name) for name in names.split("_"))
            key = frozenset(one.candidate.key for one in effects)
            self.pool[key] = structure(effects, cost, names)

    def tried(self, effects, start):
        names = sorted(one.label for one in effects)
        self.asked.append((names, start))
        key = frozenset(one.candidate.key for one in effects)
        self.pool[key] = structure(effects, 1e3, "_".join(names))

    def weigh(self):
        """Every structure has its log evidence already."""


@pytest.mark.parametrize(
    ("costs", "asked"),
    [
        ({"gain": 300.0, "value": 300.0, "gain_load": 80.0}, [["load", "value"]]),
        ({"gain": 300.0, "value": 310.0, "gain_load": 80.0}, []),  # they do not do the same
        ({"gain_delay": 90.0, "value_delay": 90.0, "gain_load": 80.0}, [["load", "value"]]),
        ({"gain": 300.0, "value": 300.0, "gain_load": 80.0, "value_load": 81.0}, []),  # it was tried
        ({"gain": 300.0, "value": 300.0}, []),
        # what leads alike is asked too: a friction and an offset, beside two gains of which one was tried with both
        (
            {"gain": 300.0, "value": 300.0, "gain_offset": 80.0, "gain_dry": 80.0, "value_offset": 80.0},
            [["dry", "value"]],
        ),
        ({"gain": 300.0, "value": 300.0, "gain_offset": 80.0, "gain_dry": 95.0, "value_offset": 80.0}, []),
    ],
)
def test_a_name_that_came_to_the_same_is_tried_beside_the_other_effects(monkeypatch, costs, asked):
    """A conductance that was stated wrong did the same as a gain of the input, and had been tried beside none of the
    other effects: the gain was the only name."""
    monkeypatch.setattr(module, "addition", lambda candidate, size: effect(candidate.key[0]))
    monkeypatch.setattr(module, "start_without", lambda arrived, member: f"without {member.label}")
    refits = Pool(**costs)
    best = list(refits.pool)[2] if len(costs) > 2 else next(iter(refits.pool))
    module.known_twins(refits, best, stub(candidates=[]), lambda words: None)
    assert [names for names, _ in refits.asked] == asked
    assert all(start == "without gain" for _, start in refits.asked)


def test_any_channel_may_be_what_is_late(monkeypatch):
    """Along a structure with states of an effect's own no slope tells what does as well in its place."""
    monkeypatch.setattr(module, "addition", lambda candidate, size: effect(candidate.effect))
    monkeypatch.setattr(module, "start_without", lambda arrived, member: f"without {member.label}")
    families = {
        (name, "port"): [k] for k, name in enumerate(("sensor_lag", "input_delay", "drag", "sensor_delay"))
    }
    monkeypatch.setattr(module, "every_family", lambda screened: families)
    screened = stub(candidates=[stub(effect=name) for name, _ in families])
    refits = Pool()
    members = tuple(effect(name) for name in ("input_delay", "drag"))
    key = frozenset(one.candidate.key for one in members)
    refits.pool = {key: structure(members, 80.0, "both")}
    module.known_twins(refits, key, screened, lambda words: None)
    assert [names for names, _ in refits.asked] == [["drag", "sensor_lag"], ["drag", "sensor_delay"]]
    assert all(start == "without input_delay" for _, start in refits.asked)
