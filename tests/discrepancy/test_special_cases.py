"""A law that contains another one is not named where that one does the same beside the other effects."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import exchange

M, C, DRY, PUSH = 2.0, 1.5, 3.0, -4.0


def cart():
    b = ce.Blueprint("cart")
    m, c = (
        b.parameter("m", 2.5, unit="kg", min=0.5, max=10),
        b.parameter("c", 2.0, unit="N s/m", min=0, max=20),
    )
    v = b.state("v", unit="m/s", scale=1.0)
    port = b.port("cart", "inertia", {"speed": v}, unit="N")
    b.ode("v", (b.input("F", unit="N", scale=20) - c * v + port) / m)
    b.output("v", v, unit="m/s", scale=1.0)
    return b.model()


def record(name, seed):
    """Dry friction of 3 N and a constant pull of -4 N on a cart that is driven to and fro; it never sticks for long."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 8, 0.02)
    force = 20 * np.sin(1.7 * t + rng.uniform(0, 6)) + 8 * np.sin(4.3 * t + rng.uniform(0, 6))
    run = solve_ivp(
        lambda s, x: (np.interp(s, t, force) - C * x + PUSH - DRY * np.tanh(x / 1e-4)) / M,
        (0, t[-1]), [1.0], t_eval=t, method="LSODA", rtol=1e-9, atol=1e-10, max_step=0.01,
    )  # fmt: skip
    v = run.y[0] + 0.05 * rng.standard_normal(len(t))
    return ce.Experiment.from_arrays(name, time=t, units={"F": "N", "v": "m/s"}, F=force, v=v)


@pytest.fixture(scope="module")
def repair():
    effects = ["asymmetric_friction", "coulomb_friction", "constant_torque"]
    # Of records of eight seconds this pair is one in which what contains the law is the more probable of the two.
    fresh = record("b", 4)
    return ce.repair(cart(), record("a", 3), fresh=fresh, effects=effects, starts=1, progress=False)


@pytest.mark.slow
def test_the_simpler_structure_leads(repair):
    assert {one.key for one in repair.effects} == {"cart.coulomb_friction", "cart.constant_torque"}
    assert repair.confirmed


@pytest.mark.slow
def test_what_contains_it_is_in_its_class(repair):
    (dry,) = (one for one in repair.effects if one.key == "cart.coulomb_friction")
    assert dry.amplitude.value == pytest.approx(DRY, abs=0.1)
    for member in dry.members:
        assert member.name in ("coulomb_friction", "asymmetric_friction")


# ---- which special cases are refitted, by stand-ins

ASYMMETRIC, DRY_FRICTION, PULL = (
    (name, "cart") for name in ("asymmetric_friction", "coulomb_friction", "constant_torque")
)


def structure(*keys, log=0.0, settled=True, cost=0.0):
    """A structure that was refitted, of effects of which the asymmetric friction has a special case."""
    effects = tuple(
        stub(
            candidate=stub(
                key=key,
                port="cart",
                source=stub(effect=stub(limit="coulomb_friction" if key == ASYMMETRIC else "")),
            ),
            label=key[0],
            amplitude=f"cart.{key[0]}.size",
        )
        for key in keys
    )
    arrived = stub(values={one.amplitude: 3.0 for one in effects}, settled=settled)
    return stub(
        effects=effects, key=frozenset(keys), log=log, label=" and ".join(k[0] for k in keys), arrived=arrived,
        evidence=stub(cost=cost),
    )  # fmt: skip


def refitted(monkeypatch, best, *others):
    """The names of the structures that are refitted in the place of the best one and those as probable."""
    made = []
    pool = {one.key: one for one in (best, *others)}
    refits = stub(
        pool=pool, tried=lambda effects, start: made.append({one.candidate.key[0] for one in effects})
    )
    keys = (ASYMMETRIC, DRY_FRICTION, PULL)
    screened = stub(candidates=[stub(key=key) for key in keys])
    monkeypatch.setattr(exchange, "families_of", lambda _: {key: [k] for k, key in enumerate(keys)})
    monkeypatch.setattr(exchange, "start_without", lambda *_: None)
    monkeypatch.setattr(exchange, "addition", lambda candidate, size: stub(candidate=candidate, size=size))
    exchange.special_cases(refits, best.key, screened, lambda words: None)
    return made


def test_a_special_case_is_tried_beside_the_other_effects(monkeypatch):
    both = structure(ASYMMETRIC, PULL)
    assert refitted(monkeypatch, both) == [{"coulomb_friction", "constant_torque"}]
    # not where it was tried there, nor where it is in the structure already
    assert refitted(monkeypatch, both, structure(DRY_FRICTION, PULL, log=-9.0)) == []
    assert refitted(monkeypatch, structure(ASYMMETRIC, DRY_FRICTION)) == []
    # nor in a structure that is far less probable than the best one
    assert refitted(monkeypatch, structure(DRY_FRICTION, PULL), structure(ASYMMETRIC, PULL, log=-9.0)) == []


def test_a_special_case_alone_is_tried_again_where_its_refit_had_not_arrived(monkeypatch):
    alone = structure(ASYMMETRIC)
    assert refitted(monkeypatch, alone, structure(DRY_FRICTION, log=-9.0, cost=20.0)) == []
    again = [{"coulomb_friction"}]
    assert refitted(monkeypatch, alone, structure(DRY_FRICTION, log=-9.0, cost=20.0, settled=False)) == again
    # with fewer numbers it is less probable than chi-squared makes it: both ended in one valley, at other places
    assert refitted(monkeypatch, alone, structure(DRY_FRICTION, log=-4.0, cost=4.9)) == again
