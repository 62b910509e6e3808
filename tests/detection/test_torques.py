"""Torque tables learned from the pressures behind a fit, and fits that they cannot be learned from."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.detection.torques import learn_torques
from casadi_engine.errors import ModelError


def test_motored_cylinders_and_combustions_have_the_simulators_torque(fit):
    from simulator.geometry import cylinder_torque
    from simulator.pressure import pressure, unequal_cylinders

    tables = learn_torques(fit)
    assert tables.order.tolist() == [1, 3, 4, 2]
    assert tables.spans == 1
    inertia = fit.values["J_eng"]
    angle = np.arange(tables.known.shape[1]) * 4 * np.pi / tables.known.shape[1]
    one = unequal_cylinders()
    still = np.zeros_like(angle)
    turned = [angle - at for at in (0, 3 * np.pi, np.pi, 2 * np.pi)]
    known = sum(
        cylinder_torque(a, still, pressure(a, 0.0, i)) for a, i in zip(turned, one.intake, strict=True)
    )
    assert np.abs(inertia * tables.known[0] - known).max() < 0.04 * np.abs(known).max()
    motored, burning = (pressure(angle, size, one.intake[0], one.delay[0]) for size in (0.0, 1e6))
    true = cylinder_torque(angle, still, burning) - cylinder_torque(angle, still, motored)
    near = (angle > 0.1) & (angle < 2.6)
    shape = inertia * tables.combustion[0, 0, near]
    scale = shape @ true[near] / (true[near] @ true[near])
    assert np.abs(shape - scale * true[near]).max() < 0.03 * shape.max()


def test_every_throw_of_a_crankshaft_has_its_own_column(fit):
    model = ce.crankshaft(reciprocating_speed="measured")
    seven = replace(fit, model=model, parameters=model.parameters(), estimates={})
    tables = learn_torques(seven)
    assert tables.enter.shape == (13, 4)
    used = np.abs(tables.combustion[0]).max(axis=1)
    assert used.min() > 0.9 * used.max()


def cubic_at(model, port):
    """The model with a law of the third power of the engine's speed at a port."""
    slots = [one.name for one in model.ports.with_slot]
    unit = ca.DM.zeros(len(slots), 1)
    unit[slots.index(port)] = 1e-4
    return replace(model, laws=model.laws + unit * model.x[0] ** 3)


def test_models_that_will_not_do(fit):
    linear = fit.model
    for model, seen in (
        (ce.crankshaft(angle="state"), "no channel theta"),
        (cubic_at(linear, "load"), "a law at load"),
        (cubic_at(linear, "cylinder_1"), "torques that are not quadratic in speed"),
        (replace(linear, ode=linear.ode * linear.x[0]), "no linear core"),
    ):
        with pytest.raises(ModelError, match=f"misfires cannot be found with the model .*{seen}"):
            learn_torques(replace(fit, model=model))


def test_records_that_hold_no_combustion(fit):
    record = fit.data[0]
    with pytest.raises(ModelError, match=r"no whole cycle of p1 in the fit's records"):
        learn_torques(replace(fit, data=(record.between(0.0, 0.04),)))
    names = ("theta", "p1", "p2", "p3", "p4")
    arrays = {name: np.full(len(record[name]), 1e5) for name in names[1:]} | {"theta": record["theta"].values}
    units = dict.fromkeys(names[1:], "Pa") | {"theta": "rad"}
    dead = ce.Experiment.from_arrays("dead", time=record["theta"].time, units=units, **arrays)
    with pytest.raises(ModelError, match="no combustion in p1"):
        learn_torques(replace(fit, data=(dead,)))
