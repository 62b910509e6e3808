"""Priors: physical, in the scales of the records, whatever the units."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import casadi_engine as ce
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.discrepancy.path import Path
from casadi_engine.discrepancy.priors import PHYSICAL, SENSOR, SHORTER, STATED, WHOLE, priors_of
from casadi_engine.discrepancy.refit import addition
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.start import Start
from casadi_engine.effects import Amplitude
from casadi_engine.effects.protocol import Grid

SCALES = st.floats(-6, 6).map(lambda power: 10.0**power)


def effect(kind="inertia", *, unit="N m", low=-np.inf, **nuisance):
    """An effect to add, called extra, at a port of some kind."""
    made = SimpleNamespace(amplitude=Amplitude("size", unit=unit, min=low), nuisance=nuisance)
    source = SimpleNamespace(effect=made, model=SimpleNamespace(ports={"port": SimpleNamespace(kind=kind)}))
    return addition(Candidate("extra", "port", None, source=source), 1.0)


def record(slopes, measured, *, name="run", span=6.0):
    """One output y: slopes (N, k), measured (N,)."""
    grid = SimpleNamespace(measured={"y": SimpleNamespace(values=measured)}, span=span)
    return RecordNull(
        name=name, path=SimpleNamespace(grid=grid), residual={"y": np.zeros(len(measured))}, time={}, index={},
        length={}, cycle={}, slopes={"y": slopes}, starts=(),
    )  # fmt: skip


def null_of(names, values, records, turn=None):
    turn = np.eye(len(names)) if turn is None else turn
    return NullModel(
        None,
        names,
        ("1",) * len(names),
        np.asarray(values, dtype=float),
        turn,
        np.zeros((0, 1)),
        tuple(records),
    )


def one_amplitude(slope, measured, value=1e9, **options):
    """The prior of the only amplitude."""
    null = null_of(("port.extra.size",), [value], [record(slope[:, None], measured)])
    return priors_of(null, None, [effect(**options)])["port.extra.size"]


SLOPE = np.array([1.0, -3.0, 2.0, 0.5])
MEASURED = np.array([10.0, 14.0, 12.0, 11.0])


@pytest.mark.parametrize(
    ("kind", "share"), [("inertia", PHYSICAL), ("coupling", PHYSICAL), ("sensor", SENSOR)]
)
def test_an_amplitude_moves_the_output_as_much_as_it_varies_or_a_sensor_a_share_of_it(kind, share):
    found = one_amplitude(SLOPE, MEASURED, kind=kind)
    moved = found.deviation * np.sqrt(np.mean(SLOPE**2))
    assert moved == pytest.approx(share * np.std(MEASURED))
    assert found.amplitude
    assert not found.one_sided


@pytest.mark.parametrize("name", ["sensor_lag", "input_lag", "input_delay"])
def test_what_is_late_is_so_with_all_of_it_but_for_a_tenth(name):
    """With any part of it where the time is the shortest that is searched, and stands for a shorter one."""
    late = effect("input", unit="1", low=0.0, time=Grid(0.2, 10, steps=6, log=True))
    late = replace(late, candidate=replace(late.candidate, effect=name))
    times = {f"{late.key}.time": SimpleNamespace(min=0.2, max=10.0, value=1.0)}
    for time, deviation in ((0.5, WHOLE), (0.2, WHOLE if name == "sensor_lag" else SHORTER)):
        null = null_of(
            (late.amplitude, *times), [0.4, time], [record(np.stack([SLOPE, SLOPE], axis=1), MEASURED)]
        )
        found = priors_of(null, times, [late])[late.amplitude]
        assert (found.deviation, found.centre, found.amplitude) == (deviation, 1.0, True)


def test_an_amplitude_on_one_side_says_so():
    assert one_amplitude(SLOPE, MEASURED, low=0.0).one_sided


def test_a_stated_number_may_be_wrong_by_a_share_of_itself():
    found = one_amplitude(SLOPE, MEASURED, kind="parameter", unit="1")
    assert found.deviation == STATED
    shifted = one_amplitude(SLOPE, MEASURED, kind="parameter", unit="kg")
    assert shifted.deviation == pytest.approx(np.std(MEASURED) / np.sqrt(np.mean(SLOPE**2)))


def test_the_output_that_the_effect_moves_most_counts():
    """Over records too: of what an effect hardly moves its size is not to be told."""
    records = [record(SLOPE[:, None] * s, MEASURED, name=str(s)) for s in (1.0, 1e-3, 4.0)]
    null = null_of(("port.extra.size",), [1e9], records)
    found = priors_of(null, None, [effect()])["port.extra.size"]
    assert found.deviation == pytest.approx(one_amplitude(SLOPE, MEASURED).deviation / 4)


def test_a_law_that_bends_has_no_slope_where_it_does_nothing_but_no_endless_prior():
    flat = one_amplitude(1e-9 * SLOPE, MEASURED, value=0.2)
    assert flat.deviation == pytest.approx(6.0)
    nothing = one_amplitude(0 * SLOPE, MEASURED, value=0.2)
    assert nothing.deviation == pytest.approx(6.0)
    assert one_amplitude(0 * SLOPE, MEASURED, value=0.0).deviation > 0
    still = one_amplitude(SLOPE, np.ones(4), value=0.2)
    assert still.deviation == pytest.approx(6.0)


@given(output=SCALES, unit=SCALES, step=SCALES)
@settings(max_examples=30, deadline=None)
def test_an_amplitude_has_the_same_prior_in_any_units(output, unit, step):
    """Of the output, of the amplitude, and of the directions in which refits move it."""
    values = [0.3, 2.0]
    slopes = np.column_stack([np.ones(4), SLOPE])
    names = ("k", "port.extra.size")
    pars = SimpleParameters(k=(0.0, 1.0, 0.5))
    before = priors_of(null_of(names, values, [record(slopes, MEASURED)]), pars, [effect()])
    written = record(output * slopes * [1, step / unit], output * MEASURED)
    turned = np.diag([1.0, step])
    after = priors_of(null_of(names, [0.3, 2.0 * unit], [written], turned), pars, [effect()])
    # turn: one step of a direction is `step` of the amplitude in its new unit
    assert after["port.extra.size"].deviation == pytest.approx(before["port.extra.size"].deviation * unit)
    assert after["k"] == before["k"]


class SimpleParameters(dict):
    """name=(min, max, value), as a parameter set has them."""

    def __init__(self, **known):
        super().__init__(
            {n: SimpleNamespace(min=low, max=high, value=v) for n, (low, high, v) in known.items()}
        )


# ---- parameters of the model and of effects


def test_base_parameters_are_known_by_their_bounds_or_by_their_size():
    pars = SimpleParameters(
        a=(2.0, 14.0, 3.0), b=(0.0, np.inf, -0.7), c=(-np.inf, np.inf, 0.0), d=(5.0, 5.0, 5.0)
    )
    null = null_of(("a", "b", "c", "d"), [3.0, 9.0, 0.4, 5.0], [record(np.ones((4, 4)), MEASURED)])
    found = priors_of(null, pars, [])
    assert found["a"].deviation == pytest.approx(12 / np.sqrt(12))
    assert found["b"].deviation == pytest.approx(7.0)
    assert found["c"].deviation == pytest.approx(4.0)  # a value of 0 says nothing of the size
    assert found["d"].deviation == pytest.approx(50.0)
    assert not any(one.amplitude for one in found.values())


def test_nuisance_values_may_be_anywhere_on_their_grid_or_in_the_record():
    one = effect(time=Grid(over="time"), speed=Grid(0.5, 5.0, log=True), share=Grid(0.0, 1.0))
    names = ("port.extra.size", "port.extra.time", "port.extra.speed", "port.extra.share")
    pars = SimpleParameters(
        **{
            "port.extra.time": (1.0, 7.0, 2.0),
            "port.extra.speed": (-np.inf, np.inf, 3.0),
            "port.extra.share": (0.0, 1.0, 0.5),
        }
    )
    slopes = np.column_stack([SLOPE] * 4)
    records = [record(slopes, MEASURED, span=6.0), record(slopes, MEASURED, name="other", span=24.0)]
    found = priors_of(null_of(names, [1.0, 2.0, 3.0, 0.5], records), pars, [one])
    assert found["port.extra.time"].deviation == pytest.approx(24 / np.sqrt(12))
    assert found["port.extra.speed"].deviation == pytest.approx(6.0)
    assert found["port.extra.share"].deviation == pytest.approx(1 / np.sqrt(12))
    assert not found["port.extra.time"].amplitude


def test_an_amplitude_by_record_has_a_prior_each():
    names = ("port.extra.size@run", "port.extra.size@other")
    null = null_of(names, [1.0, 1.0], [record(np.column_stack([SLOPE, 2 * SLOPE]), MEASURED)])
    found = priors_of(null, None, [effect()])
    assert all(one.amplitude for one in found.values())
    assert found[names[0]].deviation == pytest.approx(2 * found[names[1]].deviation)


def test_a_friction_of_a_pendulum_may_well_stop_it(pendulum):
    """One prior deviation of the torque moves the angle by the angle's own variation."""
    data = pendulum.decay(lambda t, angle, rate: -0.3 * np.tanh(rate / 0.05))
    fit = ce.estimate(pendulum.model, data, noise=ce.Noise(y=pendulum.level), progress=False)
    one = addition(screen(fit, ["coulomb_friction"], colour=False).candidates[0], 0.2)
    path = Path(pendulum.refitter(data), {"y": pendulum.level})
    null = path.residuals([one], path.from_point([one], Start.of(fit)))
    found = priors_of(null, path.parameters([one]), [one])
    assert found["pivot.coulomb_friction.torque"].one_sided
    k = null.parameters.index("pivot.coulomb_friction.torque")
    slope = null.records[0].slopes["y"][:, k] / null.turn[k, k]
    moved = found["pivot.coulomb_friction.torque"].deviation * np.sqrt(np.mean(slope**2))
    assert moved == pytest.approx(np.std(data["y"].values))
    assert found["w2"].deviation == pytest.approx(199 / np.sqrt(12))
