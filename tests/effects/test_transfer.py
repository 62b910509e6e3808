"""What leaves one part enters another: a leak between tanks and a slipping disc, against SciPy; where it is offered."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.effects import Transfer, candidates, ports_for
from casadi_engine.errors import EffectError, ModelError

TIME = 2.0 * np.arange(300)


def inflow(t):
    return 2e-3 * (1 + np.sin(0.02 * t))


def tanks(units=("m3/s", "m3/s"), count=2):
    """Tanks of 0.5 m2, 1 m2, ... that drain by themselves; only the first is fed."""
    b = ce.Blueprint("tanks")
    drain = b.parameter("drain", 2e-3, unit="m2/s", min=0)
    feed = b.input("feed", unit="m3/s")
    for k in range(1, count + 1):
        h = b.state(f"h_{k}", unit="m")
        slot = b.port(f"tank_{k}", "inertia", {"level": h}, unit=units[min(k, len(units)) - 1])
        b.ode(f"h_{k}", ((feed if k == 1 else 0) - drain * h + slot) / (0.5 * k))
        b.output(f"level_{k}", h, unit="m")
    return b.model()


def measured(leak=1.5e-3, seed=0):
    def rate(t, h):
        flow = leak * (h[0] - h[1])
        return [(inflow(t) - 3e-3 * h[0] - flow) / 0.5, (-3e-3 * h[1] + flow) / 1.0]

    run = solve_ivp(rate, (0, TIME[-1]), [0.8, 0.1], t_eval=TIME, rtol=1e-9, atol=1e-12)
    noise = 2e-3 * np.random.default_rng(seed).standard_normal(run.y.shape)
    units = {"feed": "m3/s", "level_1": "m", "level_2": "m"}
    levels = dict(zip(("level_1", "level_2"), run.y + noise, strict=True))
    return ce.Experiment.from_arrays("run", time=TIME, units=units, feed=inflow(TIME), **levels)


NOISE = ce.Noise(level_1=2e-3, level_2=2e-3)


def test_a_leak_between_two_tanks_is_found():
    model = tanks().with_effect(Transfer(), at="tank_1_and_tank_2")
    fit = ce.estimate(model, measured(), noise=NOISE, progress=False)
    for name, truth in {"tank_1_and_tank_2.transfer.coefficient": 1.5e-3, "drain": 3e-3}.items():
        found = fit.estimates[name]
        assert abs(found.value - truth) < 3 * found.stderr < 1e-4, name
    assert model.linear is not None


def test_a_screen_scores_the_leak_above_all_others():
    found = screen(ce.estimate(tanks(), measured(leak=2e-4), noise=NOISE, progress=False))
    best = found.candidates[found.order[0]]
    assert best.label == "transfer at tank_1_and_tank_2"
    assert found.alarm
    assert Transfer().describe(best.port) == "a flow between tank_1 and tank_2"


def test_what_leaves_one_enters_the_other():
    model = tanks()
    (one,) = candidates(model, [Transfer()], measured())
    assert one.key == "tank_1_and_tank_2.transfer"
    torques = one.function([0.7, 0.2], [0.0], [0.0], 0.0, model.parameter_vector())[0].full().ravel()
    assert torques.tolist() == [pytest.approx(-0.5), pytest.approx(0.5)]
    shift = one.extended(psi=0.4)
    still = {"drain": 0.0, "tank_1_and_tank_2.transfer.coefficient": 0.4}
    data = ce.Experiment.from_arrays("run", time=TIME[:50], units={"feed": "m3/s"}, feed=0 * TIME[:50])
    run = ce.simulate(shift, data, parameters=still, initial={"h_1": 1.0, "h_2": 0.0})
    volume = 0.5 * run["level_1"].values + run["level_2"].values
    np.testing.assert_allclose(volume, 0.5, rtol=1e-9)


def test_a_torque_of_channels_alone_leaves_and_enters_too():
    class Bypass(ce.Effect):
        name, attaches, amplitude = "bypass", ("link",), ce.effects.Amplitude("flow", unit="m3/s")

        def law(self, port, p, math):
            return p.flow * math.sin(port.time)

    model = tanks().with_effect(Bypass(), at="tank_1_and_tank_2", values={"flow": 2.0})
    assert [drive.name for drive in model.drives][1:] == ["T_tank_1_bypass", "T_tank_2_bypass"]


def test_only_ports_of_one_unit_are_joined():
    assert [link.name for link in ports_for(tanks(count=4), Transfer())] == [
        f"tank_{a}_and_tank_{b}" for a, b in ((1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4))
    ]
    assert ports_for(tanks(units=("m3/s", "kg/s")), Transfer()) == ()
    assert ports_for(tanks(units=("-", "-")), Transfer()) == ()
    with pytest.raises(EffectError, match=r"transfer is to act at a port that the model tanks does not have"):
        tanks(units=("m3/s", "kg/s")).with_effect(Transfer(), at="tank_1_and_tank_2")
    with pytest.raises(ModelError, match="the model has no such port"):
        tanks().ports["tank_1_and_tank_3"]


def test_links_are_not_declared_by_hand():
    with pytest.raises(
        ModelError, match=r"the port hose is a link without ends.*their link is called a_and_b"
    ):
        ce.Blueprint("tanks").port("hose", "link")


def test_what_a_coupling_joins_is_not_offered_again():
    assert ports_for(ce.two_mass(), Transfer()) == ()
    shaft = ce.crankshaft()
    offered = {link.name for link in ports_for(shaft, Transfer())}
    assert len(offered) == 21 - 6
    assert "inertia_1_and_inertia_3" in offered
    assert "inertia_1_and_inertia_2" not in offered
    model = ce.two_mass().with_effect(Transfer(), at="engine_and_load")  # but can be put there
    assert model.parameters()["engine_and_load.transfer.coefficient"].unit == "N m s/rad"
