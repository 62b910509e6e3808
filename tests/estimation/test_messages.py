"""What estimate refuses, and the words that it refuses it in."""

import numpy as np
import pytest

import casadi_engine as ce

E = ce.errors.EstimationError


def fit(run_up, **options):
    return ce.estimate(ce.one_inertia(), run_up(), **{"progress": False, **options})


@pytest.mark.parametrize("data", [None, [], 3, "file.csv", ["file.csv"]])
def test_data_that_are_no_experiments(data, refused):
    with refused(
        E,
        "there is nothing to fit to",
        allowed="an Experiment, or a sequence of one or more",
        cure="read one by read_experiment(path)",
    ):
        ce.estimate(ce.one_inertia(), data, progress=False)


@pytest.mark.parametrize("name", ["starts", "max_iterations"])
@pytest.mark.parametrize("value", [0, -1, 1.5, True, "2", None])
def test_counts(run_up, refused, name, value):
    with refused(
        E,
        f"{name} is not acceptable",
        seen=repr(value),
        allowed="a whole number >= 1",
        cure=f"leave {name} out",
    ):
        fit(run_up, **{name: value})


@pytest.mark.parametrize("value", [-1, 0.5, "a", True])
def test_the_seed(run_up, refused, value):
    with refused(E, "seed is not acceptable", seen=repr(value), allowed="a whole number >= 0"):
        fit(run_up, seed=value)


@pytest.mark.parametrize("value", [0, -1e-9, float("nan"), float("inf"), "small", True])
def test_the_tolerance(run_up, refused, value):
    with refused(
        E,
        "the tolerance is not acceptable",
        seen=repr(value),
        allowed="a number > 0, such as 1e-9",
        cure="leave it out",
    ):
        fit(run_up, tolerance=value)


def test_the_method(run_up, refused):
    with refused(
        ce.errors.SimulationError, "the method is not known", seen="'rk4'", allowed='"exact" or "euler"'
    ):
        fit(run_up, method="rk4")


def test_the_treatment_of_ties(run_up, refused):
    with refused(ce.errors.ParameterError, "unknown treatment of ties", seen="'keep'"):
        fit(run_up, ties="keep")


@pytest.mark.parametrize("parameters", [{"J_eng": 0.4}, 3])
def test_parameters_that_are_no_set(run_up, refused, parameters):
    with refused(
        E,
        "the parameters are not a parameter set",
        seen=type(parameters).__name__,
        allowed="a Parameters object",
        cure="start from model.parameters() and set values by pars[name].set(value)",
    ):
        fit(run_up, parameters=parameters)


def test_a_set_that_lacks_a_parameter_of_the_model(run_up, refused):
    pars = ce.Parameters()
    pars.add("J_eng", 0.4)
    with pytest.raises(ce.errors.ParameterError, match="C_eng"):
        fit(run_up, parameters=pars)


@pytest.mark.parametrize("noise", [0.1, {"omega": 0.1}])
def test_noise_that_is_none(run_up, refused, noise):
    with refused(
        E,
        "the noise is not acceptable",
        seen=repr(noise),
        allowed="a Noise, or None to estimate the levels of all outputs",
        cure="write noise=ce.Noise(omega=0.1), for instance",
    ):
        fit(run_up, noise=noise)


def test_noise_of_an_unknown_output(run_up, refused):
    with refused(
        E,
        "the model one_inertia has no such output",
        seen="noise of 'omega_load'",
        allowed="omega",
        cure="name the model's outputs",
    ):
        fit(run_up, noise=ce.Noise(omega_load=0.1))


@pytest.mark.parametrize("gain", [[[1.0, 2.0]], [[1.0], [2.0]]])
def test_a_gain_of_another_shape(run_up, refused, gain):
    with refused(
        E,
        "the gain has the wrong shape",
        seen=str(np.shape(gain)),
        allowed="(1, 1): states omega_eng by outputs omega",
        cure="give one row for each state and one column for each output",
    ):
        fit(run_up, noise=ce.Noise(omega=0.1, gain=gain))


# ---- initial states


@pytest.mark.parametrize(
    "given",
    [
        3.0,
        [100.0],
        {"omega_eng": "fixed"},
        {"omega_eng": (3, 1)},
        {"omega_eng": (1, 2, 3)},
        {"omega_eng": ("a", "b")},
        {"omega_eng": (0, float("nan"))},
        {"omega_eng": float("nan")},
        {"omega_eng": float("inf")},
        {"omega_eng": None},
        {"omega_eng": True},
        {"omega_eng": np.zeros(3)},
    ],
)
def test_initial_states_of_another_kind(run_up, refused, given):
    with refused(
        E,
        "the initial states are not acceptable",
        allowed='a mapping of state to a number (fixed), a pair (low, high) with low < high, or "free"',
        cure='write initial={"omega_eng": 0.5} or initial={"omega_eng": (0.1, 0.9)}, for instance',
    ):
        fit(run_up, initial=given)


@pytest.mark.parametrize("value", [20, np.float32(20), np.int64(20), np.array(20.0)])
def test_any_number_fixes_an_initial_state(run_up, value):
    assert fit(run_up, initial={"omega_eng": value}).initial["run_up"]["omega_eng"].value == 20


@pytest.mark.parametrize("given", [{"omega": 1.0}, {"run_up": {"omega": 1.0}}])
def test_an_initial_value_of_an_unknown_state(run_up, refused, given):
    with refused(
        E,
        "the model one_inertia has no such state",
        seen="'omega'",
        allowed="omega_eng",
        cure="print(model.table()) lists the states",
    ):
        fit(run_up, initial=given)


def test_initial_states_of_an_unknown_record(run_up, refused):
    with refused(
        E,
        "initial states are given for a record that is not there",
        seen="'other'",
        allowed="run_up",
        cure="use the record's name",
    ):
        fit(run_up, initial={"other": {"omega_eng": 20.0}})


# ---- records that do not suit the model


def test_a_record_without_the_output(run_up, refused):
    with pytest.raises(ce.errors.ExperimentError, match="omega"):
        ce.estimate(ce.one_inertia(), run_up().without("omega"), progress=False)


def test_a_record_without_an_input(run_up):
    with pytest.raises(ce.errors.ExperimentError, match="'T'"):
        ce.estimate(ce.one_inertia(), run_up().without("T"), progress=False)


def test_a_channel_of_another_unit(run_up):
    data = run_up()
    units = {"T": "bar", "omega": "rad/s"}
    wrong = ce.Experiment.from_arrays(
        "r", time=data["T"].time, units=units, T=data["T"].values, omega=data["omega"].values
    )
    with pytest.raises(ce.errors.UnitError, match="N m"):
        ce.estimate(ce.one_inertia(), wrong, progress=False)


# ---- noise levels


@pytest.mark.parametrize("level", [0, -0.1, float("nan"), float("inf"), "known", None, True])
def test_noise_levels_that_are_none(refused, level):
    with (
        refused(
            E,
            "the noise level of omega is not acceptable",
            seen=str(level) if isinstance(level, str) else repr(level),
            allowed='a standard deviation > 0 in the unit of the output, or "estimate"',
            cure='write Noise(omega="estimate") if it is not known',
        )
        if level is not None
        else pytest.raises(E, match="the noise level of omega is not acceptable")
    ):
        ce.Noise(omega=level)


@pytest.mark.parametrize("gain", ["one", [[float("nan")]], [[[1.0]]], [[1.0], [1.0, 2.0]]])
def test_gains_that_are_none(refused, gain):
    with refused(
        E,
        "the gain of the predictor is not acceptable",
        seen=repr(gain),
        allowed="None, or a matrix of finite numbers, states by outputs",
        cure="write Noise(gain=[[1.0]]) for one state that is measured",
    ):
        ce.Noise(omega=0.1, gain=gain)


def test_a_gain_with_a_model_that_is_not_linear(misfire, refused):
    with refused(
        ce.errors.SimulationError,
        "this model has nonlinear terms, and the option is for linear models",
        seen="a correction gain",
        cure="take the linear form of the model",
    ):
        ce.estimate(
            ce.two_mass(), misfire(1, 1), noise=ce.Noise(omega=0.1, gain=np.ones((3, 1))), progress=False
        )


@pytest.mark.parametrize("given", [np.array([1, 2]), np.array(["exact", "euler"]), 3.5, ["square"]])
def test_options_of_another_kind(run_up, given):
    words = {
        "interval": "the shooting interval is not acceptable",
        "loss": "the loss is not known",
        "ties": "unknown treatment of ties",
        "method": "the method is not known",
    }
    for option, words_of_it in words.items():
        with pytest.raises(ce.CasadiEngineError, match=words_of_it):
            fit(run_up, **{option: given})


@pytest.mark.parametrize("name", ["max_iterations", "starts"])
def test_counts_beyond_the_solver(run_up, refused, name):
    with refused(E, f"{name} is not acceptable", allowed="a whole number >= 1 and < 2**31"):
        fit(run_up, **{name: 2**31})


def test_numbers_beyond_floating_point(run_up):
    with pytest.raises(E, match="the tolerance is not acceptable"):
        fit(run_up, tolerance=10**400)
    with pytest.raises(E, match="the shooting interval is not acceptable"):
        fit(run_up, interval=10**400)
    assert fit(run_up, seed=10**400).converged


@pytest.mark.parametrize("model", [None, "two_mass", ce.one_inertia])
def test_what_is_no_model(run_up, refused, model):
    with refused(E, "there is no model to fit", allowed="a Model", cure="give estimate(model, data)"):
        ce.estimate(model, run_up(), progress=False)


def test_too_few_samples_for_the_parameters_and_their_noise(run_up, refused):
    with refused(
        E,
        "there are too few samples to estimate the parameters and the noise level",
        seen="3 that count, for 3 unknown parameters and initial states",
        allowed="more than 3 samples, or a known noise level",
        cure="give ce.Noise(output=sigma)",
    ):
        ce.estimate(ce.one_inertia(), run_up(n=3), progress=False)
    one_more = {"noise": ce.Noise(omega=0.05)}, {"initial": {"omega_eng": 20.0}}
    for options in one_more:
        ce.estimate(ce.one_inertia(), run_up(n=3), progress=False, **options)
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(prior=(0.4, 0.1))
    ce.estimate(ce.one_inertia(), run_up(n=3), parameters=pars, progress=False)
    pars.fix("J_eng")
    ce.estimate(ce.one_inertia(), run_up(n=3), parameters=pars, progress=False)


def test_a_record_of_two_samples_still_simulates(run_up):
    assert len(ce.simulate(ce.one_inertia(), run_up(n=2))["omega"]) == 2
