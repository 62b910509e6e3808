"""What leaves one part enters another: a leak between tanks and a slipping disc, against SciPy; where it is offered."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.effects import Overflow, Transfer, candidates, port_view, ports_for
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


@pytest.mark.slow
def test_a_screen_scores_the_leak_above_all_others():
    found = screen(ce.estimate(tanks(), measured(leak=2e-4), noise=NOISE, progress=False))
    best = found.candidates[found.order[0]]
    assert best.label == "transfer at tank_1_and_tank_2"
    assert found.alarm
    link = tanks().ports[best.port]
    assert Transfer().worded(link) == (
        "a volume flow between tank_1 and tank_2, proportional to their difference"
    )


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
        name, attaches, amplitude = "bypass", ("pipe",), ce.effects.Amplitude("flow", unit="m3/s")

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


def spilled(edge=1.1, rate=0.05, share=0.6, seed=0):
    """Two tanks in series by SciPy; the first runs over its edge, and a share of that falls into the second."""

    def flow(t, h):
        over = rate * max(h[0] - edge, 0.0)
        return [(inflow(t) - 2e-3 * h[0] - over) / 0.5, (2e-3 * h[0] - 4e-3 * h[1] + share * over) / 1.0]

    run = solve_ivp(flow, (0, TIME[-1]), [0.8, 0.4], t_eval=TIME, rtol=1e-9, atol=1e-12, max_step=1.0)
    noise = 2e-3 * np.random.default_rng(seed).standard_normal(run.y.shape)
    units = {"feed": "m3/s", "level_1": "m", "level_2": "m"}
    levels = dict(zip(("level_1", "level_2"), run.y + noise, strict=True))
    return ce.Experiment.from_arrays("run", time=TIME, units=units, feed=inflow(TIME), **levels)


def series():
    b = ce.Blueprint("series")
    first, second = (b.parameter(f"k_{k}", 3e-3, unit="m2/s", min=1e-4, max=0.1) for k in (1, 2))
    upper, lower = b.state("h_1", unit="m"), b.state("h_2", unit="m")
    into = [b.port(f"tank_{k}", "inertia", {"level": h}, unit="m3/s") for k, h in ((1, upper), (2, lower))]
    b.ode("h_1", (b.input("feed", unit="m3/s") - first * upper + into[0]) / 0.5)
    b.ode("h_2", first * upper - second * lower + into[1])
    b.output("level_1", upper, unit="m")
    b.output("level_2", lower, unit="m")
    return b.model()


def test_an_overflow_is_found_with_its_edge_and_the_share_that_arrives():
    start = {"edge": 1.0, "share": 0.5, "source": 1, "rate": 0.02}
    model = series().with_effect(Overflow(span=(0.3, 1.5)), at="tank_1_and_tank_2", values=start)
    fit = ce.estimate(model, spilled(), noise=NOISE, progress=False)
    assert fit.converged
    truths = {"edge": 1.1, "rate": 0.05, "share": 0.6}
    for name, truth in {f"tank_1_and_tank_2.overflow.{k}": v for k, v in truths.items()}.items():
        found = fit.estimates[name]
        assert abs(found.value - truth) < 3 * found.stderr, name
        assert found.stderr < 0.1 * truth


def test_the_candidates_of_an_overflow_lie_within_the_levels():
    def levels(signal):
        return [np.linspace(0.2, 1.2, 101) if "h_1" in str(signal) else np.linspace(0.1, 0.3, 101)]

    found = candidates(series(), [Overflow()], spilled(), courses=levels)
    values = [dict(one.values) for one in found]
    assert len(values) == 2 * 4 * 3
    assert {one["edge"] for one in values if one["source"] == 1} == {0.7, 0.9, 1.05, 1.15}
    assert {one["edge"] for one in values if one["source"] == 2} == {0.2, 0.24, 0.27, 0.29}
    assert {one["share"] for one in values} == {0.0, 0.5, 1.0}
    assert found[0].effect.span == (0.1, 1.2)
    x, rest = [1.45, 0.2], ([0.0], [0.0], 0.0, series().parameter_vector())
    for one in found:
        edge, share, source = (one.values[name] for name in ("edge", "share", "source"))
        over = max((x[0] if source == 1 else x[1]) - edge, 0.0)
        expected = (-over, share * over) if source == 1 else (share * over, -over)
        assert one.function(x, *rest)[0].full().ravel() == pytest.approx(expected, abs=3e-3)
    view = port_view(series(), "tank_1_and_tank_2")
    values = dict(zip(series().parameter_names, series().parameter_vector(), strict=True))
    fitted = Overflow().fitted(view, spilled(), values)
    # samples of 2 s, and 1 m/s per m3/s in the larger tank: by the smaller one a pond of 220 m2 that ran over by a
    # spillway of 1.4 m2/s had no name
    assert fitted == Overflow(most=2.0)
    assert fitted.amplitude.max == 2.0
    assert Overflow(span=(0.2, 1.0), most=0.5).fitted(view, spilled(), values) == Overflow((0.2, 1.0), 0.5)
    assert len(candidates(series(), [Overflow()], spilled())) == 24


def test_shafts_do_not_run_over():
    assert ports_for(ce.crankshaft(), Overflow()) == ()
    assert [port.kind for port in ports_for(series(), Overflow())] == ["pipe"]


def test_what_arrives_is_a_scalar():
    class Spray(ce.Effect):
        name, attaches, amplitude = "spray", ("pipe",), ce.effects.Amplitude("flow", unit="m3/s")

        def law(self, port, p, math):
            return ce.effects.Law(p.flow, arrives="half")

    with pytest.raises(
        EffectError, match="what arrives by the law of spray at tank_1_and_tank_2 is not a scalar"
    ):
        series().with_effect(Spray(), at="tank_1_and_tank_2")


def test_links_are_not_declared_by_hand():
    with pytest.raises(
        ModelError, match=r"the port hose is a link without ends.*what joins them is called a_and_b"
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
