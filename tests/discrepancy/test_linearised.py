"""Candidates in one step, against least squares, and in the place of an effect that is there."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import candidate_columns
from casadi_engine.discrepancy.linearised import one_step, without_effect
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.discrepancy.path import Path
from casadi_engine.discrepancy.refit import addition
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.start import Start
from casadi_engine.simulation.candidate_sensitivities import torque_direction


def test_chi_squared_amplitude_and_error_are_those_of_least_squares(shaft):
    """Parameters and first states free."""
    null = shaft.null(
        shaft.data(seed=4, hidden=lambda t, x: np.array([0.6 * np.tanh((x[1] - x[0]) / 0.5)] * 2))
    )
    candidates = shaft.candidates(shaft.model)[:5]
    found = one_step(null, candidates, shaft.sigma)
    (record,) = null.records
    columns = candidate_columns(record, candidates)
    sigma = shaft.sigma
    known = np.concatenate([record.slopes[out] / sigma[out] for out in record.outputs])
    e = np.concatenate([record.residual[out] / sigma[out] for out in record.outputs])
    for k in range(len(candidates)):
        own = np.concatenate([columns[out][:, k] / sigma[out] for out in record.outputs])
        x = np.column_stack([known, own])
        x = x / np.linalg.norm(x, axis=0)
        step, *_ = np.linalg.lstsq(x, e, rcond=None)
        size = np.linalg.norm(own)
        assert found.amplitude[k] == pytest.approx(step[-1] / size, rel=1e-4)
        assert found.error[k] == pytest.approx(np.sqrt(np.linalg.inv(x.T @ x)[-1, -1]) / size, rel=1e-4)
        wrong_side = found.amplitude[k] * candidates[k].side < 0
        if not wrong_side:
            assert found.cost[k] == pytest.approx(((e - x @ step) ** 2).sum(), rel=1e-6)


def test_levels_weigh_the_outputs(shaft):
    null, candidates = shaft.null(shaft.data(seed=4)), shaft.candidates(shaft.model)[:2]
    first = one_step(null, candidates, shaft.sigma)
    then = one_step(null, candidates, {name: 3 * sigma for name, sigma in shaft.sigma.items()})
    np.testing.assert_allclose(then.cost, first.cost / 9)
    np.testing.assert_allclose(then.amplitude, first.amplitude)
    np.testing.assert_allclose(then.error, 3 * first.error)


def test_a_candidate_without_a_finite_slope_has_no_step(shaft):
    null = shaft.null(shaft.data(n=60))
    speed = shaft.model.ports["load"].signals["speed"]
    endless = torque_direction(shaft.model, "load", ca.sqrt(speed - 1e3), name="endless")
    assert one_step(null, [Candidate("endless", "load", endless)], shaft.sigma) is None


# ---- in the place of an effect


def hand_made(turn):
    rng = np.random.default_rng(1)
    names = ("k", "load.dry.torque", "load.dry.width", "load.dry_too.torque")
    slopes, residual = {"y": rng.standard_normal((6, 5))}, {"y": rng.standard_normal(6)}
    record = RecordNull("run", None, residual, {}, {}, {}, {}, slopes, ("x",))
    values = np.array([1.0, 2.0, 3.0, 4.0])
    model = SimpleNamespace(states=("x",))
    return NullModel(model, names, ("1",) * 4, values, turn, np.arange(10.0).reshape(2, 5), (record,))


DRY = SimpleNamespace(key="load.dry", amplitude="load.dry.torque")


def test_what_an_effect_explains_is_left_to_others_and_its_numbers_are_gone():
    null = hand_made(np.diag([1.0, 0.5, 2.0, 1.0]))
    found = without_effect(null, DRY)
    old, (new,) = null.records[0], found.records
    np.testing.assert_allclose(new.residual["y"], old.residual["y"] + old.slopes["y"][:, 1] * 2.0 / 0.5)
    np.testing.assert_array_equal(new.slopes["y"], old.slopes["y"][:, [0, 3, 4]])
    np.testing.assert_array_equal(found.prior, null.prior[:, [0, 3, 4]])
    assert found.turn.shape == (4, 2)
    np.testing.assert_array_equal(found.turn, null.turn[:, [0, 3]])


def test_what_an_effect_does_in_other_records_may_stay():
    null = hand_made(np.diag([1.0, 0.5, 2.0, 1.0]))
    here, elsewhere = without_effect(null, DRY, only="run"), without_effect(null, DRY, only="other")
    every = without_effect(null, DRY)
    np.testing.assert_array_equal(here.records[0].residual["y"], every.records[0].residual["y"])
    np.testing.assert_array_equal(elsewhere.records[0].residual["y"], null.records[0].residual["y"])
    np.testing.assert_array_equal(elsewhere.records[0].slopes["y"], every.records[0].slopes["y"])


def test_amplitudes_by_record_go_together():
    null = hand_made(np.eye(4))
    null = replace(null, parameters=("k", "load.dry.torque@a", "load.dry.torque@b", "load.dry_too.torque"))
    found = without_effect(null, DRY)
    slopes = null.records[0].slopes["y"]
    wanted = null.records[0].residual["y"] + slopes[:, 1:3] @ [2.0, 3.0]
    np.testing.assert_allclose(found.records[0].residual["y"], wanted)


def test_directions_that_are_mixed_have_no_way_back():
    mixed = np.eye(4)
    mixed[0, 1] = 0.3
    assert without_effect(hand_made(mixed), DRY) is None
    assert without_effect(hand_made(np.eye(4)[:, :3]), DRY) is None


def test_where_a_state_of_its_own_began_goes_with_it_and_others_stay():
    """Nothing was exchanged beside a lag or a storage, as the model had more states than without effects."""
    null = hand_made(np.eye(4))
    slopes = np.column_stack([null.records[0].slopes["y"], np.ones(6)])
    record = replace(null.records[0], slopes={"y": slopes}, starts=("load_dry_stored", "load_dryer_stored"))
    found = without_effect(replace(null, records=(record,)), DRY)
    assert found.records[0].starts == ("load_dryer_stored",)
    np.testing.assert_array_equal(found.records[0].slopes["y"], slopes[:, [0, 3, 5]])


def test_in_its_own_place_an_effect_comes_back_with_its_size(pendulum):
    """And without any in its place chi-squared is far higher."""
    data = pendulum.decay(lambda t, angle, rate: -0.02 * rate * abs(rate), c=0.3)
    fit = ce.estimate(pendulum.model, data, noise=ce.Noise(y=pendulum.level), progress=False)
    candidates = screen(fit, ["quadratic_drag", "coulomb_friction"], colour=False).candidates
    drag = next(c for c in candidates if c.effect == "quadratic_drag")
    one = addition(drag, 0.01)
    path = Path(pendulum.refitter(data), {"y": pendulum.level})
    end = path.from_point([one], Start.of(fit))
    rest = without_effect(path.null_at([one], end), one)
    step = one_step(rest, candidates, path.levels)
    k = candidates.index(drag)
    assert step.amplitude[k] == pytest.approx(end.values[one.amplitude], rel=0.02)
    assert step.cost[k] == pytest.approx(end.cost, rel=0.02)
    assert step.cost[k] < 0.5 * min(np.delete(step.cost, k))
