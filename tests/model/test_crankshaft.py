"""The crankshaft: appendix A entry by entry, Table 4.13, and simulations that share nothing with the package."""

import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.errors import ModelError, ParameterError, TieError
from casadi_engine.model import Blueprint, Coupling, Driven, Geometry, Inertia, declare_chain, thesis_ties
from casadi_engine.parameters import compile as compile_parameters
from tests.quick import few

PI = np.pi
R, L, A_P, M_EQ, P_CRANK = 0.043, 0.145, 0.0058, 0.7, 1.0e5

# Appendix A as it is printed, (row, column) from 1, misprints and all.
PRINTED_A = {
    (1, 1): "-C21/J1", (1, 2): "C21/J1", (1, 3): "K21/J1",
    (2, 1): "C21/J2", (2, 2): "-(C21+C32+C1)/J2", (2, 3): "-K21/J2", (2, 4): "C32/J2", (2, 5): "K32/J2",
    (3, 1): "-1", (3, 2): "1",
    (4, 2): "C32/J3", (4, 4): "-(C32+C43+C2)/J3", (4, 5): "-K32/J3", (4, 6): "C43/J3", (4, 7): "K43/J3",
    (5, 2): "-1", (5, 4): "1",
    (6, 4): "C43/J4", (6, 6): "-(C43+C54+C3)/J4", (6, 7): "-K43/J4", (6, 8): "C54/J4", (6, 9): "K54/J4",
    (7, 4): "-1", (7, 6): "1",
    (8, 6): "C54/J5", (8, 8): "-(C54+C65+C4)/J5", (8, 9): "-K54/J5", (8, 10): "C65/J5", (8, 11): "K65/J5",
    (9, 6): "-1", (9, 8): "1",
    (10, 8): "C65/J6", (10, 10): "-(C65+C76)/J6", (10, 11): "-K65/J6", (10, 12): "C76/J6", (10, 13): "K76/J6",
    (11, 8): "-1", (11, 10): "1",
    (12, 10): "C76/J7", (12, 12): "-C76/J6", (12, 13): "-K76/J7",
    (13, 10): "-1", (13, 12): "1",
}  # fmt: skip
PRINTED_B = {(2, 1): "1/J1", (4, 2): "1/J2", (6, 3): "1/J3", (8, 4): "1/J4", (12, 5): "-1/J7"}
# What these entries must be: dampers C2..C5 of the text (printed C1..C4), J7 (printed J6), J2..J5 (printed J1..J4).
MISPRINTS_A = {
    (2, 2): "-(C21+C32+C2)/J2",
    (4, 4): "-(C32+C43+C3)/J3",
    (6, 6): "-(C43+C54+C4)/J4",
    (8, 8): "-(C54+C65+C5)/J5",
    (12, 12): "-C76/J7",
}
MISPRINTS_B = {(2, 1): "1/J2", (4, 2): "1/J3", (6, 3): "1/J4", (8, 4): "1/J5"}

# Table 4.13 as printed: frequency [Hz], then |deformation| of the six couplings.
TABLE = np.array(
    [
        [20.5, 0.0007, 0.0003, 0.0005, 0.0007, 0.0008, 1],
        [335, 1, 0.3229, 0.4038, 0.4216, 0.3322, 0.6414],
        [548, 1, 0.0692, 0.1030, 0.2109, 0.2085, 0.1501],
        [936, 1, 0.7600, 0.7693, 0.1636, 0.7937, 0.1953],
        [1340, 0.4898, 1, 0.4202, 0.7870, 0.7273, 0.0873],
        [1604, 0.2091, 0.6531, 1, 0.9355, 0.4324, 0.0363],
    ]
)
# The eigenproblem in more digits: the table's 20.5 is 20.45 rounded.
FREQUENCIES = [20.45, 335.2, 548.0, 936.7, 1340.9, 1604.4]


def names(items):
    return [item.name for item in items]


def matrix(entries, shape, values):
    made = np.zeros(shape)
    for (row, column), text in entries.items():
        made[row - 1, column - 1] = ca.Function("f", *symbols(text, values))(*values.values())
    return made


def symbols(text, values):
    from casadi_engine.parameters.expression import parse_expression

    own = {name: ca.SX.sym(name) for name in values}
    return list(own.values()), [parse_expression(text, own)]


def wrong_entries(printed, found):
    return {
        (int(i) + 1, int(j) + 1) for i, j in np.argwhere(~np.isclose(printed, found, rtol=1e-12, atol=1e-12))
    }


@pytest.fixture(scope="module")
def linear_form():
    return ce.crankshaft(reciprocating_speed="measured")


def distinct(model):
    """A value for every parameter, no two related, so that a wrong index shows."""
    random = np.random.default_rng(5)
    own = {n: float(v) for n, v in zip(model.parameter_names, random.uniform(0.5, 9.0, 99), strict=False)}
    return {n: v for n, v in own.items() if n[0] in "JKC"}


@pytest.mark.parametrize("form", ["measured", "model"])
def test_a_and_b_are_the_appendix_except_its_named_misprints(form):
    model = ce.crankshaft(reciprocating_speed=form)
    values = distinct(model)
    core = ca.Function("core", [model.p], [model.linear.A, model.linear.B])
    a, b = (part.full() for part in core(model.parameter_vector(values)))
    printed = values | {"C1": 0.77}
    printed_a, printed_b = matrix(PRINTED_A, (13, 13), printed), matrix(PRINTED_B, (13, 5), printed)
    assert wrong_entries(printed_a, a) == set(MISPRINTS_A)
    assert wrong_entries(printed_b, b) == set(MISPRINTS_B)
    np.testing.assert_allclose(a, matrix(PRINTED_A | MISPRINTS_A, (13, 13), printed), rtol=1e-13)
    np.testing.assert_allclose(b, matrix(PRINTED_B | MISPRINTS_B, (13, 5), printed), rtol=1e-13)


def test_modes_are_table_4_13(linear_form):
    modes = linear_form.modes()
    of = np.array(modes.numbers) > 0
    found = modes.frequencies_hz[of]
    np.testing.assert_allclose(found, FREQUENCIES, rtol=1e-3)
    np.testing.assert_allclose(found[1:], TABLE[1:, 0], rtol=1e-3)
    assert found[0] == pytest.approx(TABLE[0, 0], abs=0.05)
    np.testing.assert_allclose(modes.deformations[:, of].T, TABLE[:, 1:], atol=1e-3)


def test_names_and_defaults_of_the_thesis(linear_form):
    model = linear_form
    twists = [f"twist_{i + 1}{i}" for i in range(1, 7)]
    speeds = [f"omega_{i}" for i in range(1, 8)]
    assert names(model.states) == [
        "omega_1",
        *(n for pair in zip(speeds[1:], twists, strict=True) for n in pair),
    ]
    assert names(model.inputs) == ["theta", "p1", "p2", "p3", "p4", "omega", "T_load"]
    assert names(model.drives) == ["T_1", "T_2", "T_3", "T_4", "T_load"]
    assert names(model.outputs) == ["omega"]
    assert not model.has_slot_laws
    listed = ("J1 J2 J3 J4 J5 J6 J7", "K21 K32 K43 K54 K65 K76", "C21 C32 C43 C54 C65 C76", "C2 C3 C4 C5")
    assert " ".join(model.parameter_names[:23]) == " ".join(listed)
    assert names(model.ports.with_slot) == [
        *(f"inertia_{i}" for i in range(1, 8)),
        *(f"coupling_{i + 1}{i}" for i in range(1, 7)),
        *(f"cylinder_{k}" for k in range(1, 5)),
        "cylinders",
    ]
    parameters = model.parameters()
    assert [n for n in parameters if not parameters[n].vary] == ["r", "L", "A_p", "m_eq", "p_crank"]
    expected = [
        1 / 33.39,
        *[1 / 22.3] * 4,
        1 / 5.968,
        1 / 5.646,
        241.8e3,
        *[1270e3] * 3,
        1427e3,
        1992.0,
        15.0,
    ]
    expected += [2.5] * 5 + [0.1541 / 4] * 4 + [R, L, A_P, M_EQ, P_CRANK]
    np.testing.assert_allclose(model.parameter_vector(), expected, rtol=1e-14)


def test_angles_are_the_wheels_and_the_twists_and_torques_share_the_cylinders():
    model = ce.crankshaft()
    angle = ca.Function("angle", [model.x, model.u], [model.ports["inertia_4"].signals["angle"],
                                                      model.ports["cylinder_3"].signals["angle"]])  # fmt: skip
    x = np.arange(13) / 100  # twists 21, 32, 43 are the states 3, 5, 7
    four, third = (float(v) for v in angle(x, [7.0, 0, 0, 0, 0, 0]))
    assert four == pytest.approx(7.0 + 0.02 + 0.04 + 0.06)
    assert third == pytest.approx(four - PI)
    g = ca.Function("g", [model.p], [model.linear.G])(model.parameter_vector()).full()
    slots = dict(zip(names(model.ports.with_slot), g.T, strict=True))
    np.testing.assert_allclose(slots["cylinders"][[1, 3, 5, 7]], 22.3 / 4)
    assert np.count_nonzero(slots["cylinders"]) == 4
    np.testing.assert_allclose(slots["cylinder_2"], slots["inertia_3"])


# ---- an independent simulation: absolute angles, energies, adaptive integration


def slope(angle):
    """ds/dθ [m] and d²s/dθ² of the way s = R + L - R cos θ - sqrt(L² - R² sin² θ)."""
    sin, cos = np.sin(angle), np.cos(angle)
    q = np.sqrt(L**2 - (R * sin) ** 2)
    first = R * sin + R**2 * sin * cos / q
    return first, R * cos + R**2 * np.cos(2 * angle) / q + R**4 * (sin * cos) ** 2 / q**3


MEAN_SQUARE = np.mean(slope(np.linspace(0, 2 * PI, 2000, endpoint=False))[0] ** 2)


def shaft(count, links):
    """Uneven numbers for a crankshaft: `links` are the couplings' pairs of inertias from 1."""
    random = np.random.default_rng(count)
    size = len(links) + 1
    values = {f"J{i}": random.uniform(0.02, 0.2) for i in range(1, size + 1)}
    values |= {f"K{j}{i}": 10 ** random.uniform(3.5, 6) for i, j in links}
    values |= {f"C{j}{i}": random.uniform(1, 15) for i, j in links}
    return values | {f"C{k}": random.uniform(0.01, 0.2) for k in range(2, count + 2)}


def by_hand(count, links, values, offsets, *, times, seen, load=40.0, varying=False):
    """Channels, omega and start of M θ̈ + D θ̇ + Eᵀ(K E θ + C E θ̇) = T; `seen`: the cylinders' own θ or the wheel's."""
    size = len(links) + 1
    inertia = np.array([values[f"J{i}"] for i in range(1, size + 1)])
    e = np.zeros((size - 1, size))
    for row, (i, j) in enumerate(links):
        e[row, i - 1], e[row, j - 1] = -1, 1
    stiff, damp = (e.T @ np.diag([values[f"{c}{j}{i}"] for i, j in links]) @ e for c in "KC")
    damp += np.diag([values.get(f"C{i}", 0.0) for i in range(1, size + 1)])
    offsets, own = np.asarray(offsets), np.arange(1, count + 1)
    look = own if seen == "own" else np.zeros(count, dtype=int)

    def pressures(t):
        return 9e4 + 2.0e6 * np.exp(3 * (np.cos((130.0 * t + 0.3 - offsets) / 2) - 1))

    def rate(t, state):
        theta, speed = state[:size], state[size:]
        first, second = slope(theta[look] - offsets)
        torque = -stiff @ theta - damp @ speed
        torque[own] += (pressures(t) - P_CRANK) * A_P * first - M_EQ * first * second * speed[look] ** 2
        torque[-1] -= load
        mass = inertia.copy()
        if varying:
            mass[own] += M_EQ * (first**2 - MEAN_SQUARE)
        return np.concatenate([speed, torque / mass])

    start = np.concatenate([0.3 + 1e-4 * np.arange(size), 130.0 + 0.3 * np.arange(size)])
    run = solve_ivp(rate, times[[0, -1]], start, method="DOP853", t_eval=times, rtol=1e-10, atol=1e-11)
    assert run.success
    channels = {"theta": run.y[0], "omega": run.y[size], "T_load": np.full(len(times), load)}
    channels |= {f"p{k + 1}": row for k, row in enumerate(np.transpose([pressures(t) for t in times]))}
    initial = {f"omega_{i + 1}": start[size + i] for i in range(size)}
    initial |= {f"twist_{j}{i}": start[j - 1] - start[i - 1] for i, j in links}
    return channels, initial


def record(times, channels):
    units = {name: "Pa" for name in channels if name[0] == "p"}
    units |= {"theta": "rad", "omega": "rad/s", "T_load": "N m"}
    return ce.Experiment.from_arrays("made", time=times, units=units, **channels)


UNEVEN = {
    1: (0.0,),
    2: (0.0, 5.5),
    3: (0.0, 4.0, 8.9),
    6: (0.0, 2.2, 4.0, 6.5, 8.4, 10.9),
    8: (0.0, 1.5, 3.2, 4.6, 6.4, 7.7, 9.5, 11.1),
    12: tuple(np.arange(12) * 4 * PI / 12 + 0.1 * np.sin(np.arange(12))),
}
TIMES = np.arange(1001) * 3e-5


def line(count):
    return [(i, i + 1) for i in range(1, count + 3)]


@pytest.mark.parametrize(
    ("count", "form"),
    few(
        [(count, form) for count in (3, 6) for form in ("linear", "measured", "state")]
        + [(1, "measured"), (2, "state"), (8, "linear"), (12, "measured")],
        (3, "linear"),
        (3, "measured"),
        (2, "state"),
    ),
)
def test_uneven_firing_is_the_independent_simulation(count, form):
    values = shaft(count, line(count))
    seen = "wheel" if form == "linear" else "own"
    channels, initial = by_hand(count, line(count), values, UNEVEN[count], times=TIMES, seen=seen)
    kind = {"reciprocating_speed": "measured"} if form == "linear" else {"angle": form}
    model = ce.crankshaft(cylinders=count, firing_offsets=UNEVEN[count], **kind)
    assert (model.linear is not None, model.has_slot_laws) == (True, form != "linear")
    if form == "state":
        initial["theta_1"] = channels["theta"][0]
    run = ce.simulate(model, record(TIMES, channels), parameters=values, initial=initial)
    assert np.ptp(channels["omega"]) > 3
    np.testing.assert_allclose(run["omega"].values, channels["omega"], atol=5e-4)


@pytest.mark.parametrize("count", [1, 2, 8, 12])
@pytest.mark.parametrize("form", ["linear", "measured", "state"])
def test_power_is_in_balance(count, form):
    """d/dt (½ Σ J ω² + ½ Σ K twist²) = power of gas and reciprocating forces and load, less what dampers take."""
    values, random = shaft(count, line(count)), np.random.default_rng(count)
    kind = {"reciprocating_speed": "measured"} if form == "linear" else {"angle": form}
    model = ce.crankshaft(cylinders=count, firing_offsets=UNEVEN[count], **kind)
    size = count + 3
    theta, speed = 1.3 + 0.02 * random.normal(size=size), 130 + random.normal(size=size)
    pressures, load, omega = random.uniform(1e5, 3e6, count), 40.0, 128.0
    twists = np.diff(theta)
    x = [speed[0], *(v for pair in zip(speed[1:], twists, strict=True) for v in pair)]
    channels = {"theta": theta[0], "omega": omega, "T_load": load} | {
        f"p{k + 1}": p for k, p in enumerate(pressures)
    }
    u = [channels[variable.name] for variable in model.inputs]
    f = ca.Function("f", [model.x, model.u, model.p], [model.closed_ode])
    rate = f(([theta[0]] if form == "state" else []) + x, u, model.parameter_vector(values)).full().ravel()
    rate = rate[1:] if form == "state" else rate
    inertia = np.array([values[f"J{i}"] for i in range(1, size + 1)])
    stiff, damp = (np.array([values[f"{c}{i + 1}{i}"] for i in range(1, size)]) for c in "KC")
    stored = (inertia * speed) @ rate[[0, *range(1, 2 * size - 1, 2)]] + (stiff * twists) @ rate[2::2]
    seen, own = (
        (theta[[0] * count], omega) if form == "linear" else (theta[1 : count + 1], speed[1 : count + 1])
    )
    first, second = slope(seen - np.array(UNEVEN[count]))
    torque = (pressures - P_CRANK) * A_P * first - M_EQ * first * second * own**2
    ground = np.array([values[f"C{i}"] for i in range(2, count + 2)])
    lost = damp @ np.diff(speed) ** 2 + ground @ speed[1 : count + 1] ** 2
    assert stored == pytest.approx(torque @ speed[1 : count + 1] - load * speed[-1] - lost, rel=1e-9)


def test_the_forms_differ_by_more_than_the_tolerance():
    runs = [
        by_hand(3, line(3), shaft(3, line(3)), UNEVEN[3], times=TIMES, seen=seen, varying=varying)[0]["omega"]
        for seen, varying in (("own", False), ("wheel", False), ("own", True))
    ]
    assert np.abs(runs[1] - runs[0]).max() > 5e-3
    assert np.abs(runs[2] - runs[0]).max() > 5e-3


def test_variable_inertia_on_a_branched_shaft_is_the_independent_simulation():
    """Three cylinders; inertia 6 hangs on the wheel, 7 behind the flywheel is the load."""
    links = [(1, 2), (2, 3), (3, 4), (4, 5), (1, 6), (5, 7)]
    values = shaft(3, links)
    channels, initial = by_hand(3, links, values, UNEVEN[3], times=TIMES, seen="own", varying=True)
    driven = ({"behind": 1, "description": "pump"}, Driven(behind=5, load="T_load"))
    model = ce.crankshaft(
        cylinders=3, firing_offsets=UNEVEN[3], reciprocating_inertia="variable", driven=driven,
        outputs=("omega", "omega_load"),
    )  # fmt: skip
    run = ce.simulate(model, record(TIMES, channels), parameters=values, initial=initial)
    np.testing.assert_allclose(run["omega"].values, channels["omega"], atol=5e-4)
    assert names(model.drives) == ["T_1", "T_2", "T_3", "T_load"]
    assert "behind=1" not in model.table()
    assert "stiffness between damping wheel and pump" in model.table()


@pytest.fixture(scope="module")
def clean():
    """One engine cycle without noise of the simulator beside the records, and its start as the model's states."""
    folder = str(Path(__file__).resolve().parents[2] / "data")
    if folder not in sys.path:
        sys.path.insert(0, folder)
    from simulator import Engine, burn_factors, crankshaft_shaft, unequal_cylinders
    from simulator.run import Plant, integrate
    from simulator.simulate import observe

    # without the warm-up of the bundled records, which takes seconds: the start is even running
    shaft, cylinders, speed, load = crankshaft_shaft(), unequal_cylinders(), 2000 * PI / 30, 57.0
    torque = load + shaft.absolute_damping.sum() * speed
    engine = Engine(cylinders, burn_factors(cylinders, cycles=1, seed=3))
    engine = engine.with_strength(engine.strength_for(torque))
    start, times = shaft.steady_state(speed, torque), np.arange(865) / 14402.0
    states = integrate(Plant(shaft, engine, lambda _: load), start, times, rtol=1e-9)
    made = observe(shaft, engine, lambda _: load, times, states)
    initial = {f"omega_{i}": start[i] for i in range(1, 8)}
    initial |= {f"twist_{i + 1}{i}": start[7 + i] for i in range(1, 7)}
    channels = {name: made[name] for name in ("theta", "p1", "p2", "p3", "p4", "T_load")}
    return made, record(made["time"], channels | {"omega": made["omega_true"]}), initial


@pytest.mark.parametrize(
    ("options", "tolerance"),
    [({}, 2e-3), ({"angle": "state"}, 2e-3), ({"reciprocating_speed": "measured"}, 1e-2)],
)
def test_true_parameters_give_the_clean_record(clean, options, tolerance):
    made, experiment, initial = clean
    more = ("theta",) if options.get("angle") else ()
    model = ce.crankshaft(outputs=("omega", "omega_load", *more), **options)
    start = initial | ({"theta_1": 0.0} if more else {})
    run = ce.simulate(model, experiment, initial=start)
    np.testing.assert_allclose(run["omega"].values, made["omega_true"], atol=tolerance)
    np.testing.assert_allclose(run["omega_load"].values, made["omega_load_true"], atol=tolerance)
    if more:
        np.testing.assert_allclose(run["theta"].values, made["theta"], atol=1e-5)


# ---- other sizes


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 8, 10, 12])
def test_sizes_from_one_to_twelve_cylinders(count):
    model = ce.crankshaft(cylinders=count, reciprocating_speed="measured")
    assert len(model.states) == 2 * (count + 3) - 1
    assert len(model.parameter_names) == (count + 3) + 2 * (count + 2) + count + 5
    assert model.modes().oscillatory == count + 2
    assert f"K{count + 3}{count + 2}" in model.parameter_names
    pars = thesis_ties(model.parameters())
    free = [name for name in pars if pars[name].vary and not pars[name].tie]
    wanted = ["J1", "J2", f"J{count + 2}", "K21", "K32", f"K{count + 2}{count + 1}"]
    assert free == list(dict.fromkeys(wanted))
    assert sum(pars.as_dict()[f"C{k}"] for k in range(2, count + 2)) == pytest.approx(0.1541 * count / 4)


def test_a_crankshaft_alone_is_braked_at_its_flywheel():
    model = ce.crankshaft(reciprocating_speed="measured", driven=(), outputs=("omega", "omega_load"))
    assert len(model.states) == 11
    b = ca.Function("b", [model.p], [model.linear.B])(model.parameter_vector()).full()
    assert b[9, 4] == pytest.approx(-5.968)
    assert np.count_nonzero(b[:, 4]) == 1
    c = ca.Function("c", [model.p], [model.linear.C])(model.parameter_vector()).full()
    assert np.argwhere(c).tolist() == [[0, 0], [1, 9]]


def test_the_state_form_has_one_more_state_and_no_angle_channel():
    model = ce.crankshaft(angle="state", outputs=("omega", "theta"))
    assert names(model.states)[:3] == ["theta_1", "omega_1", "omega_2"]
    assert len(model.states) == 14
    assert names(model.inputs) == ["p1", "p2", "p3", "p4", "T_load"]
    assert [(d.name, d.unit) for d in model.drives][:2] == [("F_1", "N"), ("F_2", "N")]
    assert [(o.name, o.unit) for o in model.outputs] == [("omega", "rad/s"), ("theta", "rad")]
    modes = model.modes()
    of = np.array(modes.numbers) > 0
    np.testing.assert_allclose(modes.frequencies_hz[of], FREQUENCIES, rtol=1e-3)
    # the angle deforms nothing: shapes are those of the table, the angle's mode is none of them
    assert "theta_1" not in np.array(modes.states)[modes.displacements]
    np.testing.assert_allclose(modes.deformations[:, of].T, TABLE[:, 1:], atol=1e-3)
    assert modes.frequencies_hz[0] == 0.0


def test_driven_inertias_may_have_bearings():
    model = ce.crankshaft(driven=(Driven(absolute_damping=0.3), {"inertia": 0.01}))
    assert model.parameters()["C7"].value == 0.3
    assert "C8" not in model.parameter_names
    a = ca.Function("a", [model.p], [model.linear.A])(model.parameter_vector()).full()
    assert a[11, 11] == pytest.approx(-(2.5 + 2.5 + 0.3) * 5.646)
    tied = thesis_ties(model.parameters())
    assert not tied["C7"].vary
    assert tied.as_dict()["C_eng"] == pytest.approx(0.1541)


# ---- ties


def test_ties_of_the_thesis(linear_form):
    given = linear_form.parameters()
    given["J2"].set(0.05)
    given["C3"].set(0.06)
    pars = thesis_ties(given)
    ties = {name: pars[name].tie for name in pars if pars[name].tie}
    assert ties == {
        "J3": "J2", "J4": "J2", "J5": "J2", "K43": "K32", "K54": "K32", "C43": "C32", "C54": "C32",
        "C2": "C_eng/4", "C3": "C_eng/4", "C4": "C_eng/4", "C5": "C_eng/4",
    }  # fmt: skip
    fixed = [n for n in pars if not pars[n].vary and not pars[n].tie]
    geometry = ["r", "L", "A_p", "m_eq", "p_crank"]
    assert fixed == ["J7", "K76", "C21", "C32", "C65", "C76", *geometry, "C_eng"]
    values = pars.as_dict()
    assert values["J5"] == 0.05
    assert values["C_eng"] == pytest.approx(3 * 0.1541 / 4 + 0.06)
    assert values["C2"] == pytest.approx(values["C_eng"] / 4)
    assert given["J3"].tie is None
    assert "C_eng" not in given


def test_ties_keep_only_bounds_that_say_more(linear_form):
    given = linear_form.parameters()
    assert compile_parameters(thesis_ties(given), linear_form.parameter_names).constraints == ()
    given["J4"].set(max=0.05)
    (kept,) = compile_parameters(thesis_ties(given), linear_form.parameter_names).constraints
    assert (kept.label, kept.max) == ("J4 (tied)", 0.05)
    assert given["J3"].max == 1e3


def test_ties_with_branches_fix_all_that_is_driven():
    pars = thesis_ties(ce.crankshaft(driven=({"behind": 1}, {"behind": 6})).parameters())
    assert not any(pars[n].vary for n in ("J7", "K71", "C71", "J8", "K86", "C86"))


def test_ties_are_for_crankshafts(linear_form):
    tied = thesis_ties(linear_form.parameters())
    others = ((ce.two_mass().parameters(), "seen: J_eng, J_load,"), (tied, "K21, C_eng; "))
    for other, seen in (*others, (linear_form, "seen: Model; "), (None, "seen: NoneType; ")):
        with pytest.raises(ModelError, match="these are not the parameters of a crankshaft") as caught:
            thesis_ties(other)
        assert seen in str(caught.value)
        assert "allowed: J1, J2, K21, C21, C2 and so on, without C_eng" in str(caught.value)
        assert "do: give crankshaft(...).parameters()" in str(caught.value)
    fixed = linear_form.parameters()
    fixed.fix("J3")
    with pytest.raises(TieError, match="J3"):
        thesis_ties(fixed)


# ---- errors


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        ({"cylinders": 0}, ("number of cylinders of a crankshaft", "seen: 0;", "from 1 to 12", "cylinders=4")),
        ({"cylinders": 13}, ("number of cylinders of a crankshaft", "seen: 13;")),
        ({"cylinders": True}, ("number of cylinders of a crankshaft", "seen: True;")),
        ({"cylinders": 4.0}, ("number of cylinders of a crankshaft", "seen: 4.0;")),
        ({"cylinders": 7}, ("no usual firing order", "seen: 7;", "give firing_order or firing_offsets")),
        ({"angle": "guessed"}, ("the option angle is not known", "'guessed'", '"measured" or "state"')),
        (
            {"angle": "state", "reciprocating_speed": "measured"},
            ("the linear form takes the crank angle from its channel", 'or angle="measured"'),
        ),
        ({"outputs": ("theta",)}, ("the outputs are not ones of this model", "one or more of omega, omega_load;")),
        ({"outputs": ("omega", "speed")}, ("the outputs are not ones of this model", "'speed'")),
        ({"driven": Driven()}, ("the driven inertias are not acceptable", "or () for none")),
        ({"driven": 3}, ("the driven inertias are not acceptable", "seen: 3;", "a sequence of Driven")),
        ({"driven": (3,)}, ("the driven inertias are not acceptable", "seen: 3;")),
        ({"driven": ({"inertial": 1},)}, ("a driven inertia has no such quantity", "'inertial'", "inertia")),
        ({"driven": ({"behind": 7},)}, ("inertia 7 is behind an inertia", "behind=7", "1 (the wheel) to 6, where 6")),
        ({"driven": ({"behind": 0},)}, ("inertia 7 is behind an inertia", "behind=0")),
        ({"driven": (Driven(load="T_a"), Driven(load="T_a"))}, ("the input T_a is declared twice",)),
    ],
)  # fmt: skip
def test_options_that_do_not_fit(options, texts):
    with pytest.raises(ModelError) as caught:
        ce.crankshaft(**options)
    for text in texts:
        assert text in str(caught.value)


def test_a_driven_inertia_must_be_positive():
    with pytest.raises(ParameterError, match="J7"):
        ce.crankshaft(driven=(Driven(inertia=-1.0),)).parameters()


def test_geometry_is_read():
    model = ce.crankshaft(geometry=Geometry.from_bore(0.08, stroke=0.09, rod=0.15, mass=0.6))
    assert model.parameter_vector()[-5:-1].tolist() == pytest.approx([0.045, 0.15, PI * 0.08**2 / 4, 0.6])


def test_a_coupling_must_be_behind_an_earlier_inertia():
    b = Blueprint("loop")
    bodies = [Inertia("one", "omega_1", 1.0), Inertia("two", "omega_2", 1.0)]
    with pytest.raises(
        ModelError, match="the coupling link is behind an inertia that does not come"
    ) as caught:
        declare_chain(b, bodies, [Coupling("link", "twist", 1.0, 0.0, behind=1)])
    assert "seen: behind=1; allowed: 0 to 0, counted from 0" in str(caught.value)
    assert "do: list the inertias from the first one outwards" in str(caught.value)


@pytest.mark.parametrize("options", [{}, {"angle": "state"}, {"reciprocating_speed": "measured"}])
def test_drives_depend_on_channels_alone(options):
    model = ce.crankshaft(**options)
    assert not ca.depends_on(model.drive_expressions, ca.vertcat(model.x, model.w))
    assert model.linear is not None
