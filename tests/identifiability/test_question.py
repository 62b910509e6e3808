"""What may be asked: words for drives, starts, outputs and experiments, and the message for each that cannot be."""

from __future__ import annotations

from fractions import Fraction

import pytest

import casadi_engine as ce
from casadi_engine.errors import ExpressionError, IdentifiabilityError
from casadi_engine.identifiability import identifiability
from casadi_engine.identifiability.question import read_question
from casadi_engine.identifiability.settings import INPUT_CLASSES, read_class


@pytest.fixture(scope="module")
def model():
    return ce.two_mass(reciprocating_speed="measured")


@pytest.mark.parametrize("word", INPUT_CLASSES)
def test_every_class_of_drives_is_read_and_printed(word):
    assert str(read_class(word)).startswith(word)
    assert read_class(word.replace(" ", "_")) == read_class(word)


def test_degrees_of_polynomials():
    assert read_class("unknown polynomial").degree == 2
    assert read_class("unknown polynomial 4") == read_class(("unknown polynomial", 4))
    assert read_class("unknown constant").degree == 0
    assert read_class("unknown").degree is None


@pytest.mark.parametrize("word", ["rich", "", 3, None, "unknown polynomial 51", "constant 2", ("zero", 1)])
def test_any_other_class_is_refused(word):
    with pytest.raises(IdentifiabilityError, match="the class of a drive is not known") as caught:
        read_class(word)
    assert "generic, constant, zero" in str(caught.value)


def test_unnamed_drives_take_the_class_of_the_star(model):
    (setting,) = read_question(model, inputs={"T_load": "unknown", "*": "zero"}).settings
    assert {name: str(one) for name, one in setting.inputs.items()} == {
        "T_1": "zero", "T_2": "zero", "T_3": "zero", "T_4": "zero", "T_load": "unknown arbitrary",
    }  # fmt: skip
    assert setting.unknown == ("T_load",)
    assert setting.arbitrary


def test_starts_by_state(model):
    start = {"twist": 0.25, "omega_eng": "known", "*": "free"}
    (setting,) = read_question(model, start=start).settings
    assert setting.start["twist"].number == Fraction(1, 4)
    assert setting.free_states == ("omega_load",)
    assert setting.special


def test_a_start_may_be_an_expression_of_parameters():
    """An initial state that is a parameter counts once, and ties the two."""
    b = ce.Blueprint("decay")
    rate, gain = b.parameter("rate", 1.0), b.parameter("gain", 1.0)
    b.parameter("amount", 1.0)
    x = b.state("x")
    b.ode("x", -rate * x)
    b.output("y", gain * x)
    found = identifiability(b.model(), start={"x": "amount"}, combinations=["gain*amount"])
    assert set(found.lost) == {"amount", "gain"}
    assert found.combinations["gain*amount"]
    assert identifiability(b.model(), start={"x": "2*amount/gain"}).lost == ("gain",)


@pytest.mark.parametrize(
    ("words", "problem", "named"),
    [
        ({"inputs": {"T_5": "zero"}}, "the model has no such drive", "'T_5'"),
        ({"start": "asleep"}, "the start is not acceptable", "'asleep'"),
        ({"start": 0.0}, "the start is not acceptable", "0.0"),
        ({"start": {"angle": 0}}, "the model has no such state", "'angle'"),
        ({"start": {"twist": float("nan")}}, "the start is not acceptable", "nan"),
        ({"start": {"twist": True}}, "the start is not acceptable", "True"),
        ({"outputs": ["torque"]}, "the model has no such output or state", "'torque'"),
        ({"outputs": "omega"}, "the outputs are not acceptable", "'omega'"),
        ({"outputs": []}, "the outputs are not acceptable", "[]"),
        ({"experiments": []}, "the experiments are not acceptable", "[]"),
        ({"experiments": {"inputs": "zero"}}, "the experiments are not acceptable", "inputs"),
        ({"experiments": [{"input": "zero"}]}, "an experiment has no such setting", "'input'"),
        ({"experiments": [{"name": "a"}, {"name": "a"}]}, "two experiments have one name", "a, a"),
        ({"combinations": [3]}, "a combination is not text", "3"),
        ({"seeds": 0}, "the number of seeds is not acceptable", "0"),
        ({"seeds": True}, "the number of seeds is not acceptable", "True"),
        ({"seed": "a"}, "the first seed is not acceptable", "'a'"),
        ({"seed": -1}, "the first seed is not acceptable", "-1"),
        ({"seed": None}, "the first seed is not acceptable", "None"),
        ({"outputs": 3}, "the outputs are not acceptable", "3"),
        ({"experiments": 3}, "the experiments are not acceptable", "3"),
        ({"experiments": [{"name": 3}]}, "the name of an experiment is not text", "3"),
        ({"experiments": [{"name": ["a"]}]}, "the name of an experiment is not text", "['a']"),
        ({"combinations": 3}, "a combination is not text", "3"),
        ({"combinations": None}, "a combination is not text", "None"),
        ({"parameters": 3}, "the parameters are not a parameter set", "int"),
    ],
)
def test_what_cannot_be_asked_is_named(model, words, problem, named):
    with pytest.raises(IdentifiabilityError) as caught:
        identifiability(model, **words)
    assert problem in str(caught.value)
    assert named in str(caught.value)
    assert caught.value.allowed


def test_other_messages(model):
    with pytest.raises(IdentifiabilityError, match="the test needs a model"):
        identifiability("two_mass")
    with pytest.raises(ExpressionError, match="unknown name J9"):
        identifiability(model, combinations=["K_el*J9"])
    with pytest.raises(ExpressionError, match="unknown name omega0"):
        identifiability(model, start={"twist": "omega0"})


def test_a_start_at_a_pole_is_named_with_its_cure():
    b = ce.Blueprint("tank")
    c, h = b.parameter("c", 1.0), b.state("h")
    b.ode("h", -c / h)
    b.output("h", h)
    with pytest.raises(IdentifiabilityError, match="no power series at the start") as caught:
        identifiability(b.model(), start="rest")
    assert "division by zero" in str(caught.value)
    assert 'start="free"' in str(caught.value)


def test_a_drive_with_a_free_parameter_in_it_is_written_in_channels():
    b = ce.Blueprint("gain")
    gain, J = b.parameter("gain", 1.0), b.parameter("J", 1.0)
    u = b.input("u")
    drive = b.drive("T", gain * u)
    v = b.state("v")
    b.ode("v", drive / J)
    b.output("v", v)
    with pytest.raises(IdentifiabilityError, match="the drive T has a free parameter in it") as caught:
        identifiability(b.model(), inputs={"T": "zero"})
    assert "the channels u" in str(caught.value)
    found = identifiability(b.model(), inputs={"u": "generic"}, combinations=["gain/J"])
    assert found.lost == ("gain", "J")
    assert found.combinations["gain/J"]


def test_ties_and_fixed_parameters_are_put_in(model):
    parameters = model.parameters()
    parameters.tie("J_load", "J_eng/2")
    assert identifiability(model, parameters=parameters, inputs="constant").passed
    assert not identifiability(model, inputs="constant").passed
    free = identifiability(model, inputs="zero", combinations=["K_el/J_load"])
    parameters = model.parameters()
    parameters.fix("K_el")
    fixed = identifiability(model, parameters=parameters, inputs="zero")
    assert fixed.size == free.size - 1
    assert fixed.rank == free.rank


def test_what_varies_by_experiment_counts_in_each(model):
    parameters = model.parameters()
    parameters.vary_by_experiment("C_eng")
    found = identifiability(model, parameters=parameters, experiments=[{"name": "cold"}, {"name": "warm"}])
    assert {"C_eng@cold", "C_eng@warm"} <= set(found.free)
    assert found.size == 6 + 2 * 3
    assert found.passed


def test_the_answer_as_text_html_and_data(model):
    found = identifiability(model, inputs="zero", combinations=["K_el/J_eng"])
    text = str(found)
    assert len(text.splitlines()) <= 45
    assert max(map(len, text.splitlines())) <= 100
    assert "chance of an error" in text
    data = found.to_dict()
    assert data["lost"] == list(found.lost)
    assert data["settings"][0]["inputs"]["T_1"] == "zero"
    assert "<table>" in found._repr_html_()


def test_an_unknown_drive_of_a_form_leaves_more_than_an_arbitrary_one(model):
    words = [
        "generic",
        "unknown constant",
        "unknown polynomial 1",
        "unknown polynomial 5",
        "unknown arbitrary",
    ]
    told = [identifiability(model, inputs={"T_load": word}).directions for word in words]
    assert told == sorted(told, reverse=True)
    assert (told[0], told[-1]) == (5, 0)


@pytest.mark.parametrize("degree", [0, 1, 4])
def test_decay_under_an_unknown_polynomial(degree):
    """x' = -c x + g d(t): exp(-ct) is no polynomial, so c is told; the scale g of an unknown drive never is."""
    b = ce.Blueprint("decay")
    c, g, x, d = b.parameter("c", 1.0), b.parameter("g", 1.0), b.state("x"), b.input("d")
    b.ode("x", -c * x + g * d)
    b.output("x", x)
    found = identifiability(b.model(), inputs=("unknown polynomial", degree))
    assert found.lost == ("g",)
    assert identifiability(b.model(), inputs="unknown arbitrary").lost == ("c", "g")


def test_the_geometry_of_the_crank_is_known_up_to_a_scale_of_length():
    """Torque = pressure × area × radius: lengths times s, area over s, mass over s² leave no trace."""
    model = ce.two_mass(reciprocating_speed="model")
    parameters = model.parameters()
    parameters.free("r", "L", "A_p", "m_eq", "p_crank")
    found = identifiability(model, parameters=parameters, combinations=["r/L", "r*A_p", "m_eq*r**2"])
    (symmetry,) = found.symmetries
    assert dict(symmetry.exponents) == {"r": 1, "L": 1, "A_p": -1, "m_eq": -2}
    assert all(found.combinations.values())
    parameters.fix("r")
    assert identifiability(model, parameters=parameters).passed
