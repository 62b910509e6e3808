"""What the evidence does not tell apart is named by the simplest effect: dry friction before one that fades far off."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.membership import class_of, numbers, simpler
from casadi_engine.effects import ConstantTorque, CoulombFriction, LoadStep, StribeckFriction

PORT = "rotor"


@dataclass(eq=False)
class Added:
    effect: object
    mechanical: bool = True
    width: float | None = None

    @property
    def candidate(self):
        port = SimpleNamespace(is_mechanical=self.mechanical)
        source = SimpleNamespace(effect=self.effect, model=SimpleNamespace(ports={PORT: port}))
        return SimpleNamespace(key=(self.effect.name, PORT), port=PORT, source=source)

    @property
    def key(self):
        return f"{PORT}.{self.effect.name}"

    @property
    def nuisance(self):
        return self.effect.nuisance


def tried(effect, log, mechanical=True, **values):
    one = Added(effect, mechanical)
    arrived = SimpleNamespace(values={f"{one.key}.{name}": value for name, value in values.items()})
    return SimpleNamespace(
        effects=(one,),
        key=frozenset([one.candidate.key]),
        log=log,
        arrived=arrived,
        beyond=9.0,
        evidence=SimpleNamespace(cost=-2 * log),
        fresh=0.0,
    )


DRY, FADING, STEP = CoulombFriction(), StribeckFriction(fastest=10.0), LoadStep()


def test_numbers_are_counted():
    assert [numbers([Added(one)]) for one in (DRY, FADING, STEP)] == [1, 2, 2]
    assert numbers([Added(DRY), Added(FADING)]) == 3


def test_the_simpler_one_leads_within_a_unit_of_log_evidence():
    fading = tried(FADING, 0.0, torque=1.0, fading=5.0)
    near, far = tried(DRY, -0.9), tried(DRY, -1.1)
    assert simpler(fading, [fading, near], 20.0) is near
    assert simpler(fading, [fading, far], 20.0) is fading
    assert simpler(near, [fading, near], 20.0) is near
    # not even a simple one that the chosen one comes near, but not the most probable one
    assert simpler(tried(FADING, -0.9, fading=5.0), [far, tried(STEP, 0.0)], 20.0).effects[0].effect is FADING


def test_friction_that_fades_beyond_all_speeds_gives_way_to_dry_friction_that_is_not_excluded():
    beyond = tried(FADING, 0.0, torque=1.0, fading=12.0)
    dry = tried(DRY, -2.5)
    assert simpler(beyond, [beyond, dry], 20.0) is dry
    assert simpler(beyond, [beyond, tried(DRY, -3.5)], 20.0) is beyond  # the data tell more than dry friction
    assert simpler(tried(FADING, 0.0, fading=9.0), [dry], 20.0).effects[0].effect is FADING


def test_members_of_a_class_that_are_not_told_apart_stand_by_simplicity():
    found = [
        tried(FADING, 0.0),
        tried(STEP, -0.2),
        tried(ce.effects.ConstantTorque(), -0.9),
        tried(DRY, -2.5),
    ]
    pool = {one.key: one for one in found}
    members = class_of(pool, found[0].key, found[0].effects[0], 20.0, 0.0)
    assert [one.name for one in members] == [
        "stribeck_friction", "constant_torque", "load_step", "coulomb_friction",
    ]  # fmt: skip
    assert sum(one.probability for one in members) == pytest.approx(1.0)
    assert members[0].probability / members[3].probability == pytest.approx(math.exp(2.5))


def spun(fading, seed):
    """A rotor with friction that fades, by SciPy."""
    time = np.arange(600) * 0.02

    def torque(t):
        return 0.6 * np.sin(0.9 * t) + 0.4 * np.sin(3.1 * t) + 0.2 * np.sin(7 * t)

    def rate(t, w):
        friction = 0.1 * np.exp(-((w[0] / fading) ** 2)) * np.tanh(w[0] / 0.05)
        return [(torque(t) - 0.02 * w[0] - friction) / 0.05]

    made = solve_ivp(rate, (0, time[-1]), [0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.01)
    speed = made.y[0] + 0.1 * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays(
        "run", time=time, T=torque(time), w=speed, units={"T": "N m", "w": "rad/s"}, inputs=["T"]
    )


@pytest.mark.slow
@pytest.mark.parametrize(("fading", "lead"), [(40.0, "coulomb_friction"), (10.0, "stribeck_friction")])
def test_the_name_that_leads(fading, lead):
    b = ce.Blueprint("rotor")
    J, c = b.parameter("J", 0.05, unit="kg m2", min=1e-3), b.parameter("c", 0.02, unit="N m s/rad", min=0)
    w, torque = b.state("w", unit="rad/s", scale=10), b.input("T", unit="N m")
    b.ode("w", (torque - c * w + b.port(PORT, "inertia", {"speed": w})) / J)
    b.output("w", w, unit="rad/s")
    found = ce.repair(
        b.model(),
        spun(fading, seed=1),
        effects=["coulomb_friction", "stribeck_friction"],
        starts=1,
        progress=False,
        seed=0,
    )
    assert found.effects[0].name == lead


def test_how_far_a_record_reaches_is_read_off_its_speeds():
    class Port:
        @staticmethod
        def courses(signal):
            return [np.array([-3.0, 8.04]), np.array([1.0, 2.0])]

    seen = StribeckFriction().fitted(Port, None, {})
    assert seen.fastest == 8.0
    assert StribeckFriction(span=(1.0, 50.0)).fitted(Port, None, {}).fastest == math.inf  # as it was given
    assert (seen.beyond({"fading": 9.0}), seen.beyond({"fading": 7.0})) == (True, False)
    assert not StribeckFriction().beyond({"fading": 1e9})
    assert not CoulombFriction().beyond({})


@pytest.mark.parametrize(("mechanical", "lead"), [(True, "coulomb_friction"), (False, "constant_torque")])
def test_where_nothing_slides_dry_friction_is_named_after_what_the_data_do_not_tell_from_it(mechanical, lead):
    """A constant power and one that follows the sign of a temperature's rise are one, where it only rises."""
    dry = tried(CoulombFriction(), 0.8, mechanical)
    constant = tried(ConstantTorque(), 0.0, mechanical)
    (name,) = [one.effect.name for one in simpler(dry, [dry, constant], 20.0).effects]
    assert name == lead
    far = tried(ConstantTorque(), -0.5, mechanical)
    assert simpler(dry, [dry, far], 20.0) is dry  # that one is told
