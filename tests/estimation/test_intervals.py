"""Two masses on a kept record: the answer does not depend on how the record is cut, nor on the form of the model."""

import numpy as np
import pytest

import casadi_engine as ce
from tests.quick import few

FREE = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}
KNOWN = ce.Noise(omega=0.1)


def far(model):
    """The model's set, 40 % off."""
    pars = model.parameters()
    for name in FREE:
        pars[name].set(1.4 * pars[name].value)
    return pars


def fitted(data, interval="auto", speed="measured", **options):
    model = ce.two_mass(reciprocating_speed=speed)
    return ce.estimate(
        model, data, parameters=far(model), noise=KNOWN, interval=interval, progress=False, **options
    )


@pytest.fixture(scope="module")
def reference(misfire):
    return fitted(misfire(1, 2), 20)


def test_all_five_are_found_from_far(reference):
    assert reference.status == "converged"
    errors = np.array([reference.values[n] - TRUTH[n] for n in FREE])
    assert np.abs(errors / [reference.stderr[n] for n in FREE]).max() < 4.5
    assert reference.cost == pytest.approx(reference.dof, abs=4.5 * np.sqrt(2 * reference.dof))
    frequencies = np.sort(reference.model.modes(reference.parameters).frequencies_hz)
    np.testing.assert_allclose(frequencies[[0, -1]], [0.043, 20.345], rtol=0.01)


@pytest.mark.parametrize("interval", [1, 144, 1440, "single", "auto", "10 ms", 97, "2 ms"])
def test_interval_lengths_agree(misfire, reference, interval):
    fit = fitted(misfire(1, 2), interval)
    assert fit.status == "converged"
    np.testing.assert_allclose(fit.z, reference.z, rtol=1e-7)
    np.testing.assert_allclose(fit.covariance, reference.covariance, rtol=1e-4)
    assert fit.cost == pytest.approx(reference.cost, rel=1e-9)
    for state, estimate in fit.initial["misfire_1200rpm"].items():
        other = reference.initial["misfire_1200rpm"][state]
        assert estimate.value == pytest.approx(other.value, abs=1e-4 * other.stderr)
        assert estimate.stderr == pytest.approx(other.stderr, rel=1e-5)
    trace, other = (f.traces["misfire_1200rpm"]["omega"].simulated for f in (fit, reference))
    np.testing.assert_allclose(trace, other, rtol=1e-9)


def test_the_number_of_intervals(misfire):
    data = misfire(1, 2)
    nodes = {length: fitted(data, length).nodes for length in (20, 144, 1440, "single", "20 samples")}
    assert nodes == {20: 144, 144: 20, 1440: 2, "single": 1, "20 samples": 144}


@pytest.mark.parametrize("interval", few(["auto", 20, 480, "single"], "auto"))
def test_the_nonlinear_form_gives_nearly_the_same(misfire, reference, interval):
    # Its torque (3.5) takes the model's own speed where the linear form takes the noisy measured one.
    fit = fitted(misfire(1, 2), interval, speed="model")
    assert fit.status == "converged"
    np.testing.assert_allclose(fit.z, reference.z, rtol=2e-4)
    for name in FREE:
        assert abs(fit.values[name] - reference.values[name]) < 0.1 * reference.stderr[name]
        assert fit.stderr[name] == pytest.approx(reference.stderr[name], rel=0.01)


def test_resampled_by_twenty_as_in_the_thesis(misfire, reference):
    fit = fitted(misfire(1, 2).resample(omega=20))
    assert (fit.status, fit.n) == ("converged", 144)
    for name in FREE:
        assert abs(fit.values[name] - TRUTH[name]) < 4.5 * fit.stderr[name]
        assert 3 < fit.stderr[name] / reference.stderr[name] < 7


def test_both_speeds_determine_the_coupling_better(misfire, reference):
    model = ce.two_mass(reciprocating_speed="measured", outputs=("omega", "omega_load"))
    fit = ce.estimate(model, misfire(1, 2), parameters=far(model), progress=False)
    assert fit.status == "converged"
    assert fit.n == 2 * reference.n
    assert fit.noise["omega_load"][0] == pytest.approx(0.1, rel=0.1)
    for name in FREE:
        assert abs(fit.values[name] - TRUTH[name]) < 4.5 * fit.stderr[name]
    assert fit.stderr["J_load"] < 0.7 * reference.stderr["J_load"]


# ---- options


@pytest.mark.parametrize(
    "interval", [0, -3, 2.5, True, "ten", "10 m", "0 samples", "0.00001 ms", "1e999 s", [1]]
)
def test_other_intervals_are_refused(run_up, refused, interval):
    with refused(
        ce.errors.EstimationError,
        "the shooting interval is not acceptable",
        seen=repr(interval),
        allowed='"auto", "single", a whole number of samples >= 1, or a time such as "10 ms"',
        cure='leave it out for "auto"',
    ):
        ce.estimate(ce.one_inertia(), run_up(), interval=interval, progress=False)


def test_an_interval_longer_than_the_record_is_the_record(run_up):
    fit = ce.estimate(ce.one_inertia(), run_up(), interval=100_000, progress=False)
    assert (fit.nodes, fit.status) == (1, "converged")


def test_a_numpy_whole_number_is_one(run_up):
    fit = ce.estimate(ce.one_inertia(), run_up(), interval=np.int64(100), starts=np.int64(1), progress=False)
    assert fit.nodes == 4
