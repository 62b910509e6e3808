"""Friction on a mass, and in the spring that holds it to the ground, is one law: no evidence can split the two."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

M, C, K, DRY = 2.0, 1.5, 300.0, 0.8
STEP = 0.01


def carriage():
    b = ce.Blueprint("carriage")
    m, c, k = (
        b.parameter("m", 1.5, unit="kg", min=0.1, max=20),
        b.parameter("c", 1.0, unit="N s/m", min=0, max=50),
        b.parameter("k", 250.0, unit="N/m", min=10, max=5000),
    )
    x, v = b.state("x", unit="m", scale=0.02), b.state("v", unit="m/s", scale=0.3)
    mass = b.port("mass", "inertia", {"speed": v, "angle": x}, unit="N")
    spring = b.port("spring", "coupling", {"twist": x, "twist_rate": v}, unit="N")
    b.ode("x", v)
    b.ode("v", (b.input("F", unit="N", scale=8) - c * v - k * x + mass - spring) / m)
    b.output("pos", x, unit="m", scale=0.02)
    return b.model()


def to_rest(side):
    """An event: the mass that moves to a side comes to rest."""

    def speed(t, z):
        return z[1]

    speed.terminal, speed.direction = True, -side
    return speed


def pushed(push, side):
    """The slopes of position and speed."""
    return lambda t, z: (z[1], (push - C * z[1] - K * z[0] - DRY * side) / M)


def moved(force):
    """Positions (N,) under forces that are held, dry friction taken event by event."""
    state, found = np.array([0.02, 0.3]), []
    for push in force:
        found.append(state[0])
        now = 0.0
        while now < STEP:
            if state[1] == 0.0 and abs(push - K * state[0]) <= DRY:
                break
            side = np.sign(state[1]) or np.sign(push - K * state[0])
            run = solve_ivp(
                pushed(push, side), (now, STEP), state, events=to_rest(side), rtol=1e-9, atol=1e-12
            )
            now, state = run.t[-1], run.y[:, -1].copy()
            if run.status == 1:
                state[1] = 0.0
    return np.array(found)


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(3)
    force = np.repeat(rng.uniform(-8, 8, 8), 50)
    time = STEP * np.arange(len(force))
    pos = moved(force) + 3e-4 * rng.standard_normal(len(force))
    units = {"F": "N", "pos": "m"}
    return ce.Experiment.from_arrays("swung", time=time, units=units, hold="zero", F=force, pos=pos)


@pytest.fixture(scope="module")
def repair(record):
    return ce.repair(
        carriage(), record, effects=["coulomb_friction", "stribeck_friction"], starts=1, progress=False
    )


@pytest.mark.slow  # test_choice.py has two names of one law
def test_the_two_are_as_probable_and_both_are_named(repair):
    (found,) = repair.effects
    known = {(one.name, one.at): one.probability for one in found.members}
    mass, spring = known["coulomb_friction", "mass"], known["coulomb_friction", "spring"]
    # their sharp corners are stepped over from other points: the slopes in a first state that sticks differ a little
    assert abs(math.log(mass / spring)) < 0.2
    assert mass + spring > 0.8  # the law that fades says less than it costs
    assert found.key.endswith("coulomb_friction")
    planned = repair.next_experiment  # nothing splits one law
    assert planned is None or not any(name.startswith("coulomb_friction") for name in planned.splits)


@pytest.mark.slow
def test_of_one_law_a_port_is_to_be_chosen(repair):
    said = " ".join(str(repair).split())
    assert "are one and the same in data of this kind (correlation 1 or -1)" in said
    assert f'ce.repair(..., at="{repair.effects[0].at}")' in said


@pytest.mark.slow
def test_nothing_was_left_out_where_both_ports_were_allowed(repair):
    assert "left out" not in repair.options
    assert "(of what was tried)" not in str(repair)


@pytest.fixture(scope="module", params=["mass", pytest.param("spring", marks=pytest.mark.slow)])
def alone(request, record):
    """A port alone, and the other one."""
    port = request.param
    (other,) = {"mass", "spring"} - {port}
    found = ce.repair(carriage(), record, effects=["coulomb_friction"], at=port, starts=1, progress=False)
    return port, other, found


@pytest.mark.slow
def test_one_port_alone_is_named_with_the_same_number(alone, repair):
    port, _, found = alone
    both = repair.effects[0].amplitude
    assert {row.at for row in found.scores} == {port}
    assert [one.key for one in found.effects] == [f"{port}.coulomb_friction"]
    size = found.effects[0].amplitude
    assert size.value == pytest.approx(both.value, abs=0.01 * both.stderr)  # as fits promise


def test_the_same_law_at_another_port_is_told(alone):
    port, other, found = alone
    assert found.options["left out"].startswith(
        f"coulomb_friction at {port} does in these data what coulomb_friction at {other} would do, "
        "which the search left"
    )
