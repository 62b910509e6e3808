"""A refinement of a shape has to stand as an effect of its own where something is left that no effect explains."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.refit import Refitter
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.search import Search, Station
from casadi_engine.effects import Amplitude, Effect

EFFECTS = ["coulomb_friction", "stribeck_friction"]
NOISE = ce.Noise(omega=0.1)


class Ripple(Effect):
    """What no effect of the library is."""

    name, attaches, kin = "ripple", ("inertia",), ()
    sentence = "a torque at {port} that swings with speed"
    amplitude = Amplitude("torque", unit="N m")

    def law(self, port, p, math):
        return p.torque * math.sin(0.25 * port.speed)


def stations(friction, values, ripple):
    """The search, the station without effects, and one whose lead is friction that fades."""
    t = np.arange(1000) * 0.01
    plain = ce.Experiment.from_arrays("swing", time=t, units={"T": "N m"}, T=80 * np.sin(1.5 * t))
    model = ce.one_inertia().with_effect(friction, at="engine", values=values)
    model = model.with_effect(Ripple(), at="engine", values={"torque": ripple})
    run = ce.simulate(model, plain, initial={"omega_eng": 0.0})
    speed = run["omega"].values + 0.1 * np.random.default_rng(0).standard_normal(1000)
    data = ce.Experiment.from_arrays(
        "swing", time=t, units={"T": "N m", "omega": "rad/s"}, T=plain["T"].values, omega=speed
    )
    fit = ce.estimate(ce.one_inertia(), data, noise=NOISE, progress=False)
    screened = screen(fit, EFFECTS, colour=False)
    refitter = Refitter(fit.model, fit.model.parameters(), (data,), NOISE)
    search = Search(refitter, lambda f: screen(f, EFFECTS, colour=False), 4, str)
    here = Station(fit, (), screened)
    tried = search._tried(screened, fit, ())
    lead = tried.best["stribeck_friction", "engine"]
    whole = search._refitted(fit, (lead.added,), start=lead.short)
    refits = {lead.candidate: whole}
    made = search._station(here, whole, (lead.added,), lead.candidate, refits, tried)
    return search, here, made, refits, tried


@pytest.fixture(scope="module")
def dry():
    return stations(ce.effects.CoulombFriction(width=0.02), {"torque": 6.0}, 0.6)


def test_the_simpler_effect_comes_first_where_something_is_left(dry):
    search, here, made, refits, tried = dry
    assert made.screened.leftover.alarms
    simpler = search._by_its_limit(here, made, refits, tried)
    assert [one.candidate.key for one in simpler.effects] == [("coulomb_friction", "engine")]
    assert {(m.name, m.at) for m in simpler.members} == {(name, "engine") for name in EFFECTS}
    assert simpler.fit.values["engine.coulomb_friction.torque"] == pytest.approx(6.0, rel=0.1)
    assert simpler.frequency == made.frequency
    assert search.rounds[-1].dropped == (made.effects[-1].label,)
    # dry friction is no refinement of anything
    assert search._by_its_limit(here, simpler, refits, tried) is None


def test_nothing_is_put_aside_where_all_is_explained():
    fading = {"torque": 6.0, "fading": 60.0}
    search, here, made, refits, tried = stations(ce.effects.StribeckFriction(width=0.02), fading, 0.0)
    assert not made.screened.leftover.alarms
    assert search._by_its_limit(here, made, refits, tried) is None
