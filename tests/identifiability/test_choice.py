"""Chosen experiments against brute force over the matrices, and the search against trying all sets."""

import itertools
import math

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.identifiability import PlannedExperiment, choose_experiments, fisher
from casadi_engine.identifiability.choice import _Judge, _search
from casadi_engine.identifiability.fisher import Frame

NOISE = ce.Noise(omega=0.05)
START = {"omega_eng": 3.0}


def run(torque, name="run"):
    time = 0.02 * np.arange(len(torque))
    made = ce.Experiment.from_arrays(name, time=time, units={"T": "N m"}, hold="zero", T=torque)
    return PlannedExperiment(made, name, start=START)


def candidates(count=7, n=120):
    """Torques of different periods, heights and lengths."""
    draw = np.random.default_rng(8)
    made = {}
    for k in range(count):
        size, period = draw.uniform(0.2, 4), draw.integers(4, 60)
        length = int(n * draw.uniform(0.4, 1))
        made[f"run {k}"] = run(size * (np.arange(length) // period % 2), f"run {k}")
    return made


def brute(model, plans, size, score, pars=None):
    matrices = {
        name: fisher(model, plan, parameters=pars, noise=NOISE).matrix for name, plan in plans.items()
    }
    scored = {
        group: score(np.linalg.inv(sum(matrices[name] for name in group)))
        for group in itertools.combinations(matrices, size)
    }
    return min(scored.items(), key=lambda pair: pair[1])


SCORES = {
    "A": lambda c: math.sqrt(np.trace(c) / len(c)),
    "D": lambda c: np.linalg.det(c) ** (0.5 / len(c)),
    "E": lambda c: math.sqrt(np.linalg.eigvalsh(c)[-1]),
}


@pytest.mark.parametrize("criterion", ["A", "D", "E"])
def test_the_best_of_all_sets_is_found(criterion):
    plans = candidates()
    found = choose_experiments(ce.one_inertia(), plans, noise=NOISE, criterion=criterion, size=3)
    group, value = brute(ce.one_inertia(), plans, 3, SCORES[criterion])
    assert set(found.chosen) == set(group)
    assert found.value == pytest.approx(value, rel=1e-6)
    assert found.every
    assert found.tried == 7 + 21 + 35
    assert found.by_size == tuple(sorted(found.by_size, reverse=True))
    assert found.met is None


@pytest.mark.parametrize("criterion", ["A", "D", "E", {"C_eng": 0.01}])
@pytest.mark.parametrize("repeats", [False, True])
def test_greedy_with_exchange_finds_it_too(criterion, repeats, monkeypatch):
    import sys

    module = sys.modules["casadi_engine.identifiability.choice"]
    plans = candidates(9)
    frame = Frame(ce.one_inertia(), None, tuple(plans))
    parts = {
        name: frame.information(False, frame.linearise(plan)[1], {"omega": (0.05, False)})
        for name, plan in plans.items()
    }
    judge = _Judge(frame, criterion, parts, ())
    judge.targets = dict.fromkeys(judge.targets, 1e-9) if judge.targets else {}
    best, values, _, every = _search(judge, list(plans), 3, repeats)
    assert every
    monkeypatch.setattr(module, "_ALL", 0)
    other, approximate, tried, all_tried = _search(judge, list(plans), 3, repeats)
    assert not all_tried
    assert 0 < tried < 2000
    assert approximate[-1] == pytest.approx(values[-1], rel=1e-9)
    assert judge.value(other) == pytest.approx(judge.value(best), rel=1e-9)


def test_targets_stop_at_the_smallest_set_that_meets_them():
    plans = candidates()
    alone = choose_experiments(ce.one_inertia(), plans, noise=NOISE, criterion={"J_eng": 1e-9}, size=4)
    assert alone.met is False
    assert len(alone.chosen) == 4
    needed = [value * 1e-9 for value in alone.by_size]
    target = 0.5 * (needed[1] + needed[2])  # three are enough, two are not
    found = choose_experiments(ce.one_inertia(), plans, noise=NOISE, criterion={"J_eng": target}, size=4)
    assert found.met
    assert len(found.chosen) == 3
    assert found.relative["J_eng"] <= target
    assert found.relative["J_eng"] == pytest.approx(needed[2], rel=1e-6)


def test_errors_of_the_set_are_those_of_its_records_together():
    plans = candidates()
    found = choose_experiments(ce.one_inertia(), plans, noise=NOISE, size=2)
    together = fisher(ce.one_inertia(), {name: plans[name] for name in found.chosen}, noise=NOISE)
    assert found.relative["J_eng"] == pytest.approx(together.relative["J_eng"], rel=1e-12)
    for name, one in found.candidates.items():
        alone = fisher(ce.one_inertia(), plans[name], noise=NOISE)
        assert one.relative["C_eng"] == pytest.approx(alone.relative["C_eng"], rel=1e-12)


def test_the_length_needed_is_what_repeats_confirm():
    plans = {"steps": candidates()["run 3"]}
    once = choose_experiments(ce.one_inertia(), plans, noise=NOISE, size=1)
    nine = choose_experiments(ce.one_inertia(), plans, noise=NOISE, size=9, repeats=True)
    assert nine.chosen == ("steps",) * 9
    assert nine.relative["J_eng"] == pytest.approx(once.relative["J_eng"] / 3, rel=1e-9)
    assert once.length_for("J_eng", nine.relative["J_eng"]) == pytest.approx(
        nine.information.duration, rel=1e-9
    )
    assert "steps (again, 9)" in nine.information.records


def test_what_was_made_already_counts():
    """With a record that tells J_eng well, the candidate that tells C_eng is taken."""
    plans = candidates()
    fresh = choose_experiments(ce.one_inertia(), plans, noise=NOISE, size=1)
    after = choose_experiments(
        ce.one_inertia(), plans, noise=NOISE, size=1, have={"made": plans[fresh.chosen[0]]}
    )
    assert after.value < fresh.value
    assert set(after.information.records) == {"made", *after.chosen}


def test_a_set_that_loses_a_direction_is_no_choice():
    """Constant torque from rest tells J_eng and C_eng, none tells nothing; two of none are worse than any other."""
    plans = {
        "none": run(np.zeros(100), "none"),
        "again": run(np.zeros(100), "again"),
        "steps": candidates()["run 1"],
    }
    plans = {name: PlannedExperiment(one.experiment, start={"omega_eng": 0.0}) for name, one in plans.items()}
    found = choose_experiments(ce.one_inertia(), plans, noise=NOISE, size=1)
    assert found.chosen == ("steps",)
    assert found.candidates["none"].errors["J_eng"].stderr is None
    assert found.candidates["none"].value > 100 * found.value
    lost = choose_experiments(
        ce.one_inertia(), {"none": plans["none"]}, noise=NOISE, criterion={"J_eng": 0.05}, size=1
    )
    assert lost.met is False
    assert lost.length_for("J_eng", 0.05) is None
    assert "J_eng is not determined" in str(lost)


def test_parameters_of_single_records_count_where_they_are_chosen():
    plans = candidates(4)
    pars = ce.one_inertia().parameters()
    pars.vary_by_experiment("C_eng")
    found = choose_experiments(ce.one_inertia(), plans, parameters=pars, noise=NOISE, size=2)
    first = found.chosen[0]
    assert found.relative[f"C_eng@{first}"] > 0
    others = [name for name in plans if name not in found.chosen]
    assert found.errors[f"C_eng@{others[0]}"].stderr is None
    assert found.value < 1


def test_messages():
    plans, model = candidates(3), ce.one_inertia()
    with pytest.raises(EstimationError, match="the criterion is not known; seen: 'B'"):
        choose_experiments(model, plans, noise=NOISE, criterion="B")
    with pytest.raises(EstimationError, match="the criterion names no parameter"):
        choose_experiments(model, plans, noise=NOISE, criterion={})
    with pytest.raises(EstimationError, match="the criterion names a parameter that is not in the set"):
        choose_experiments(model, plans, noise=NOISE, criterion={"J": 0.05})
    with pytest.raises(EstimationError, match="the wanted error of J_eng is not acceptable; seen: -1"):
        choose_experiments(model, plans, noise=NOISE, criterion={"J_eng": -1})
    fixed = model.parameters()
    fixed.fix("C_eng")
    with pytest.raises(EstimationError, match="C_eng has no relative error to ask for; seen: fixed"):
        choose_experiments(model, plans, parameters=fixed, noise=NOISE, criterion={"C_eng": 0.05})
    with pytest.raises(EstimationError, match="size is not acceptable; seen: 0"):
        choose_experiments(model, plans, noise=NOISE, size=0)
    with pytest.raises(EstimationError, match="has the name of a candidate; seen: run 1"):
        choose_experiments(model, plans, noise=NOISE, have={"run 1": plans["run 1"]})
    with pytest.raises(EstimationError, match="the noise level of omega is not known"):
        choose_experiments(model, plans)
