"""Laws that no library has and that are so large that nothing linearised shows them: refitted in the equations."""

import functools
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.deadline import TimeUp
from casadi_engine.discrepancy import additions, law_race
from casadi_engine.discrepancy.law_refit import leading
from casadi_engine.discrepancy.law_setups import KINDS, setups_elsewhere
from casadi_engine.discrepancy.random_families import smooth_family
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.unknown_law import UnknownLaw, near_of

LEVEL = 0.005


def stage():
    b = ce.Blueprint("stage")
    inertia = b.parameter("J", 0.012, unit="kg m2", min=0.001, max=0.1)
    damping = b.parameter("c", 0.03, unit="N m s/rad", min=0, max=1)
    stiffness = b.parameter("k", 0.4, unit="N m/rad", min=0, max=5)
    angle, rate = b.state("angle", unit="rad"), b.state("rate", unit="rad/s")
    u = b.input("u", unit="N m")
    pivot = b.port("pivot", "inertia", {"speed": rate, "angle": angle})
    b.ode("angle", rate)
    b.ode("rate", (u - damping * rate - stiffness * angle + pivot) / inertia)
    b.output("theta", angle, unit="rad")
    return b.model()


def cogging(angle, rate):
    return 0.6 * np.sin(6 * angle)


def wave(angle, rate):
    return 0.2 * np.sin(0.7 * rate)


def record(law, seed, name):
    """A record of the stage driven by five sines, with coloured noise; by SciPy."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 8, 800)
    rate, phase, size = (rng.uniform(low, high, 5) for low, high in ((0.3, 2.5), (0, 6.3), (0.1, 0.3)))
    drive = (size * np.sin(2 * np.pi * np.outer(time, rate) + phase)).sum(axis=1)

    def ode(t, x):
        acts = np.interp(t, time, drive) - 0.02 * x[1] - 0.5 * x[0] + law(*x)
        return [x[1], acts / 0.01]

    angle = solve_ivp(ode, (0, 8), [0.1, 0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.01).y[0]
    noise = LEVEL * rng.standard_normal(len(time))
    for k in range(1, len(time)):
        noise[k] = 0.8 * noise[k - 1] + 0.6 * noise[k]
    units = {"u": "N m", "theta": "rad"}
    return ce.Experiment.from_arrays(name, time=time, units=units, u=drive, theta=angle + noise)


@functools.cache
def answer(law, seed=1):
    data, fresh = record(law, seed, "data"), record(law, seed + 100, "fresh")
    return ce.repair(stage(), data, fresh=fresh, starts=1, progress=False)


# The quick run looks for a law of the angle; laws of the speed are found by a linearised search in test_unknown_law.py.
LAWS = [(cogging, "angle"), pytest.param(wave, "speed", marks=pytest.mark.slow)]


@pytest.mark.parametrize(("law", "signal"), LAWS)
def test_a_large_law_is_found_where_it_acts(law, signal):
    found = answer(law)
    assert found.verdict == "unnamed"
    assert (found.unknown.port, found.unknown.signal) == ("pivot", signal)
    assert found.unknown.odds > 1000
    assert f"an unknown torque at pivot that depends on its {signal}" in found.unknown.sentence


@pytest.mark.parametrize(("law", "signal"), LAWS)
def test_its_course_is_the_truth_but_for_what_the_parameters_take(law, signal):
    course = answer(law).unknown.course
    where = course.family.visited > 0.005
    v, found = course.signal[where], course.mean[where]
    truth = law(v, 0.0) if signal == "angle" else law(0.0, v)
    # a level and a slope are the springs' and dampers' too
    line = np.polyfit(v, found - truth, 1)
    left = found - truth - np.polyval(line, v)
    assert np.std(left) < 0.12 * np.std(truth)
    assert "linear" not in answer(law).unknown.sentence


@pytest.mark.slow  # test_coloured_screen.py has coloured noise in the quick run
def test_coloured_noise_alone_is_no_law():
    found = answer(lambda angle, rate: 0.0 * angle, 3)
    assert found.verdict == "nothing missing"
    assert found.unknown is None


def test_windows_double_up_to_the_whole_record():
    data = record(wave, 1, "data")
    problem = law_race.RefitProblem(
        stage(), (data,), stage().parameters().unconstrained(), levels={"theta": LEVEL}
    )
    *lengths, whole = law_race._horizons(problem)
    assert whole is None
    assert np.allclose(np.diff(np.log2(lengths)), 1)
    assert lengths[-1] >= data.span[1] / 2 > lengths[0]


@pytest.fixture(scope="module")
def searched():
    """The refits of a stage with cogging: no law of the library, far from the model."""
    kept = []

    class AskedError(Exception):
        """The search got there."""

    def kept_and_ended(self):
        kept.append(self)
        raise AskedError

    data = record(cogging, 1, "data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(additions.Additions, "run", kept_and_ended)
        with pytest.raises(AskedError):
            ce.repair(stage(), data, starts=1, progress=False)
    return kept[0].refits


def test_functions_that_follow_the_motion_lead_and_are_followed_once(searched):
    assert leading(searched)[0] == ("pivot", "angle")
    assert ("pivot", "angle") in law_race.Race.of(searched).whole
    begun, count = law_race.raced(searched)
    assert begun[0].at == ("pivot", "angle")
    assert count >= len(begun)
    again = law_race.raced(searched)[0]
    assert [one is other for one, other in zip(begun, again, strict=True)]


def test_nothing_leads_that_leaves_more_than_noise_over_short_windows(searched, monkeypatch):
    monkeypatch.setattr("casadi_engine.discrepancy.law_race._FOLLOWS", 0.1)
    assert leading(searched) == []
    monkeypatch.setattr("casadi_engine.discrepancy.law_refit.is_far", lambda null: False)
    assert leading(searched) == []


def test_a_function_that_needs_more_work_than_it_may_have_is_none_that_failed(searched):
    race = law_race.Race.of(searched)
    (setup, *_) = race.setups
    model, parameters = setup.model, setup.parameters
    none = searched.pool[frozenset()]
    with pytest.raises(TimeUp):
        law_race.short(searched, none, model, parameters, 1e-9)
    own = law_race.Race(setups=race.setups)
    kept, searched.race = searched.race, own
    try:
        law_race._through(searched, none, {setup.at: setup}, (), 1e-9)
        assert not own.begun
        assert not own.failed
        law_race._through(searched, none, {setup.at: setup}, (), 1.0)
        assert setup.at in own.begun
    finally:
        searched.race = kept


def test_a_parameter_may_change_with_time(searched):
    """Time was no signal of a refitted function, so that a state which falls with it took its place."""
    family = smooth_family("parameter_J", "time", np.array([0.0, 1.0]))
    (setup,) = setups_elsewhere(searched, searched.pool[frozenset()], family)
    (data,) = searched.refitter.data
    assert (setup.family.low, setup.family.high) == pytest.approx((0.0, data.duration), rel=0.01)
    ode = setup.model.closed_ode
    assert ca.depends_on(ode, setup.model.t)


def test_the_same_function_by_another_name_is_followed_once():
    one, other, third = (
        law_race.Begun(None, None, SimpleNamespace(cost=cost)) for cost in (10.0, 10.0 + 1e-7, 10.1)
    )
    assert other.is_again([one])
    assert not third.is_again([one])


def test_a_port_at_which_nothing_can_act_has_no_law():
    model = stage()
    assert [p.kind for p in model.ports if p.kind in KINDS] == ["inertia", "input"]


@pytest.mark.slow
def test_an_input_that_saturates_is_found_as_one():
    """A bend of the input that leads the linear search to names of other things."""
    rng = np.random.default_rng(4)
    time = np.linspace(0, 8, 800)
    drive = 0.8 * np.sin(2 * np.pi * 0.4 * time) + 0.4 * np.sin(2 * np.pi * 0.9 * time + 1)

    def ode(t, x):
        acts = np.clip(np.interp(t, time, drive), -0.4, 0.4) - 0.02 * x[1] - 0.5 * x[0]
        return [x[1], acts / 0.01]

    angle = solve_ivp(ode, (0, 8), [0.1, 0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.01).y[0]
    units = {"u": "N m", "theta": "rad"}
    noisy = angle + LEVEL * rng.standard_normal(len(time))
    data = ce.Experiment.from_arrays("data", time=time, units=units, u=drive, theta=noisy)
    found = ce.repair(stage(), data, starts=1, progress=False)
    assert found.verdict == "unnamed"
    assert (found.unknown.port, found.unknown.signal) == ("input_u", "value")
    assert "the input u acts as another function of its value" in found.unknown.sentence


@pytest.mark.parametrize(
    ("log", "share", "imitators", "price", "excludes"),
    [
        (2.0, 0.0, 2, 0.0, False),
        (9.0, 0.5, 1, 0.0, True),
        (9.0, 0.95, 1, 0.0, False),
        (9.0, 0.95, 2, 3.5, True),
        (4.4, 0.95, 2, 3.5, False),  # that they are two names is all that speaks against them
    ],
)
def test_one_name_that_comes_near_is_kept_and_several_are_not(log, share, imitators, price, excludes):
    assert UnknownLaw(None, log, share, price=price, imitators=imitators).excludes is excludes


@pytest.mark.parametrize(
    ("share", "law", "at", "excluded"),
    [
        (0.97, False, "shaft", True),
        (0.995, False, "shaft", False),
        (0.85, True, "shaft", False),
        (0.97, True, "body", True),
        (0.995, True, "body", False),
    ],
)
def test_constants_events_and_effects_elsewhere_have_to_come_nearer_to_what_a_law_does(
    share, law, at, excluded
):
    """The mean of a damper that differs by direction is a constant force on the body: no name for the damper. What
    leaves a tenth of the gap (rmse), which is a hundredth of chi-squared, leaves what a person sees."""
    effect = SimpleNamespace(is_law=law, candidate=SimpleNamespace(port=at), nuisance={})
    near = near_of(SimpleNamespace(effects=(effect,)), "shaft", "speed")
    assert UnknownLaw(None, 9.0, share, False, near).excludes is excluded


def test_no_law_of_the_motion_is_nearly_a_drift():
    """A bath sensor that drifts was "a wrong gain" of it, which explained 93 % of what the drift does and left twice
    the noise, with a drift "far more probable" below."""
    effect = SimpleNamespace(is_law=True, candidate=SimpleNamespace(port="sensor_bath"), nuisance={})
    by_signal = {s: near_of(SimpleNamespace(effects=(effect,)), "sensor_bath", s) for s in ("value", "time")}
    assert not UnknownLaw(None, 9.0, 0.93, False, by_signal["value"]).excludes
    assert UnknownLaw(None, 9.0, 0.93, False, by_signal["time"]).excludes


def test_a_law_that_bends_to_any_curve_has_to_explain_it_all():
    """An overflow, with an edge and a share, came near to a needle in which a liquid thins, and was "confirmed"."""
    at = SimpleNamespace(port="pipe")
    effects = [
        SimpleNamespace(is_law=True, candidate=at, nuisance=dict.fromkeys(names))
        for names in ((), ("fading",), ("edge", "share"))
    ]
    near = [near_of(SimpleNamespace(effects=(one,)), "pipe", "flow") for one in effects]
    assert near[0] == near[1] < near[2]
    assert near[2] == near_of(SimpleNamespace(effects=()), "pipe", "flow")


@pytest.mark.parametrize(
    ("acts", "nuisance", "law"),
    [
        (lambda x, u, t: -x, {}, True),
        (lambda x, u, t: u, {}, True),  # a gain of an input
        (lambda x, u, t: ca.SX(1.0), {}, False),  # a constant
        (lambda x, u, t: ca.SX(1.0) * (t > 2), {}, False),
        (lambda x, u, t: -x, {"time": SimpleNamespace(over="time")}, False),  # an event
    ],
)
def test_a_law_depends_on_the_motion_or_on_an_input(acts, nuisance, law):
    x, u, d, t = (ca.SX.sym(name) for name in "xudt")
    none = ca.SX.zeros(1, 1)
    source = SimpleNamespace(
        slots=acts(x, u, t),
        drives=none,
        outputs=none,
        model=SimpleNamespace(x=x, u=u, d=d),
        effect=SimpleNamespace(nuisance=nuisance),
    )
    assert Addition(SimpleNamespace(source=source), 1.0).is_law is law
