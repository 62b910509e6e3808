"""The exact test and the Fisher information say the same, and every remedy found by the one is seen by the other."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.identifiability import PlannedExperiment, fisher, identifiability
from tests.quick import few

TRUE = {"J_eng": 0.39, "J_load": 0.18, "K_el": 2000.0, "C_el": 2.5, "C_eng": 0.15}
START = {"omega_eng": 100.0, "omega_load": 104.0, "twist": -0.02}
SIGMA = 0.02
TIME = np.arange(1200) * 1e-3
STEPS = np.where((TIME * 7).astype(int) % 2 == 0, 80.0, 20.0)
DRIVES = {"generic": STEPS, "constant": np.full(len(TIME), 50.0), "zero": np.zeros(len(TIME))}


def model(*sensors):
    """Two masses with torques as channels; the engine's speed is measured, and any other state asked for."""
    b = ce.Blueprint("two_masses")
    ji, jl = (b.parameter(name, TRUE[name], unit="kg m2", min=1e-3) for name in ("J_eng", "J_load"))
    k = b.parameter("K_el", TRUE["K_el"], unit="N m/rad", min=1.0)
    c, friction = (b.parameter(name, TRUE[name], unit="N m s/rad", min=1e-4) for name in ("C_el", "C_eng"))
    states = {
        name: b.state(name, unit=unit)
        for name, unit in (("omega_eng", "rad/s"), ("omega_load", "rad/s"), ("twist", "rad"))
    }
    te, tl = b.input("T", unit="N m"), b.input("T_load", unit="N m")
    through = k * states["twist"] + c * (states["omega_load"] - states["omega_eng"])
    b.ode("omega_eng", (te + through - friction * states["omega_eng"]) / ji)
    b.ode("omega_load", (-through - tl) / jl)
    b.ode("twist", states["omega_load"] - states["omega_eng"])
    b.output("omega", states["omega_eng"], unit="rad/s")
    for name in sensors:
        b.output(f"{name}_seen", states[name], unit="rad" if name == "twist" else "rad/s")
    return b.model()


def noise(made):
    return ce.Noise(**{out.name: SIGMA * (1e-3 if out.unit == "rad" else 1.0) for out in made.outputs})


def inputs(words):
    units = {"T": "N m", "T_load": "N m"}
    channels = {name: DRIVES[words[name]] * (1.0 if name == "T" else 0.8) for name in units}
    return ce.Experiment.from_arrays("run", time=TIME, units=units, **channels)


@pytest.mark.parametrize("engine", ["generic", "constant", "zero"])
@pytest.mark.parametrize("load", ["generic", "constant", "zero"])
@pytest.mark.parametrize("start", ["free", "known"])
def test_the_ranks_agree_for_every_class_of_inputs_and_starts(engine, load, start):
    words = {"T": engine, "T_load": load}
    exact = identifiability(model(), inputs=words, start=start)
    plan = PlannedExperiment(inputs(words), start=START, known_start=start == "known")
    practice = fisher(model(), plan, noise=noise(model()))
    assert len(practice.free) - len(practice.undetermined) == exact.directions
    told = {name: practice.errors[name].stderr is not None for name in TRUE}
    assert told == {name: exact.identifiable[name] for name in TRUE}


def applied(remedy):
    """The model, inputs, parameters and start with the changes of a remedy made."""
    words, sensors = {"T": "constant", "T_load": "constant"}, []
    start, known, fixed = dict(START), False, []
    for change in remedy.changes:
        if change.kind == "drive":
            words[change.what] = "generic"
        elif change.kind == "sensor":
            sensors.append(change.what)
        elif change.kind == "start":
            known = True
            start = dict.fromkeys(START, 0.0) if change.what == "rest" else start
        else:
            assert change.kind == "fix", remedy
            fixed.append(change.what)
    made = model(*sensors)
    parameters = made.parameters()
    for name in fixed:
        parameters.fix(name)
    return made, inputs(words), parameters, start, known


def remedies():
    return identifiability(model(), inputs="constant").remedies(most=20)


def test_remedies_are_there():
    found = remedies()
    assert len(found) >= 8
    assert {change.kind for one in found for change in one.changes} >= {"drive", "sensor", "start", "fix"}


@pytest.mark.parametrize("number", few(range(8), 0, 4))
def test_a_remedy_restores_the_information_and_a_fit_gives_the_parameters_back(number):
    made, run, parameters, start, known = applied(remedies()[number])
    info = fisher(
        made, PlannedExperiment(run, start=start, known_start=known), parameters=parameters, noise=noise(made)
    )
    assert not info.undetermined
    free = [name for name in TRUE if parameters[name].vary]
    good = [name for name in free if info.relative[name] < 0.2]
    clean = ce.simulate(made, run, parameters=parameters, initial=start)
    draw = np.random.default_rng(11)
    data, levels = run, noise(made)
    for out in made.outputs:
        values = clean[out.name].values + levels.level(out.name) * draw.standard_normal(len(TIME))
        data = data.with_channel(
            ce.Experiment.from_arrays("y", time=TIME, units={out.name: out.unit}, **{out.name: values})[
                out.name
            ]
        )
    for name in free:
        parameters[name].set(TRUE[name] * (1 + 0.2 * draw.choice([-1, 1])))
    fit = ce.estimate(
        made, data, parameters=parameters, noise=levels, initial=start if known else None, progress=False
    )
    assert fit.converged
    assert not fit.undetermined
    assert good, "no parameter is expected to be found: the remedy is one on paper"
    for name in good:
        assert abs(fit.values[name] - TRUE[name]) < 4 * info.errors[name].stderr, name
