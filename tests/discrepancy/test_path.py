"""The path of refits: the optimum of ``estimate``, from points and from windows, and what comes with it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.first_states import first_states_on
from casadi_engine.discrepancy.path import Path, form_of
from casadi_engine.discrepancy.refit import Refitter, addition, numbers
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.start import Start
from casadi_engine.effects import Amplitude, Effect
from casadi_engine.estimation.refit_problem import EXACT


class Broken(Effect):
    """A law that is a number at an amplitude of zero alone."""

    name, attaches, kin = "broken", ("inertia",), ()
    sentence = "nonsense on {port}"
    amplitude = Amplitude("size", unit="N m")

    def law(self, port, p, math):
        return p.size * (port.speed + math.sqrt(1e-9 - p.size**2))


@pytest.fixture(scope="module")
def rubbing(pendulum):
    """Two decays with dry friction and a drag, fitted without them; the effect to add."""
    hidden = lambda t, angle, rate: -0.3 * np.tanh(rate / 0.05)  # noqa: E731
    data = (pendulum.decay(hidden), pendulum.decay(hidden, name="again", begun=0.7, seed=1, samples=300))
    refitter = pendulum.refitter(*data)
    noise = ce.Noise(y=pendulum.level)
    fit = ce.estimate(pendulum.model, data, noise=noise, progress=False)
    screened = screen(fit, ["coulomb_friction", Broken()], colour=False)
    named = {c.effect: c for c in screened.candidates}
    one = addition(named["coulomb_friction"], 0.2)
    return SimpleNamespace(
        fit=fit, data=data, noise=noise, refitter=refitter, one=one, broken=addition(named["broken"], 3.0)
    )


@pytest.fixture(scope="module")
def path(rubbing, pendulum):
    return Path(rubbing.refitter, {"y": pendulum.level}, felt=EXACT)


@pytest.fixture(scope="module")
def arrived(path, rubbing):
    return path.from_point([rubbing.one], Start.of(rubbing.fit))


def test_windows_that_lead_astray_are_left_for_the_start(rubbing, pendulum, arrived, monkeypatch):
    """From where the refit is at its optimum already, however poor the end that windows lead to."""
    own = Path(rubbing.refitter, {"y": pendulum.level}, felt=EXACT)
    monkeypatch.setattr(own, "_after_windows", lambda *_: replace(arrived, cost=100 * arrived.cost))
    at = Start(arrived.values, arrived.initial)
    assert own.from_windows([rubbing.one], at).cost == pytest.approx(arrived.cost, rel=1e-3)
    unknown = Start(arrived.values)  # without first states there is nothing to hold against it
    assert own.from_windows([rubbing.one], unknown).cost == pytest.approx(100 * arrived.cost)


def test_a_refit_arrives_where_estimate_does(rubbing, arrived):
    """Values within a hundredth of their errors, and chi-squared."""
    model = rubbing.refitter.extended([rubbing.one])
    pars = rubbing.refitter.parameters_of(model, [rubbing.one])
    fit = ce.estimate(model, rubbing.data, parameters=pars, noise=rubbing.noise, progress=False)
    assert fit.converged
    assert arrived.settled
    assert not arrived.held
    assert arrived.cost == pytest.approx(fit.cost, abs=0.01)
    assert arrived.cost < 0.2 * rubbing.fit.cost
    for name in fit.free:
        assert abs(arrived.values[name] - fit.values[name]) < EXACT * fit.stderr[name]
    for record, states in fit.initial.items():
        for name, one in states.items():
            assert abs(arrived.initial[record][name] - one.value) < 0.01 * one.stderr


def test_windows_end_where_the_whole_record_does(path, rubbing, arrived):
    found = path.from_windows([rubbing.one])
    assert found.settled
    assert found.cost == pytest.approx(arrived.cost, abs=0.01)


def test_residuals_and_slopes_are_those_of_the_null_model(path, rubbing):
    """Of one without corners, at the end of its refit."""
    end = path.from_point((), Start.of(rubbing.fit))
    here, there = path.residuals((), end), path.null_at((), end)
    assert here.parameters == there.parameters == ("w2", "c")
    np.testing.assert_allclose(here.values, there.values)
    np.testing.assert_allclose(here.turn, there.turn)
    assert here.prior.shape == there.prior.shape
    for own, other in zip(here.records, there.records, strict=True):
        assert (own.name, own.outputs, own.starts) == (other.name, other.outputs, other.starts)
        assert own.length == other.length
        for part in ("time", "index", "cycle"):
            np.testing.assert_array_equal(getattr(own, part)["y"], getattr(other, part)["y"])
        np.testing.assert_allclose(own.residual["y"], other.residual["y"], atol=1e-2 * 0.002)
        size = np.linalg.norm(other.slopes["y"], axis=0)
        off = np.linalg.norm(own.slopes["y"] - other.slopes["y"], axis=0)
        np.testing.assert_array_less(off, 1e-4 * size)
    chi2 = sum(float(r.residual["y"] @ r.residual["y"]) for r in here.records) / 0.002**2
    assert chi2 == pytest.approx(end.cost)


def test_slopes_past_a_sharp_corner_are_those_of_simulations(path, rubbing, arrived):
    """The record's longest by finite differences."""
    here = path.residuals([rubbing.one], arrived)
    pars = path.parameters([rubbing.one]).copy()
    data, initial = rubbing.data[0], arrived.initial["decay"]

    def simulated(name, value):
        for other, known in arrived.values.items():
            pars[other].set(value if other == name else known)
        run = ce.simulate(rubbing.refitter.extended([rubbing.one]), data, parameters=pars, initial=initial)
        return run["y"].values

    measured = data["y"].values
    for k, (name, value) in enumerate(zip(here.parameters, here.values, strict=True)):
        step = 1e-4 * value
        slope = (simulated(name, value + step) - simulated(name, value - step)) / (2 * step) * here.turn[k, k]
        off = np.linalg.norm(here.records[0].slopes["y"][:, k] - slope)
        assert off < 1e-3 * np.linalg.norm(slope)
    rest = measured - simulated("", 0.0)
    np.testing.assert_allclose(here.records[0].residual["y"], rest, atol=1e-2 * 0.002)


@pytest.mark.parametrize("far", [15.0, 60.0, 110.0])
def test_windows_find_the_optimum_from_starts_that_are_turns_away(pendulum, far):
    """With w2 = 60 in place of 41.3 a simulation is a whole turn ahead after five seconds."""
    pars = pendulum.model.parameters()
    pars["w2"].set(far)
    path = Path(pendulum.refitter(pendulum.decay(), parameters=pars), {"y": pendulum.level})
    found = path.from_windows(())
    assert found.settled
    assert found.cost == pytest.approx(500, abs=4 * np.sqrt(2 * 500))
    assert found.values["w2"] == pytest.approx(41.3, rel=2e-3)


def test_windows_leave_no_more_than_whole_records(pendulum, rubbing, arrived):
    """Their first states are free; where that is more than is asked for, nobody follows the whole records."""

    def anew(most):
        path = Path(rubbing.refitter, {"y": pendulum.level}, felt=EXACT)
        return path.from_windows([rubbing.one], most=most), path.bounds[form_of([rubbing.one])]

    end, bound = anew(np.inf)
    assert 0.5 * arrived.cost < bound < arrived.cost
    assert end.cost == pytest.approx(arrived.cost, abs=0.01)
    assert anew(0.9 * bound) == (None, pytest.approx(bound))


def test_a_refit_that_comes_the_same_way_ends_as_the_one_before(path, rubbing):
    once = path.from_windows([rubbing.one])
    assert path.from_windows([rubbing.one], Start({"w2": 40.0}, {})) is once


def test_windows_begin_at_the_values_of_a_start(path, rubbing):
    far = Start({"w2": 39.0, "c": 0.2, rubbing.one.amplitude: 0.05})
    found = path.from_windows([rubbing.one], far)
    assert found.values["w2"] == pytest.approx(41.3, rel=2e-3)


def test_a_model_that_fails_has_no_refit(path, rubbing):
    assert path.from_point([rubbing.broken], Start.of(rubbing.fit)) is None
    assert path.from_windows([rubbing.broken]) is None


def test_a_known_point_stays_but_for_what_is_left_of_a_step(path, rubbing):
    initial = {r: {n: e.value for n, e in own.items()} for r, own in rubbing.fit.initial.items()}
    found = path.at(rubbing.fit.values, initial)
    assert found.cost == pytest.approx(rubbing.fit.cost, rel=1e-4)
    for name, value in rubbing.fit.values.items():
        assert found.values[name] == pytest.approx(value, rel=1e-3)


def test_first_states_are_those_of_the_measurement(path, rubbing):
    found = path.first_states(rubbing.fit.model)
    assert set(found) == {"decay", "again"}
    assert found["decay"][0] == pytest.approx(1.5, abs=0.1)
    assert found["again"][0] == pytest.approx(0.7, abs=0.1)


def test_a_parameter_that_ends_at_a_bound_is_held(pendulum):
    pars = pendulum.model.parameters()
    pars["w2"].set(39.0, max=40.0)
    path = Path(pendulum.refitter(pendulum.decay(samples=100), parameters=pars), {"y": pendulum.level})
    assert path.from_point((), None).held == {"w2"}


def test_other_levels_weigh_all_further_refits(pendulum):
    path = Path(pendulum.refitter(pendulum.decay(samples=200)), {"y": pendulum.level})
    before = path.from_windows(())
    path.relevel({"y": 2 * pendulum.level})
    after = path.from_point((), before)
    assert after.cost == pytest.approx(before.cost / 4, rel=1e-3)
    null = path.residuals((), after)
    assert float(np.std(null.records[0].residual["y"])) == pytest.approx(pendulum.level, rel=0.2)


def test_a_model_is_set_up_once(path, rubbing):
    assert path.parameters([rubbing.one]) is path.parameters([rubbing.one])
    assert rubbing.one.amplitude in path.parameters([rubbing.one])


def test_equations_that_are_linear_in_the_states_say_so(path, shaft):
    assert not path.linear
    refitter = type(path.refitter)(shaft.model, shaft.model.parameters(), (shaft.data(),), None)
    assert Path(refitter, shaft.sigma).linear


def test_first_states_of_a_fresh_record_are_found_whatever_they_are(pendulum):
    """With the parameters held, from windows: a swing that goes over the top in the end is none by its first sample."""
    fresh = pendulum.decay(begun=2.6, samples=300)
    pars = pendulum.model.parameters()
    pars.fix("w2", 41.3)
    pars.fix("c", 0.05)
    found = first_states_on(pendulum.model, fresh, pars, {"y": pendulum.level})
    assert found.converged
    assert found.initial["decay"]["angle"] == pytest.approx(2.6, abs=3 * pendulum.level)
    assert found.initial["decay"]["rate"] == pytest.approx(0.0, abs=0.05)


def test_a_fresh_record_that_the_model_cannot_follow_has_no_start(pendulum, rubbing):
    model = rubbing.refitter.extended([rubbing.broken])
    pars = model.parameters()
    pars.fix(rubbing.broken.amplitude, 3.0)
    assert first_states_on(model, pendulum.decay(samples=50), pars, {"y": pendulum.level}) is None


def test_residuals_of_a_refit_are_those_of_its_own_levels(rubbing, pendulum):
    """Levels that change after a refit do not change what it left."""
    path = Path(rubbing.refitter, {"y": pendulum.level})
    arrived = path.from_point([rubbing.one], Start.of(rubbing.fit))
    before = path.residuals([rubbing.one], arrived).records[0].residual["y"]
    path.relevel({"y": pendulum.level / 5})
    after = path.residuals([rubbing.one], arrived).records[0].residual["y"]
    np.testing.assert_array_equal(before, after)
    assert np.std(after) == pytest.approx(pendulum.level, rel=0.2)


@pytest.mark.parametrize(
    ("sharp", "fails", "asked"),
    [
        (False, (), [False]),
        (False, (False,), [False, True]),
        (False, (False, True), [False, True]),
        (True, (), [True]),
        (True, (True,), [True]),
    ],
)
def test_windows_that_no_integrator_follows_begin_with_wide_corners(monkeypatch, sharp, fails, asked):
    """Of all effects, where those of the newest one are not sharp anyway; then the whole record has to do."""
    path, seen, way = Path.__new__(Path), [], object()
    first, newest = SimpleNamespace(corners=True), SimpleNamespace(corners=sharp)

    def through(effects, start, lags, *, wide):
        seen.append(wide)
        if wide in fails:
            raise FloatingPointError("its states or slopes are not finite")
        return way

    monkeypatch.setattr(path, "_through_windows", through)
    monkeypatch.setattr(path, "cornered", lambda effects: any(one.corners for one in effects))
    found = path._in_windows([first, newest], None, {})
    assert seen == asked
    assert found is (None if len(fails) == len(asked) else way)


def test_sharper_corners_are_measured_by_what_they_cost_themselves():
    path, problem = Path.__new__(Path), SimpleNamespace()
    path._work, path._least, path.refitter = {}, {}, SimpleNamespace(share=1.0)
    assert path.allowed(problem) == np.inf
    path._done(1e7, first=True)  # expected of the first refit
    assert path.allowed(problem) == 20 * 1e7
    for work in (1e6, 2e6, 3e6):
        path._done(work)
    assert path.allowed(problem) == 20 * 2e6
    path.refitter.share = 0.25
    assert path.allowed(problem) == 20 * 2e6  # until there is one
    path._done(5e8)
    assert path.allowed(problem) == 20 * 5e8
    path.refitter.share = 4.0  # wider ones on the way to them
    assert path.allowed(problem) == 20 * 5e8
    path.refitter.share = 1.0
    assert path.allowed(problem) == 20 * 2e6


def disc(mean, width):
    """A disc that turns about a mean torque, with dry friction of 0.8 N m that is rounded over a width, by SciPy; a
    path, and the friction."""
    b = ce.Blueprint("disc")
    J, c = b.parameter("J", 0.5, unit="kg m2", min=0.05), b.parameter("c", 0.3, unit="N m s/rad", min=0)
    w, T = b.state("w", unit="rad/s"), b.input("T", unit="N m")
    b.ode("w", (T - c * w + b.port("shaft", "inertia", {"speed": w})) / J)
    b.output("speed", w, unit="rad/s")
    model, time = b.model(), np.arange(300) * 0.02
    rest = solve_ivp(
        lambda t, y: [(mean + 4.0 * np.sin(2 * t) - 0.3 * y[0] - 0.8 * np.tanh(y[0] / width)) / 0.5],
        (0, time[-1]),
        [3 * mean],
        t_eval=time,
        method="LSODA",
        rtol=1e-8,
    )
    run = ce.Experiment.from_arrays(
        "run",
        time=time,
        units={"T": "N m", "speed": "rad/s"},
        T=mean + 4.0 * np.sin(2.0 * time),
        speed=rest.y[0] + 0.01 * np.random.default_rng(4).standard_normal(300),
    )
    refitter = Refitter(model, model.parameters(), (run,), ce.Noise(speed=0.01), {})
    path = Path(refitter, {"speed": 0.01})
    fit = ce.estimate(model, run, noise=ce.Noise(speed=0.01), progress=False)
    refitter.base = fit
    (friction,) = (
        one for one in screen(fit, ["coulomb_friction"], colour=False).candidates if one.port == "shaft"
    )
    return path, (addition(friction, 0.8),)


def test_a_corner_that_no_record_comes_near_is_not_felt():
    """A leak and a gain were "coulomb_friction, confirmed" at eight times the noise, which a corner of 500 Pa was to
    explain that the motion stayed 260 000 Pa away from."""
    felt = {}
    for name, mean in (("far", 12.0), ("near", 0.0)):
        path, effects = disc(mean, 1e-3)
        felt[name] = path.felt_along(effects, path.from_windows(effects))
    assert felt["far"] < 1e-6
    assert felt["near"] > 0.01


@pytest.mark.parametrize("width", [0.3, 0.15])
def test_a_law_that_is_rounded_itself_turns_on_the_way_to_sharp_corners(width):
    path, effects = disc(0.0, width)
    path.refitter.share = wide = 16 * width / path.refitter.rounded(effects[0]).width
    arrived = path.from_windows(effects)
    share, found = path.sharpest(effects, arrived, 1 / 64, 1.0)
    assert path.felt == 0.0
    assert path.turned == (share, found)
    path.refitter.share = share
    assert 0.2 * width < path.refitter.rounded(effects[0]).width < 5 * width
    assert path.turned[1].cost < arrived.cost
    # a rival that is made as sharp at once says where it had left least
    path.refitter.share = 1 / 64
    sharp = path.sharper(effects, arrived, wide)
    assert sharp.cost > found.cost + 4
    assert path.turned[0] == pytest.approx(share)
    assert path.turned[1].cost == pytest.approx(found.cost, abs=0.1)


@pytest.mark.parametrize("width", [0.3, 0.05])
def test_the_width_of_a_law_that_is_rounded_itself_is_estimated(width):
    path, (one,) = disc(0.0, width)
    effects = (replace(one, width=0.2),)
    assert form_of(effects) != form_of((one,))
    assert not path.cornered(effects)
    assert path.cornered((one,))
    found = path.from_windows(effects)
    assert found.values[one.amplitude] == pytest.approx(0.8, abs=0.015)
    assert found.values["shaft.coulomb_friction.width"] == pytest.approx(width, rel=0.15)
    assert numbers(effects) == numbers((one,)) + 1
    assert found.cost < 320


def test_a_law_that_is_sharp_is_made_as_sharp_as_the_data_feel():
    path, effects = disc(0.0, 1e-4)
    arrived = path.from_windows(effects)
    share, found = path.sharpest(effects, arrived, 1 / 64, 1.0)
    assert found.cost < arrived.cost
    assert share < 0.1
    assert path.turned is None
