"""What the search was not allowed to find, and what it named in its place."""

import numpy as np
import pytest

import casadi_engine as ce

STEP = 0.02


def model():
    """A mass on a spring to the ground: friction of the mass and of the spring are one and the same."""
    b = ce.Blueprint("swing")
    m, c = b.parameter("m", 1.5, unit="kg", min=0.1), b.parameter("c", 1.0, unit="N s/m", min=0)
    k = b.parameter("k", 50.0, unit="N/m", min=1)
    x, v, force = b.state("x", unit="m"), b.state("v", unit="m/s"), b.input("F", unit="N")
    mass = b.port("mass", "inertia", {"speed": v})
    spring = b.port("spring", "coupling", {"twist": x, "twist_rate": v, "stiffness": k})
    b.ode("x", v)
    b.ode("v", (force - c * v - k * x - spring + mass) / m)
    b.output("pos", x, unit="m")
    return b.model()


@pytest.fixture(scope="module")
def record():
    """A mass of 2 kg with dry friction of 0.8 N, in 200 steps between samples."""
    rng = np.random.default_rng(1)
    force, x, v, seen, h = np.repeat(rng.uniform(-8, 8, 25), 12), 0.02, 0.3, [], STEP / 200
    for drive in force:
        seen.append(x)
        for _ in range(200):
            net = drive - 1.5 * v - 60.0 * x
            a = 0.0 if v == 0 and abs(net) <= 0.8 else (net - np.sign(v or net) * 0.8) / 2.0
            new = v + h * a
            new = 0.0 if v * new < 0 else new
            x, v = x + h * (v + new) / 2, new
    pos = np.array(seen) + 5e-4 * rng.standard_normal(len(seen))
    return ce.Experiment.from_arrays(
        "run", time=STEP * np.arange(len(pos)), units={"F": "N", "pos": "m"}, hold={"F": "zero", "pos": "first"},
        F=force, pos=pos,
    )  # fmt: skip


def said(record, **asked):
    return ce.repair(model(), record, starts=1, progress=False, **asked)


@pytest.mark.slow
def test_a_limit_that_was_left_out_is_told(record):
    """Where it fades least, friction that fades is dry friction."""
    found = said(record, effects=["stribeck_friction", "viscous_friction"])
    assert [one.name for one in found.effects] == ["stribeck_friction"]
    words = " ".join(str(found).split())
    assert "stribeck_friction at mass does in these data what coulomb_friction at mass would do" in words
    assert "which the search left out: the name is no surer than that. Allow it, and repair again" in words
    assert "stribeck_friction at mass is missing (of what was tried), " in words


@pytest.mark.slow  # test_one_law_at_two_ports.py says so in the quick run
def test_an_effect_of_ones_own_has_no_other_in_the_library(record):
    class Grip(ce.effects.CoulombFriction):
        name, limit = "grip", "nothing_known"

    found = said(record, effects=[(Grip(), "mass")])
    assert [one.key for one in found.effects] == ["mass.grip"]
    assert found.options["left out"].startswith(
        "grip at mass does in these data what grip at spring would do"
    )
