"""Where a remedy is found and the expected error is small, a fit recovers the parameters (and not without it)."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.identifiability import PlannedExperiment, fisher

TRUE = {"J_eng": 0.39, "J_load": 0.18, "K_el": 2000.0, "C_el": 2.5, "C_eng": 0.15}
START = {"omega_eng": 100.0, "omega_load": 104.0, "twist": -0.02}
SIGMA = 0.02


def model():
    b = ce.Blueprint("two_masses")
    ji, jl = (b.parameter(name, TRUE[name], unit="kg m2", min=1e-3) for name in ("J_eng", "J_load"))
    k = b.parameter("K_el", TRUE["K_el"], unit="N m/rad", min=1.0)
    c, ce_ = (b.parameter(name, TRUE[name], unit="N m s/rad", min=1e-4) for name in ("C_el", "C_eng"))
    we, wl, twist = (
        b.state("omega_eng", unit="rad/s"),
        b.state("omega_load", unit="rad/s"),
        b.state("twist", unit="rad"),
    )
    te, tl = b.input("T", unit="N m"), b.input("T_load", unit="N m")
    through = k * twist + c * (wl - we)
    b.ode("omega_eng", (te + through - ce_ * we) / ji)
    b.ode("omega_load", (-through - tl) / jl)
    b.ode("twist", wl - we)
    b.output("omega", we, unit="rad/s")
    return b.model()


def plan(*, engine, load):
    time = np.arange(1500) * 1e-3
    steps = np.where((time * 7).astype(int) % 2 == 0, 80.0, 20.0)
    units = {"T": "N m", "T_load": "N m"}
    return ce.Experiment.from_arrays(
        "run", time=time, units=units, T=steps * engine, T_load=steps[::-1] * load
    )


REMEDIES = {
    "excite the engine": ({"engine": 1, "load": 0}, ()),
    "fix J_load and C_eng": ({"engine": 0, "load": 0}, ("J_load", "C_eng")),
}


def test_without_a_remedy_nothing_is_determined():
    info = fisher(
        model(), PlannedExperiment(plan(engine=0, load=0), start=START), noise=ce.Noise(omega=SIGMA)
    )
    assert len(info.undetermined) == 2
    assert all(info.errors[name].stderr is None for name in TRUE)


def test_what_structure_restores_may_still_be_out_of_reach():
    """Steps of the load alone determine all five, but not to 20 % at this noise and length."""
    info = fisher(
        model(), PlannedExperiment(plan(engine=0, load=1), start=START), noise=ce.Noise(omega=SIGMA)
    )
    assert not info.undetermined
    assert max(info.relative[name] for name in TRUE) > 0.2
    assert "hardly known" in str(info)


@pytest.mark.parametrize("remedy", REMEDIES)
def test_with_it_a_fit_gives_them_back(remedy):
    torques, fixed = REMEDIES[remedy]
    pars = model().parameters()
    for name in fixed:
        pars.fix(name)
    inputs = plan(**torques)
    info = fisher(
        model(), PlannedExperiment(inputs, start=START), parameters=pars, noise=ce.Noise(omega=SIGMA)
    )
    assert not info.undetermined
    free = [name for name in TRUE if name not in fixed]
    assert all(info.relative[name] < 0.2 for name in free)
    run = ce.simulate(model(), inputs, parameters=pars, initial=START)["omega"]
    noisy = run.values + SIGMA * np.random.default_rng(11).standard_normal(len(run))
    measured = ce.Experiment.from_arrays("omega", time=run.time, units={"omega": "rad/s"}, omega=noisy)[
        "omega"
    ]
    draw = np.random.default_rng(3)
    for name in free:
        pars[name].set(TRUE[name] * (1 + 0.3 * draw.choice([-1, 1])))
    fit = ce.estimate(
        model(), inputs.with_channel(measured), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False
    )
    assert fit.converged
    assert not fit.undetermined
    for name in free:
        expected = info.errors[name].stderr
        assert abs(fit.values[name] - TRUE[name]) < 4 * expected, name
        assert fit.stderr[name] == pytest.approx(expected, rel=0.15), name
