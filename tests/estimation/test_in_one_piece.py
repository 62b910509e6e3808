"""A record in one interval is integrated as the record in many is."""

import numpy as np

import casadi_engine as ce
from casadi_engine.estimation.single_shots import evaluator
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator


def sliding():
    """A mass with sharp dry friction, whose linear core has an integrator of its own."""
    b = ce.Blueprint("slide")
    mass, damping = b.parameter("m", 1.0, unit="kg", min=0.1), b.parameter("c", 0.5, unit="N s/m", min=0)
    speed = b.state("v", unit="m/s")
    force = b.input("F", unit="N")
    port = b.port("slide", "inertia", {"speed": speed})
    b.ode("v", (force - damping * speed + port) / mass)
    b.output("y", speed, unit="m/s")
    return b.model().with_effect(ce.effects.CoulombFriction(), at="slide")


def test_steps_that_are_short_in_places_are_so_in_one_piece_too():
    """The other integrator may not be able to follow the law at all: a repair of a quarter of a car, whose fit had
    taken implicit steps, ended there."""
    t = np.arange(200) * 0.01
    data = ce.Experiment.from_arrays(
        "r", time=t, units={"F": "N", "y": "m/s"}, F=np.sin(6 * t), y=np.zeros_like(t)
    )
    model = sliding()
    (record,) = evaluator(model, [data], model.parameters(), ce.Noise(y=0.01)).records
    assert not isinstance(record.single().propagator, RungeKuttaPropagator)
    assert record.step_in_places(anyway=True)
    assert isinstance(record.single().propagator, RungeKuttaPropagator)
