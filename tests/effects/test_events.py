"""Events with a time of their own in every record, from SciPy's runs; impulses; starts that cannot be."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import Impulse, LoadStep, Misfire, by_record
from casadi_engine.errors import EffectError
from casadi_engine.model import two_mass

TIME = 0.01 * np.arange(300)
INERTIA, FRICTION = 0.4, 0.15
MODEL = ce.one_inertia()
NOISE = ce.Noise(omega=0.02)


BLOW = 0.032  # s, of a half sine


def shaft(name, seed, *, step=None, blow=None, start=0.0):
    """J w' = T - C w with a load of `step` = (N m, s), or a half sine of `blow` = (N m s, s of its middle)."""
    if step:
        corners, loads = (0.0, step[1], TIME[-1]), (lambda t: 0.0, lambda t: step[0])
    else:
        first, size = blow[1] - BLOW / 2, 0.5 * np.pi * blow[0] / BLOW
        corners = (0.0, first, first + BLOW, TIME[-1])
        loads = (lambda t: 0.0, lambda t: -size * np.sin(np.pi * (t - first) / BLOW), lambda t: 0.0)
    speed, w = np.empty(len(TIME)), 20.0
    for low, high, load in zip(corners, corners[1:], loads, strict=False):
        inside = (low <= TIME) & (high >= TIME)
        run = solve_ivp(
            lambda t, y, load=load: (6 + 3 * np.sin(4 * t) - load(t) - FRICTION * y) / INERTIA,
            (low, high), [w], dense_output=True, rtol=1e-10, atol=1e-10,
        )  # fmt: skip
        speed[inside], w = run.sol(TIME[inside])[0], run.y[0][-1]
    noisy = speed + 0.02 * np.random.default_rng(seed).standard_normal(len(TIME))
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(
        name, time=start + TIME, units=units, T=6 + 3 * np.sin(4 * TIME), omega=noisy
    )


def within(fit, **truths):
    for name, truth in truths.items():
        found = fit.estimates[name.replace("__", ".").replace("_at_", "@")]
        assert found.stderr > 0, name
        assert abs(found.value - truth) < 3 * found.stderr, name


def test_three_records_have_a_step_each_at_its_own_time():
    times = {"a": 0.8137, "b": 2.2049, "c": 1.5}
    data = [shaft(name, k, step=(2.0, time), start=10.0 * k) for k, (name, time) in enumerate(times.items())]
    model = MODEL.with_effect(LoadStep(), at="engine", values={"torque": 1.0})
    key = "engine.load_step"
    near = {name: 10.0 * k + time + 0.04 for k, (name, time) in enumerate(times.items())}
    pars = by_record(model, data, starts={f"{key}.time": near})
    assert pars[f"{key}.time"].in_record("b") == (pytest.approx(12.2449), 10.0, pytest.approx(12.99))
    fit = ce.estimate(model, data, parameters=pars, noise=NOISE, progress=False)
    assert fit.converged
    assert [name for name in fit.free if "@" in name] == [f"{key}.time@{name}" for name in times]
    within(fit, J_eng=INERTIA, engine__load_step__torque=2.0)
    for k, (name, time) in enumerate(times.items()):
        found = fit.estimates[f"{key}.time@{name}"]
        assert abs(found.value - 10 * k - time) < 3 * found.stderr < 0.06


@pytest.mark.parametrize(
    ("start", "torque", "approach"),
    [
        *((start, 1.0, "direct") for start in (0.82, 0.85, 1.2)),
        *(pytest.param(start, 0.0, "prediction", marks=pytest.mark.slow) for start in (0.82, 0.85, 1.2)),
    ],
)
def test_one_record_keeps_the_plain_name(start, torque, approach):
    data = shaft("a", 3, step=(2.0, 0.8137))
    model = MODEL.with_effect(LoadStep(), at="engine", values={"torque": torque})
    pars = by_record(model, data, MODEL.parameters(), starts={"engine.load_step.time": {"a": start}})
    fit = ce.estimate(model, data, parameters=pars, noise=NOISE, approach=approach, progress=False)
    assert fit.converged
    within(fit, engine__load_step__torque=2.0, engine__load_step__time=0.8137)


def test_blows_at_two_times_have_one_size():
    data = [shaft("a", 0, blow=(1.5, 0.8137)), shaft("b", 1, blow=(1.5, 2.2049))]
    effect = Impulse().fitted(None, data[0], {})
    assert effect.width == pytest.approx(0.01)
    assert Impulse(width=0.1).fitted(None, data[0], {}).width == 0.1
    model = MODEL.with_effect(effect, at="engine", values={"impulse": 0.5})
    pars = by_record(model, data, starts={"engine.impulse.time": {"a": 0.84, "b": 2.18}})
    fit = ce.estimate(model, data, parameters=pars, noise=NOISE, progress=False)
    within(fit, engine__impulse__impulse=1.5, J_eng=INERTIA)
    for name, time in (("a", 0.8137), ("b", 2.2049)):
        assert fit.values[f"engine.impulse.time@{name}"] == pytest.approx(time, abs=0.006)
    assert Impulse().name not in [one.name for one in ce.effects.library()]
    assert ce.effects.library("impulse") == (Impulse(),)


def test_each_record_loses_cycles_of_its_own():
    """The cycles of a misfire are numbers of the model, held for each record: torque is lost in those alone."""
    time = np.arange(0, 0.4, 2e-4)
    theta = 125.66 * time
    units = {"theta": "rad", "T_load": "N m", **{f"p{k}": "Pa" for k in range(1, 5)}}
    pressures = {f"p{k}": 1e5 + 2e6 * np.maximum(np.sin(0.5 * theta + k), 0) ** 6 for k in range(1, 5)}
    data = [
        ce.Experiment.from_arrays(name, time=time, units=units, theta=theta, T_load=0 * time, **pressures)
        for name in ("a", "b")
    ]
    base = two_mass()
    model = base.with_effect(Misfire(by_record=True), at="cylinder_2", values={"lost": 1.0})
    key = "cylinder_2.misfire"
    pars = by_record(model, data, starts={f"{key}.first": {"a": 1, "b": 3}, f"{key}.last": {"a": 2, "b": 3}})
    assert pars[f"{key}.lost"].vary
    pmap = ce.parameters.compile(pars, model.parameter_names, ("a", "b"))
    for record, cycles in (("a", (1, 2)), ("b", (3, 3))):
        p = pmap.unpack(pmap.start, record)
        known = dict(zip(model.parameter_names, p.tolist(), strict=True))
        assert (known[f"{key}.first"], known[f"{key}.last"]) == cycles
        constant = base.with_effect(
            Misfire(), at="cylinder_2", values={"lost": 1.0, "first": cycles[0], "last": cycles[1]}
        )
        run, expected = (
            ce.simulate(
                one,
                data[0],
                parameters=values,
                initial={"omega_eng": 125.66, "omega_load": 125.66, "twist": 0.0},
            )
            for one, values in ((model, known), (constant, {f"{key}.lost": 1.0}))
        )
        np.testing.assert_allclose(run["omega"].values, expected["omega"].values, rtol=1e-9)


@pytest.mark.parametrize(
    ("effect", "at", "starts", "message"),
    [
        (LoadStep(), "load", {"load.step": {"a": 1}}, "load.step, which is no time or cycle of an effect of the model"),
        (LoadStep(), "load", {"load.load_step.time": {"c": 1}}, "given for c, which is no record of these data"),
        (LoadStep(), "load", {"load.load_step.time": {"a": 9}}, r"is outside the record a; seen: 9 s; allowed: 0 to"),
        (Misfire(by_record=True), "cylinder_1", {}, r"misfire.first needs a cycle of the record a; seen: None"),
        (
            Misfire(by_record=True), "cylinder_1", {"cylinder_1.misfire.first": {"a": 1.5}},
            r"misfire.first needs a cycle of the record a; seen: 1.5",
        ),
    ],
)  # fmt: skip
def test_wrong_starts_are_refused(effect, at, starts, message):
    model = two_mass().with_effect(effect, at=at)
    data = [shaft(name, 0, step=(1.0, 1.0)) for name in ("a", "b")]
    with pytest.raises(EffectError, match=message):
        by_record(model, data, starts=starts)


def test_a_load_step_in_a_repair_is_as_wide_as_a_sample_and_its_impulse_that_of_a_sharp_one():
    times = np.arange(400) * 0.05
    columns = {"T": np.zeros(400), "omega": np.zeros(400)}
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays("still", time=times, units=units, T=columns["T"], omega=columns["omega"])
    rounded = LoadStep().fitted(None, data, {})
    assert rounded == LoadStep(width=0.05)
    assert LoadStep(width=0.2).fitted(None, data, {}) == LoadStep(width=0.2)
    runs = [
        ce.simulate(
            MODEL.with_effect(one, at="engine", values={"torque": 2.0, "time": 10.0131}), data,
            initial={"omega_eng": 0.0},
        )["omega"].values
        for one in (LoadStep(), rounded)
    ]  # fmt: skip
    apart = np.abs(runs[1] - runs[0])
    size = np.abs(runs[0]).max()
    assert apart[np.abs(times - 10.0131) > 0.4].max() < 1e-3 * size
    # three widths away nothing is left of it
    assert 0 < apart.max() < 0.05 * size
