"""Records of one engine share their discrete matrices: made once, worked out once an iterate, told apart where due."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import casadi_engine as ce
from casadi_engine.simulation.blocks import block_matrices
from casadi_engine.simulation.discretisation import DiscreteCore
from casadi_engine.simulation.shared_core import Cores

MODEL = ce.two_mass(reciprocating_speed="measured")
Z = ca.SX.sym("z", MODEL.p.numel())
AT = np.array([MODEL.parameters()[name].value for name in MODEL.parameter_names])
DATA = Path(__file__).parents[2] / "data"


def of(cores, *, model=MODEL, physical=Z, z=Z, step=1e-4, hold=None, scale=None, method="exact"):
    """The core of the two masses, but for what a test changes."""
    hold = hold or ("first",) * len(MODEL.drives)
    scale = np.ones(len(MODEL.states)) if scale is None else scale
    return cores.of(model, z, physical, step=step, hold=hold, scale=scale, method=method)


def test_one_core_for_records_sampled_alike():
    cores = Cores()
    first = of(cores)
    assert of(cores, z=ca.vertcat(*[Z[k] for k in range(Z.numel())])) is first
    # time stamps of a longer record are rounded otherwise
    assert of(cores, step=1e-4 * (1 + 1e-11)) is first


@pytest.mark.parametrize(
    "change",
    [
        {"step": 1e-4 * (1 + 1e-9)},
        {"hold": ("zero",) * len(MODEL.drives)},
        {"scale": np.full(len(MODEL.states), 2.0)},
        {"method": "euler"},
        {"physical": 2 * Z},
        {"model": ce.two_mass(reciprocating_speed="measured")},
    ],
    ids=lambda change: next(iter(change)),
)
def test_another_core_where_anything_differs(change):
    cores = Cores()
    assert of(cores, **change) is not of(cores)


def test_blocks_are_made_once_an_iterate(monkeypatch):
    calls = []
    plain = DiscreteCore.at
    monkeypatch.setattr(
        DiscreteCore, "at", lambda self, z, order: calls.append(order) or plain(self, z, order)
    )
    shared, samples = of(Cores()), np.arange(16)
    made = shared.blocks(AT, 1, 16, samples)
    assert shared.blocks(AT.copy(), 1, 16, samples) is made
    assert calls == [1]
    longer = shared.blocks(AT, 1, 32, samples)
    assert longer.length == 32
    assert calls == [1]
    moved = AT.copy()
    moved[0] *= 1.5
    assert shared.blocks(moved, 1, 16, samples) is not made
    again = shared.blocks(AT, 1, 16, samples)
    assert again is not made
    assert calls == [1, 1, 1]
    assert_array_equal(again.p, made.p)


def test_a_vector_changed_in_place_is_another_iterate():
    shared, samples, z = of(Cores()), np.arange(16), AT.copy()
    made = shared.blocks(z, 0, 16, samples)
    z[0] *= 1.5
    expected = block_matrices(shared.core.at(z, 0), 16, samples)
    assert_array_equal(shared.blocks(z, 0, 16, samples).p, expected.p)
    assert not np.array_equal(made.p, expected.p)


def test_a_fit_of_two_records_makes_one_core(monkeypatch):
    made = []
    plain = DiscreteCore.__init__

    def counted(self, *args, **kwargs):
        made.append(self)
        plain(self, *args, **kwargs)

    monkeypatch.setattr(DiscreteCore, "__init__", counted)
    record = ce.read_experiment(DATA / "misfire_1200rpm.csv.gz", optional=("omega_load",))
    parts = [record.between(0.0, 0.1), record.between(0.2, 0.3)]
    model = ce.two_mass(reciprocating_speed="measured")
    counts = {}
    for varies in (False, True):
        parameters = model.parameters()
        if varies:
            parameters.vary_by_experiment("C_eng")
        made.clear()
        ce.estimate(
            model, parts, parameters=parameters, noise=ce.Noise(omega=0.1), progress=False, max_iterations=1
        )
        counts[varies] = len(made)
    assert counts[True] > counts[False]
