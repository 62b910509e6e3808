"""Two effects in the place of one: which pairs are tried, and a pair that a class knows of."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy import pairs
from casadi_engine.discrepancy.linearised import OneStep

DRY, DRAG, FADING, STEP = ("dry", "load"), ("drag", "load"), ("fading", "load"), ("step", "load")
FAMILIES = {DRY: [0], DRAG: [1], FADING: [2], STEP: [3]}


def tried(key, log):
    effects = (SimpleNamespace(candidate=SimpleNamespace(key=key), label=key[0]),)
    arrived = SimpleNamespace(values={}, initial={})
    return SimpleNamespace(effects=effects, key=frozenset({key}), log=log, label=key[0], arrived=arrived)


def asked(monkeypatch, *, logs, drops):
    """Labels of the structures that are refitted beside FADING with log 30; drops : of chi-squared by the families."""
    made = []
    pool = {one.key: one for one in (tried(key, log) for key, log in {FADING: 30.0, **logs}.items())}
    refits = SimpleNamespace(
        pool=pool, levels=SimpleNamespace(memory={}), path=SimpleNamespace(levels={}), null=lambda one: one,
        tried=lambda effects, start, near=False: (near and made.append(tuple(one.label for one in effects))) or [],
    )  # fmt: skip
    none = np.zeros(len(FAMILIES))
    monkeypatch.setattr(
        pairs,
        "one_step",
        lambda null, candidates, levels, members: OneStep(-np.array(drops), none, none, 0.0),
    )
    monkeypatch.setattr(
        pairs, "by_one_step", lambda candidates, step, own: SimpleNamespace(cost=step.cost[own[0]])
    )
    chosen = lambda step, own: SimpleNamespace(label=list(FAMILIES)[own[0]][0])  # noqa: E731
    screened = SimpleNamespace(candidates=[])
    pairs.tried_in_two(refits, pool[frozenset({FADING})], screened, FAMILIES, chosen, lambda words: None)
    return made


def test_an_excluded_rival_is_tried_with_what_may_lift_it(monkeypatch):
    # 20 less probable: a drop of chi-squared by 40 and what the further effect costs make it even, less a factor of 20
    # that the class may have; further steps may gain three tenths of it
    assert asked(monkeypatch, logs={DRY: 10.0}, drops=[0, 28, 0, 5]) == [("dry", "drag")]
    assert asked(monkeypatch, logs={DRY: 10.0}, drops=[0, 24, 0, 5]) == []


def test_a_rival_that_is_in_the_class_needs_no_second_effect(monkeypatch):
    assert asked(monkeypatch, logs={DRY: 29.0}, drops=[0, 45, 0, 5]) == []


def test_a_further_effect_costs_as_much_as_there_are_others():
    assert pairs.price_of(FAMILIES) == pytest.approx(math.log(4))
    assert pairs.price_of({}) == 0.0


@pytest.mark.slow
def test_dry_friction_and_drag_of_a_slide_are_both_found_beside_friction_that_fades():
    """A slow slide, pushed to and fro: one law that fades does much of what two simple ones do."""
    t = np.arange(500) * 0.01
    push = 25 * np.sin(2 * np.pi * 0.5 * t) + 12 * np.sin(2 * np.pi * 1.3 * t + 1)
    b = ce.Blueprint("slide")
    m, c = b.parameter("m", 1.5, unit="kg", min=0.1), b.parameter("c", 10.0, unit="N s/m", min=0)
    v, force = b.state("v", unit="m/s"), b.input("F", unit="N")
    b.ode("v", (force - c * v + b.port("slide", "inertia", {"speed": v})) / m)
    b.output("v", v, unit="m/s")
    model = b.model()
    true = model.with_effect(ce.effects.CoulombFriction(width=0.002), at="slide", values={"torque": 3.0})
    true = true.with_effect(ce.effects.QuadraticDrag(width=0.002), at="slide", values={"coefficient": 6.0})
    drive = ce.Experiment.from_arrays("pushed", time=t, units={"F": "N"}, F=push)
    run = ce.simulate(true, drive, parameters={"m": 2.0, "c": 8.0}, initial={"v": 0.0})
    noise = 0.08 * np.random.default_rng(2).standard_normal(t.size)
    record = ce.Experiment.from_arrays(
        "pushed", time=t, units={"F": "N", "v": "m/s"}, F=push, v=run["v"].values + noise
    )
    found = ce.repair(
        model, record, effects=["coulomb_friction", "stribeck_friction", "quadratic_drag"], holdout=0.0, starts=1,
        noise=ce.Noise(v=0.08), progress=False,
    )  # fmt: skip
    classes = [{m.name for m in one.members} for one in found.effects]
    assert len(classes) == 2
    assert any("quadratic_drag" in own for own in classes)
    assert any("coulomb_friction" in own for own in classes)


def along_the_chosen(residual, columns, parameters=1):
    """Scores along a model that was chosen: one column for each of these candidates, beside a parameter's."""
    rows = np.column_stack([np.eye(len(residual))[:, :parameters], *columns.values(), residual])
    size = np.linalg.norm(rows[:, parameters:-1], axis=0)
    reduced = SimpleNamespace(rows=rows, parameters=parameters, size=size)
    candidates = [SimpleNamespace(key=key) for key in columns]
    return SimpleNamespace(candidates=candidates, compressed=SimpleNamespace(reduced=lambda: reduced))


def test_what_helps_beside_a_rival_along_what_was_chosen():
    """Three rivals were made and scored anew, for a quarter of a repair, where none does what the chosen one does."""
    e = np.eye(6)
    residual = np.array([5.0, 4.0, 3.0, 1.0, 0.0, 0.0])  # 5 of it is the parameter's
    columns = {DRY: e[1], DRAG: e[1] + 0.5 * e[2], FADING: 1e-9 * e[0] + e[4], STEP: e[0]}
    beside = along_the_chosen(residual, columns)
    # dry friction takes 16 by itself, with the drag 25; what is the parameter's, or at right angles, adds nothing
    assert pairs.lifted_by(beside, {DRY}, 15.9) == {DRY, DRAG, FADING, STEP}
    assert pairs.lifted_by(beside, {DRY}, 16.1) == {DRAG}
    assert pairs.lifted_by(beside, {DRY}, 25.1) == set()
    assert pairs.lifted_by(beside, {("unknown", "load")}, 1.0) is None


def test_a_rival_that_nothing_lifts_there_is_not_made(monkeypatch):
    one, now = tried(DRY, 10.0), tried(FADING, 30.0)
    refits = SimpleNamespace(pool={t.key: t for t in (one, now)}, levels=SimpleNamespace(memory={}))
    refits.null = lambda _: pytest.fail("it was linearised")
    beside = SimpleNamespace(screened=along_the_chosen(np.zeros(3), {DRY: np.eye(3)[1], DRAG: np.eye(3)[2]}))
    given = SimpleNamespace(candidates=[]), FAMILIES, None, lambda words: None, beside
    assert pairs.tried_in_two(refits, now, *given) == []
