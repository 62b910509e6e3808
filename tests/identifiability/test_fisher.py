"""The Fisher information against closed forms, complex-step derivatives, fits, and hand-derived null vectors."""

import math

import numpy as np
import pytest
from scipy.linalg import expm, null_space, subspace_angles

import casadi_engine as ce
from casadi_engine.errors import EstimationError, ExperimentError, ExpressionError, ParameterError
from casadi_engine.identifiability import PlannedExperiment, fisher

RPM = math.pi / 30


def run_up(torque, step=0.02, name="run_up", **outputs):
    time = step * np.arange(len(torque))
    units = {"T": "N m"} | dict.fromkeys(outputs, "rad/s")
    return ce.Experiment.from_arrays(name, time=time, units=units, hold="zero", T=torque, **outputs)


def one_inertia_rows(time, torque, inertia, damping, start):
    """d omega/d(log J), d/d(C/C0), d/d(omega_0) of the response to a constant torque, by hand."""
    rate, final = damping / inertia, torque / damping
    decay = np.exp(-rate * time)
    along_rate = -time * decay * (start - final)
    along_final = 1 - decay
    by_log_inertia = along_rate * -rate
    by_share_of_damping = along_rate * rate - along_final * final
    return np.stack([by_log_inertia, by_share_of_damping, decay], axis=1)


@pytest.mark.parametrize("known", [True, False])
def test_one_inertia_has_the_closed_form(known):
    model, torque = ce.one_inertia(), np.full(150, 2.0)
    pars = model.parameters()
    pars["J_eng"].set(0.4)
    pars["C_eng"].set(0.5)
    plan = PlannedExperiment(run_up(torque), start={"omega_eng": 10.0}, known_start=known)
    info = fisher(model, plan, parameters=pars, noise=ce.Noise(omega=0.05))
    rows = one_inertia_rows(0.02 * np.arange(150), 2.0, 0.4, 0.5, 10.0) / 0.05
    whole = rows.T @ rows
    expected = whole[:2, :2] if known else whole[:2, :2] - np.outer(whole[:2, 2], whole[2, :2]) / whole[2, 2]
    np.testing.assert_allclose(info.matrix, expected, rtol=1e-9)
    errors = np.sqrt(np.diag(np.linalg.inv(expected)))
    assert info.relative["J_eng"] == pytest.approx(errors[0], rel=1e-8)
    assert info.errors["C_eng"].stderr == pytest.approx(0.5 * errors[1], rel=1e-8)
    assert info.n == 150
    assert info.duration == pytest.approx(0.02 * 149)


def two_mass_response(p, torque, load, start, step):
    """Engine speed (N,) of (4.5) with first-order hold, written by hand for complex parameters."""
    inertia, load_inertia, k, c, c_eng = p
    a = np.array(
        [
            [-(c + c_eng) / inertia, c / inertia, k / inertia],
            [c / load_inertia, -c / load_inertia, -k / load_inertia],
            [-1, 1, 0],
        ]
    )
    b = np.array([[1 / inertia, 0], [0, -1 / load_inertia], [0, 0]])
    block = np.zeros((7, 7), dtype=complex)
    block[:3, :3], block[:3, 3:5], block[3:5, 5:7] = a * step, b * step, np.eye(2)
    whole = expm(block)
    f, g, ramp = whole[:3, :3], whole[:3, 3:5], whole[:3, 5:7]
    u, x, y = np.array([torque, load]), np.array(start, dtype=complex), []
    for i in range(len(torque)):
        y.append(x[0])
        ahead = u[:, min(i + 1, len(torque) - 1)]
        x = f @ x + (g - ramp) @ u[:, i] + ramp @ ahead
    return np.array(y)


def plain_two_mass():
    """Two masses with torques as channels, so that an oracle can be written in a few lines."""
    b = ce.Blueprint("two_masses")
    ji, jl = (
        b.parameter("J_eng", 0.39, unit="kg m2", min=1e-3),
        b.parameter("J_load", 0.18, unit="kg m2", min=1e-3),
    )
    k = b.parameter("K_el", 2000.0, unit="N m/rad", min=1.0)
    c, ce_ = (
        b.parameter("C_el", 2.5, unit="N m s/rad", min=0),
        b.parameter("C_eng", 0.15, unit="N m s/rad", min=0),
    )
    we, wl = b.state("omega_eng", unit="rad/s"), b.state("omega_load", unit="rad/s")
    twist = b.state("twist", unit="rad")
    te, tl = b.input("T", unit="N m"), b.input("T_load", unit="N m")
    through = k * twist + c * (wl - we)
    b.ode("omega_eng", (te + through - ce_ * we) / ji)
    b.ode("omega_load", (-through - tl) / jl)
    b.ode("twist", wl - we)
    b.output("omega", we, unit="rad/s")
    return b.model()


TRUE = np.array([0.39, 0.18, 2000.0, 2.5, 0.15])
START = {"omega_eng": 100.0, "omega_load": 101.0, "twist": -0.02}


def torques(n=700, seed=3, *, engine=True, load=True):
    draw = np.random.default_rng(seed)
    smooth = np.convolve(draw.standard_normal(n + 8), np.ones(9) / 9, "valid")
    return 60 + 80 * smooth if engine else np.zeros(n), np.where(np.arange(n) > n / 2, 70.0, 45.0) * load


def channels(torque, load, step=1e-3, name="plan", **outputs):
    units = {"T": "N m", "T_load": "N m"} | dict.fromkeys(outputs, "rad/s")
    time = step * np.arange(len(torque))
    return ce.Experiment.from_arrays(name, time=time, units=units, T=torque, T_load=load, **outputs)


def test_two_masses_agree_with_complex_steps():
    torque, load = torques()
    info = fisher(
        plain_two_mass(), PlannedExperiment(channels(torque, load), start=START), noise=ce.Noise(omega=0.1)
    )
    start, tiny = np.array(list(START.values())), 1e-30
    columns = []
    for k in range(5):
        moved = TRUE.astype(complex)
        moved[k] *= 1 + 1j * tiny
        columns.append(two_mass_response(moved, torque, load, start, 1e-3).imag / tiny)
    for k in range(3):
        moved = start.astype(complex)
        moved[k] += 1j * tiny
        columns.append(two_mass_response(TRUE, torque, load, moved, 1e-3).imag / tiny)
    rows = np.stack(columns, axis=1) / 0.1
    covariance = np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(
        [info.relative[name] for name in info.free], np.sqrt(np.diag(covariance))[:5], rtol=1e-6
    )


def characteristic_gradient():
    """Gradient (3, 5), in relative changes, of the coefficients of det(s - A) of the two masses, by hand."""
    je, jl, k, c, ce_ = TRUE
    return np.array(
        [
            # s^2: (C_eng + C_el)/J_eng + C_el/J_load
            [-(c + ce_) / je, -c / jl, 0, c / je + c / jl, ce_ / je],
            # s: K/J_eng + K/J_load + C_eng C_el/(J_eng J_load)
            [-k / je - ce_ * c / je / jl, -k / jl - ce_ * c / je / jl, k / je + k / jl, ce_ * c / je / jl,
             ce_ * c / je / jl],
            # 1: C_eng K/(J_eng J_load)
            [-ce_ * k / je / jl, -ce_ * k / je / jl, ce_ * k / je / jl, 0, ce_ * k / je / jl],
        ]
    )  # fmt: skip


def test_without_torques_the_information_is_singular_along_the_scaling_and_one_more():
    """A free response tells three poles: two directions of five are lost, one the joint scaling of J, K, C."""
    plan = PlannedExperiment(channels(np.zeros(700), np.zeros(700)), start=START)
    info = fisher(plain_two_mass(), plan, noise=ce.Noise(omega=0.1))
    assert len(info.undetermined) == 2
    lost = np.array([[d.weights.get(name, 0.0) for name in info.free] for d in info.undetermined]).T
    exact = null_space(characteristic_gradient())
    assert exact.shape == (5, 2)
    assert np.max(subspace_angles(lost, exact)) < 1e-5
    scaling = np.ones(5)
    assert np.linalg.norm(scaling - exact @ (exact.T @ scaling)) < 1e-9
    size = np.trace(info.matrix)
    assert scaling @ info.matrix @ scaling < 1e-12 * size
    assert all(info.errors[name].stderr is None for name in info.free)
    assert info.errors["J_eng"].why == "the data do not determine it"
    assert info.of("K_el/J_eng").stderr is None or info.of("K_el*J_load/(J_eng*J_load)").stderr is not None
    assert "not determined at all" in str(info)
    assert "fix or tie one of" in str(info)


def test_what_poles_tell_is_known_though_the_parameters_are_not():
    plan = PlannedExperiment(channels(np.zeros(700), np.zeros(700)), start=START)
    info = fisher(plain_two_mass(), plan, noise=ce.Noise(omega=0.1))
    damping_sum = info.of("(C_eng + C_el)/J_eng + C_el/J_load")
    assert damping_sum.value == pytest.approx((0.15 + 2.5) / 0.39 + 2.5 / 0.18)
    assert 0 < damping_sum.stderr < 0.2 * damping_sum.value
    assert info.of("J_eng").why == "the data do not determine it"


def test_constant_torques_lose_one_direction_and_known_rest_none():
    steady = channels(np.full(700, 60.0), np.full(700, 45.0))
    model = plain_two_mass()
    free = fisher(model, PlannedExperiment(steady, start=START), noise=ce.Noise(omega=0.1))
    rest = dict.fromkeys(START, 0.0)
    known = PlannedExperiment(steady, start=rest, known_start=True)
    assert len(free.undetermined) == 1
    assert len(fisher(model, known, noise=ce.Noise(omega=0.1)).undetermined) == 0


@pytest.fixture(scope="module")
def noisy_fit():
    torque, load = torques()
    start = np.array(list(START.values()))
    clean = two_mass_response(TRUE, torque, load, start, 1e-3).real
    omega = clean + 0.1 * np.random.default_rng(5).standard_normal(len(clean))
    pars = plain_two_mass().parameters()
    pars.tie("J_load", "0.45*J_eng + 0.005")
    pars["C_el"].set(prior=(2.0, 0.6))
    pars.constrain("K_el/C_eng", 2000 / 0.15, 2000 / 0.15)
    data = channels(torque, load, omega=omega)
    return ce.estimate(plain_two_mass(), data, parameters=pars, noise=ce.Noise(omega=0.1), progress=False)


def test_expected_errors_are_those_of_a_fit_with_ties_priors_and_equalities(noisy_fit):
    assert noisy_fit.converged
    start = {name: one.value for name, one in noisy_fit.initial["plan"].items()}
    there = PlannedExperiment(noisy_fit.data[0], start=start)
    info = fisher(noisy_fit.model, there, parameters=noisy_fit.parameters, noise=ce.Noise(omega=0.1))
    for name in ("J_eng", "J_load", "K_el", "C_el", "C_eng"):
        assert info.errors[name].stderr == pytest.approx(noisy_fit.stderr[name], rel=1e-5), name
    assert info.of("J_load").stderr == pytest.approx(info.errors["J_load"].stderr, rel=1e-9)


def test_the_noise_level_can_come_from_residuals(noisy_fit):
    info = fisher(noisy_fit.model, noisy_fit.data, parameters=noisy_fit.parameters)
    sigma, found = info.noise["omega"]
    assert found
    assert sigma == pytest.approx(0.1, rel=0.06)


def test_two_records_add_up_and_their_shares_are_told():
    model, noise = plain_two_mass(), ce.Noise(omega=0.1)
    plans = [PlannedExperiment(channels(*torques(seed=k), name="run"), start=START) for k in (3, 4)]
    both = fisher(model, plans, noise=noise)
    assert tuple(both.records) == ("run", "run_2")
    single = [fisher(model, plan, noise=noise).matrix for plan in plans]
    np.testing.assert_allclose(both.matrix, single[0] + single[1], rtol=1e-12)
    np.testing.assert_allclose(both.records["run_2"], single[1], rtol=1e-12)


def test_a_prior_alone_gives_its_own_error():
    model, torque = ce.one_inertia(), np.zeros(50)
    pars = model.parameters()
    pars["C_eng"].set(0.5)
    pars["J_eng"].set(0.4, prior=(0.4, 0.02))
    plan = PlannedExperiment(run_up(torque), start={"omega_eng": 0.0}, known_start=True)
    info = fisher(model, plan, parameters=pars, noise=ce.Noise(omega=1.0))
    assert info.errors["J_eng"].stderr == pytest.approx(0.02)
    assert info.errors["C_eng"].stderr is None
    assert info.directions[0].stderr == math.inf
    assert info.directions[0].text == "C_eng"


def test_held_parameters_have_no_error():
    pars = ce.one_inertia().parameters()
    pars.constrain("J_eng", 0.39, 0.39)
    pars["J_eng"].set(0.39)
    info = fisher(ce.one_inertia(), run_up(np.full(60, 2.0)), parameters=pars, noise=ce.Noise(omega=0.1))
    assert info.errors["J_eng"].why == "held by equality constraints"


def test_directions_in_words_are_eigenvectors():
    plan = PlannedExperiment(channels(*torques()), start=START)
    info = fisher(plain_two_mass(), plan, noise=ce.Noise(omega=0.1))
    worst = info.directions[0]
    vector = np.array([worst.weights.get(name, 0.0) for name in info.free])
    vector /= np.linalg.norm(vector)
    assert worst.stderr == pytest.approx(np.sqrt(vector @ info.covariance @ vector), rel=1e-4)
    assert worst.stderr == pytest.approx(np.sqrt(np.linalg.eigvalsh(info.covariance)[-1]), rel=1e-9)
    assert [d.stderr for d in info.directions] == sorted((d.stderr for d in info.directions), reverse=True)


# ---- messages


def test_messages():
    model, noise = ce.one_inertia(), ce.Noise(omega=0.1)
    good = run_up(np.full(60, 2.0))
    with pytest.raises(
        EstimationError, match="the noise level of omega is not known, and no measured sample"
    ):
        fisher(model, good)
    with pytest.raises(EstimationError, match="expected errors are those of output error"):
        fisher(model, good, noise=ce.Noise(omega=0.1, gain=[[1.0]]))
    with pytest.raises(EstimationError, match=r"the noise is not acceptable; seen: 0\.1"):
        fisher(model, good, noise=0.1)
    with pytest.raises(EstimationError, match="the parameters are not a parameter set; seen: dict"):
        fisher(model, good, parameters={}, noise=noise)
    fixed = model.parameters()
    fixed.fix("J_eng")
    fixed.fix("C_eng")
    with pytest.raises(ParameterError, match="no parameter is free, so there is nothing to ask the data for"):
        fisher(model, good, parameters=fixed, noise=noise)
    with pytest.raises(ExperimentError, match="there is no experiment; seen: an empty sequence"):
        fisher(model, [], noise=noise)
    with pytest.raises(ExperimentError, match="there is no experiment; seen: 3"):
        fisher(model, 3, noise=noise)
    with pytest.raises(
        ExperimentError, match="a planned experiment needs an experiment with the input channels"
    ):
        fisher(model, ["run_up"], noise=noise)
    info = fisher(model, good, noise=noise)
    with pytest.raises(ExpressionError, match="J_engine"):
        info.of("J_engine")
