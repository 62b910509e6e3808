"""Effects that are the same in the equations: refitted once, named twice."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.families import families_of
from casadi_engine.discrepancy.membership import class_of
from casadi_engine.discrepancy.screening import screen

DRY, SPRING, BODY = "coulomb_friction", "spring", "body"


def arm(*, ground=True):
    """A mass on a spring to the ground, or to a trolley that moves as it is told."""
    b = ce.Blueprint("arm")
    u, s = b.input("u", unit="N"), b.input("s", unit="m/s")
    k, c = b.parameter("k", 4.0, unit="N/m", min=0.1), b.parameter("c", 0.5, unit="N s/m", min=0)
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    rate = v if ground else v - s
    body = b.port(BODY, "inertia", {"speed": v, "angle": x}, unit="N")
    spring = b.port(SPRING, "coupling", {"twist": x, "twist_rate": rate, "stiffness": k}, unit="N")
    b.ode("x", rate)
    b.ode("v", u - k * x - c * rate - spring + body)
    b.output("v", v, unit="m/s")
    return b.model()


def record(name, seed, dry=0.0, *, ground=True):
    t = np.arange(0, 30, 0.03)
    force, trolley = 3 * np.sin(1.1 * t + seed) + 2 * np.sin(0.37 * t), 0.5 * np.sin(0.7 * t + seed)

    def rate(time, y):
        off = y[1] - (0.0 if ground else np.interp(time, t, trolley))
        return [
            off,
            np.interp(time, t, force) - 4.0 * y[0] - 0.5 * off - dry * np.tanh(y[1] / 1e-3),
        ]

    run = solve_ivp(
        rate, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.03, method="LSODA"
    )
    v = run.y[1] + 0.02 * np.random.default_rng(seed).standard_normal(len(t))
    return ce.Experiment.from_arrays(
        name, time=t, units={"u": "N", "s": "m/s", "v": "m/s"}, u=force, s=trolley, v=v
    )


def screened(*, ground):
    fit = ce.estimate(arm(ground=ground), record("a", 1, ground=ground), progress=False)
    return screen(fit, [DRY, "viscous_friction", "constant_torque"])


def test_a_spring_to_the_ground_rubs_as_the_body_does():
    found = screened(ground=True)
    (pair,) = ({key, *own} for key, own in found.second_names.items() if key[0] == DRY)
    assert pair == {(DRY, BODY), (DRY, SPRING)}
    keys = [key for key in families_of(found) if key[0] == DRY]
    assert len(keys) == 1  # it is refitted once


def test_a_spring_to_what_moves_is_another_place():
    found = screened(ground=False)
    assert not any(key[0] == DRY for key in found.second_names)
    assert {key[1] for key in families_of(found) if key[0] == DRY} == {BODY, SPRING}


def test_the_same_along_the_records_and_not_elsewhere_is_no_second_name():
    """Speeds are all positive here: |v| and v are one."""
    b = ce.Blueprint("turbine")
    u, c = b.input("u", unit="N"), b.parameter("c", 1.0, unit="N s/m", min=0)
    v = b.state("v", unit="m/s")
    one = b.port("one", "inertia", {"speed": v}, unit="N")
    two = b.port("two", "inertia", {"speed": ca.fabs(v)}, unit="N")
    root = ca.sqrt(b.parameter("m", 1.0, unit="kg2", vary=False))  # which no negative number has
    b.ode("v", (u - c * v + one + two) / root)
    b.output("v", v, unit="m/s")
    t = np.arange(0, 20, 0.02)
    push = 6 + np.sin(t)
    values = solve_ivp(
        lambda x, y: np.interp(x, t, push) - y, (0, 20), [5.0], t_eval=t, rtol=1e-9, max_step=0.02
    ).y[0]
    values = values + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    data = ce.Experiment.from_arrays("a", time=t, units={"u": "N", "v": "m/s"}, u=push, v=values)
    fit = ce.estimate(b.model(), data, progress=False)
    found = screen(fit, ["quadratic_drag"])
    first, second = (found.columns["a"]["v"][:, k] for k in range(2))
    np.testing.assert_allclose(first, second, rtol=1e-12)
    assert found.second_names == {}


class _Found:
    def __init__(self, log):
        self.log, self.beyond, self.effects, self.fresh = log, 10.0, (), 0.0
        self.evidence = SimpleNamespace(cost=-2 * log)


def test_both_names_are_as_probable():
    one, rival = (DRY, BODY), ("viscous_friction", BODY)
    pool = {frozenset(): _Found(0.0), frozenset({one}): _Found(9.0), frozenset({rival}): _Found(9.0)}
    lead = type("Lead", (), {"candidate": type("C", (), {"key": one})})()
    members = class_of(pool, frozenset({one}), lead, 100.0, 0.0, second_names={one: ((DRY, SPRING),)})
    found = {(m.name, m.at): m.probability for m in members}
    assert found == pytest.approx({one: 1 / 3, (DRY, SPRING): 1 / 3, rival: 1 / 3})
    assert (members[0].name, members[0].at) == one


@pytest.mark.slow
def test_a_repair_names_both():
    data = [record("a", 1, 0.4), record("b", 2, 0.4)]
    found = ce.repair(
        arm(), data, fresh=[record("c", 3, 0.4)], effects=[DRY, "viscous_friction"], progress=False
    )
    (one,) = found.effects
    assert {(m.name, m.at) for m in one.members} == {(DRY, BODY), (DRY, SPRING)}
    assert [m.probability for m in one.members] == pytest.approx([0.5, 0.5])
    assert abs(one.amplitude.value - 0.4) < 4 * one.amplitude.stderr
