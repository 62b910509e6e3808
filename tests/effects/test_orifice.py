"""A leak through an orifice: its law, where it is looked for, and that a repair names it, of one volume and of two."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import OrificeLeak, StribeckFriction, ports_for

TIME = np.arange(0, 120, 0.25)


def vessel():
    """A pump that fills one volume, from which the other is fed; pressures above that around them."""
    b = ce.Blueprint("vessel")
    capacity = b.parameter("C", 1.0, unit="L/bar", min=0.05, max=10)
    narrow, out = (
        b.parameter("R", 1.5, unit="bar s/L", min=0.1, max=20),
        b.parameter("k", 0.25, unit="L/(s bar)", min=0.01, max=5),
    )
    p, q, pump = b.state("p", unit="bar"), b.state("q", unit="bar"), b.input("pump", unit="L/s")
    main, branch = b.port("main", "inertia", {"speed": p}), b.port("branch", "inertia", {"speed": q})
    b.ode("p", (pump - (p - q) / narrow + main) / capacity)
    b.ode("q", ((p - q) / narrow - out * q + branch) / 0.5)
    b.output("p_main", p, unit="bar")
    b.output("p_branch", q, unit="bar")
    return b.model()


def record(name, seed, *, leak=0.0, across=0.0):
    """By SciPy, the root as sharp as it is."""
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.1, 1.2, 16), 30)

    def rates(t, x):
        passes = (x[0] - x[1]) / 2.0 + across * np.sign(x[0] - x[1]) * np.sqrt(abs(x[0] - x[1]))
        lost = leak * np.sqrt(max(x[0], 0.0))
        return [(np.interp(t, TIME, pump) - passes - lost) / 0.8, (passes - 0.3 * x[1]) / 0.5]

    x = solve_ivp(rates, (0, TIME[-1]), [2.5, 1.6], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=0.25).y
    noisy = x + 0.02 * rng.standard_normal(x.shape)
    return ce.Experiment.from_arrays(
        name, time=TIME, units={"pump": "L/s", "p_main": "bar", "p_branch": "bar"}, inputs=("pump",),
        pump=pump, p_main=noisy[0], p_branch=noisy[1],
    )  # fmt: skip


@pytest.mark.parametrize("at", ["main", "main_and_branch"])
def test_the_law_is_that_of_torricelli_either_way(at):
    model = vessel().with_effect(OrificeLeak(width=1e-4), at=at, values={"coefficient": 0.06})
    still = ce.Experiment.from_arrays(
        "still", time=TIME, units={"pump": "L/s"}, inputs=("pump",), pump=0.4 + 0 * TIME
    )
    values = {"C": 0.8, "R": 2.0, "k": 0.3, f"{at}.orifice_leak.coefficient": 0.06}
    parameters = model.parameters()
    for name, value in values.items():
        parameters[name].value = value
    run = ce.simulate(model, still, parameters=parameters, initial={"p": -1.0, "q": 1.5})

    def rates(_t, x):
        head = x[0] if at == "main" else x[0] - x[1]
        flow = 0.06 * np.sign(head) * np.sqrt(abs(head))
        passes = (x[0] - x[1]) / 2.0 + (0.0 if at == "main" else flow)
        return [(0.4 - passes - (flow if at == "main" else 0.0)) / 0.8, (passes - 0.3 * x[1]) / 0.5]

    x = solve_ivp(rates, (0, TIME[-1]), [-1.0, 1.5], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=0.05).y
    assert run["p_main"].values == pytest.approx(x[0], abs=2e-4)
    assert run["p_branch"].values == pytest.approx(x[1], abs=2e-4)


def test_it_is_looked_for_where_a_pressure_or_a_level_is_read():
    model = vessel()
    assert {"main", "branch", "main_and_branch"} <= {port.name for port in ports_for(model, OrificeLeak())}
    view = ce.effects.port_view(model, "main")
    assert OrificeLeak().idle(view) == ""
    assert StribeckFriction().idle(view) == "a volume flow has no friction that fades"
    shaft = ce.effects.port_view(ce.one_inertia(), "engine")
    assert OrificeLeak().idle(shaft).startswith("no pressure and no level is read there")
    assert StribeckFriction().idle(shaft) == ""


@pytest.mark.parametrize(
    ("key", "how"), [("main.orifice_leak", {"leak": 0.06}), ("main_and_branch.orifice_leak", {"across": 0.3})]
)
def test_a_repair_names_it_and_its_size(key, how):
    """A leak by the root was "an overflow and a loss that fades as p grows, confirmed on fresh data"."""
    found = ce.repair(vessel(), record("run", 1, **how), fresh=record("fresh", 2, **how), progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    (one,) = found.effects
    assert one.key == key
    assert one.amplitude.unit == "L/(s bar0.5)"
    assert abs(one.amplitude.value - next(iter(how.values()))) < 4 * one.amplitude.stderr
