"""The texts that Fit and Validation print."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.estimation.fit import Direction, Estimate, Optimum
from casadi_engine.estimation.summary import count, next_steps, number, percent, summary, with_error
from casadi_engine.report import fit_html, fit_text, validation_html, validation_text

GOLDEN = """\
Fit of two_mass: converged
  records   misfire_1200rpm, 0.6 s long, outputs every 0.0005 s (assumed, not measured: p3, p4)
  samples   1 170 that count, in 60 shooting intervals
  solved    12 iterations, 0.06 s (setup 0.021, solve 0.034, covariance 0.005)
  integrated exactly (a linear model on equal steps)
  noise     omega sigma 0.1001 rad/s (estimated)
  cost      1168.25   chi2/N 0.9985 (near 1 by construction: sigma is estimated)   dof 1164
  fit %            output  simulation  one-step prediction
  misfire_1200rpm  omega        95.12                    -
Parameters
  J_eng    0.39108 ± 0.00042  kg m2      (0.11 %)  (start 0.2346)
  J_load   0.1771 ± 0.0021    kg m2      (1.2 %)   (start 0.1063)
  K_el     1992 ± 12          N m/rad    (0.6 %)   (start 1195)
  C_el     0                  N m s/rad  at its lower bound: no symmetric error  (start 1.5)
  C_eng    0.15410 ± 0.00031  N m s/rad  (0.2 %)   (start 0.09246)  prior 0.15 ± 0.01
  r        0.043              m                    (fixed)
  L        0.145              m                    (fixed)
  A_p      0.0058             m2                   (fixed)
  m_eq     0.7                kg                   (fixed)
  p_crank  100000             Pa                   (fixed)
  C_half   0.07705 ± 0.00015  N m s/rad  (0.2 %)   == C_eng/2
Initial states
  misfire_1200rpm: omega_eng 125.012 ± 0.021 rad/s, omega_load 124.98 rad/s (no error: not
    determined), twist -0.0286 rad (fixed)
Correlations: J_eng ~ K_el -0.930, J_load ~ K_el +0.610
Next: C_el rests on its bound: widen it, pars["C_el"].set(min=...), or fix it"""


def test_a_fit_prints_as_written_here(fit):
    assert fit_text(fit) == GOLDEN
    assert str(fit) == GOLDEN


def test_no_error_is_printed_that_is_doubted(factory):
    rows = {
        line.split()[0]: line
        for line in fit_text(factory.doubted(factory.fit())).splitlines()
        if line.strip()
    }
    assert "±" in rows["J_eng"]
    assert "±" not in rows["J_load"] + rows["K_el"]
    assert "95 %: 0.120 to 0.270" in rows["J_load"]
    assert "no error: not known (see note)" in rows["K_el"]
    assert "the errors that the data do tell: print(ce.posterior(fit))" in next_steps(
        factory.doubted(factory.fit())
    )


def test_what_a_predictor_of_doubted_errors_asks_for(factory):
    """A posterior was named that is refused for every fit with a predictor; and a level of noise at 0 was to be
    widened."""
    fit = factory.doubted(factory.fit())
    for kind, named in (("innovations", True), ("process", False)):
        said = " ".join(next_steps(replace(fit, innovations=SimpleNamespace(kind=kind, radius=0.9))))
        assert "ce.posterior" not in said
        assert ("estimate the process noise instead of its gain" in said) is named
    estimates = {**fit.estimates, "process.omega": Estimate(0.0, None, "rad/s", at_bound="min")}
    quiet = replace(fit, estimates=estimates, free=(*fit.free, "process.omega"))
    said = " ".join(next_steps(quiet))
    assert "these data show no process noise of omega: leave it out of process=" in said
    assert "process.omega rests on its bound" not in said


def test_a_posterior_is_not_named_without_the_bounds_that_it_asks_for(factory):
    fit = factory.doubted(factory.fit())
    pars = fit.parameters.copy()
    pars["J_load"].set(max=math.inf)
    said = next_steps(replace(fit, parameters=pars))
    assert any(
        words.startswith("give J_load bounds on both sides") and words.endswith("print(ce.posterior(fit))")
        for words in said
    )
    pars["J_load"].set(prior=(0.18, 0.05))
    assert not any("bounds on both sides" in words for words in next_steps(replace(fit, parameters=pars)))


@pytest.mark.parametrize("records", [1, 3, 40])
@pytest.mark.parametrize("extra", [0, 60])
def test_one_screen_whatever_is_in_it(factory, records, extra):
    fit = factory.fit(
        records=tuple(f"a_rather_long_record_name_for_one_file_{k}_of_many" for k in range(records)),
        samples=50,
        undetermined=(factory.direction,) * 7,
        optima=tuple(Optimum(1e3 + k, {}, 2, "converged") for k in range(9)),
        messages=("a message that is quite long and goes on " * 9,) * 4,
        status="not converged: Maximum_Iterations_Exceeded " * 12,
    )
    many = {f"port.effect.parameter_{k}": Estimate(1.0, 0.1, "N m s/rad") for k in range(extra)}
    lines = summary(factory.fit(**vars(fit) | {"estimates": {**fit.estimates, **many}})).splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert any(line.startswith("Next: ") for line in lines)


def test_many_parameters_move_the_fixed_ones_into_one_sentence(factory):
    fit = factory.fit()
    many = {f"K{k}": Estimate(1.0, 0.1, "N m/rad") for k in range(30)}
    text = summary(factory.fit(estimates={**fit.estimates, **many}))
    assert "  fixed: r 0.043 m, L 0.145 m" in text
    assert "more: fit.estimates" in text


def test_simulation_and_prediction_are_told_apart(factory):
    text = summary(factory.fit(predicted=True))
    header, row = [line for line in text.splitlines() if "one-step" in line or "95.12" in line]
    assert header.split("  ")[-1] == "one-step prediction"
    assert row.split() == ["misfire_1200rpm", "omega", "95.12", "96.20"]


def test_known_noise_makes_chi2_a_test(factory):
    text = summary(factory.fit(noise={"omega": (0.1, False)}))
    assert "omega sigma 0.1 rad/s (known)" in text
    assert "by construction" not in text


def test_undetermined_directions_come_with_a_cure(factory):
    text = summary(factory.fit(undetermined=(factory.direction,)))
    assert "Not determined by these data:\n  J_eng and K_el together, with nearly constant ratio" in text
    assert 'fix one of them or give it a prior: pars.fix("K_el")' in text


@pytest.mark.parametrize(
    ("changes", "step"),
    [
        ({"status": "interrupted"}, "go on from here: ce.estimate(model, data, warm=fit)"),
        (
            {"status": "not converged: Infeasible"},
            'try other starts: ce.estimate(model, data, approach="prediction"), starts=8',
        ),
        ({"undetermined": (Direction("twist", {"twist": 1.0}),)}, 'initial={"twist": ...}'),
        ({"undetermined": (Direction("x", {"x": 1.0}),)}, "add an experiment that excites it"),
        ({}, 'pars["C_el"].set(min=...)'),
    ],
)
def test_next_steps(factory, changes, step):
    assert step in next_steps(factory.fit(**changes))[0]


@pytest.mark.parametrize(
    ("share", "approach", "white", "said"),
    [(51.0, "direct", False, True), (51.0, "prediction", False, True), (51.0, "direct", True, False),
     (80.0, "direct", False, False), (-3.0, "direct", False, True)],
)  # fmt: skip
def test_a_simulation_that_does_not_follow_the_data_asks_for_another_optimum(
    factory, share, approach, white, said
):
    fit = factory.fit(
        fit_percent={"run": {"omega": {"simulation": share, "prediction": None}}},
        options={"approach": approach},
        messages=() if white else ("the residual of run/omega is not white (neighbours correlate by 0.99)",),
    )
    first = next_steps(fit)[0]
    assert first.startswith("the simulation follows") == said
    assert not said or f"follows {max(share, 0):.0f} % of run/omega" in first
    how = 'approach="prediction"' if approach == "direct" else "starts=20"
    assert not said or first.endswith(f"ce.estimate(model, data, {how})")


def test_next_step_of_a_sound_fit(factory):
    estimates = {"J_eng": Estimate(0.39, 0.01, "kg m2")}
    fit = factory.fit(estimates=estimates)
    assert next_steps(fit) == ["test it on data it has not seen: print(ce.validate(fit, fresh))"]
    rare = (Optimum(1168.25, {}, 1, "converged"), Optimum(1300.0, {}, 7, "converged"))
    assert next_steps(factory.fit(estimates=estimates, optima=rare)) == [
        "only one search found the lowest cost: repeat with starts=32"
    ]
    lower = (Optimum(900.0, {}, 3, "not converged"), Optimum(1168.25, {}, 7, "converged"))
    steps = next_steps(factory.fit(estimates=estimates, optima=lower))
    assert steps[0].startswith(
        "a search that did not converge came lower than this optimum: look at fit.optima"
    )


def test_optima_are_counted(factory):
    optima = (Optimum(1300.0, {}, 3, "converged"), Optimum(1168.25, {}, 5, "converged"))
    text = summary(factory.fit(optima=optima))
    assert "Optima: 5 of 8 searches reached the lowest cost 1168.25; 3 ended at 1300" in text


def test_no_free_parameter_and_no_numbers(factory):
    fit = factory.fit(free=(), z=np.zeros(0), covariance=np.zeros((0, 0)), cost=float("nan"), n=0, noise={})
    text = summary(fit)
    assert "Correlations" not in text
    assert "cost      -   chi2/N -" in text


def test_weak_correlations_are_said_to_be_weak(factory):
    assert "Correlations: all below 0.5 in size" in summary(factory.fit(covariance=np.eye(5)))


def test_per_experiment_parameters_keep_their_names(factory):
    fit = factory.fit()
    estimates = {**fit.estimates, "C_eng@a": Estimate(0.15, None, "N m s/rad", why="the data leave it open")}
    text = summary(factory.fit(estimates=estimates))
    assert "C_eng@a" in text
    assert "no error: the data leave it open" in text


@pytest.mark.parametrize(
    ("value", "stderr", "text"),
    [
        (1.0, 0.0996, "1.00 ± 0.10"),
        (-12345.6, 78.9, "-12346 ± 79"),
        (1.5e-7, 2e-9, "1.500e-07 ± 2.0e-09"),
        (1.0, 0.0, "1 ± 0"),
        (1.0, float("nan"), "1"),
        (float("inf"), 1.0, "inf"),
        (3.0, 4000.0, "3 ± 4000"),
    ],
)
def test_errors_set_the_digits(value, stderr, text):
    assert with_error(value, stderr) == text


def test_small_words():
    assert percent(1.0, 99.0) == "(> 1000 %)"
    assert percent(0.0, 1.0) == ""
    assert number(None) == number(float("nan")) == "-"
    assert count(1234567) == "1 234 567"


def test_a_validation_says_passed_with_its_numbers(validation):
    text = validation_text(validation)
    assert text == str(validation)
    assert "PASSED: nothing is left in the residuals that these tests can see (2 residual tests" in text
    assert "misfire_1200rpm  omega   rad/s       95.56             -  0.098  0.39  0.098         0.71" in text
    assert "T_1 0.19, T_load -" in text
    assert "not tested: misfire_1200rpm/omega/T_load: the drive is constant" in text
    assert text.splitlines()[-1] == 'Next: keep it: ce.report(validation, "report.html")'


def test_a_validation_says_which_test_failed(factory):
    text = validation_text(factory.validation(white=False))
    assert "FAILED: 1 of 2 residual tests at alpha = 0.01: misfire_1200rpm/omega/whiteness" in text
    assert "< 1e-16" in text
    assert text.splitlines()[-1].startswith("Next: look at the residual: ce.plot(validation)")


def test_a_long_validation_stays_on_one_screen(factory):
    many = factory.fit(records=tuple(f"record_with_a_long_name_{k:03}" for k in range(30)), samples=200)
    lines = validation_text(factory.validation(many)).splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert lines[-1].startswith("Next: ")


def test_html_escapes_what_users_name(factory):
    page = fit_html(factory.fit(records=("<script>alert(1)</script>",), samples=50))
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert "0.39108 ± 0.00042" in page
    assert "PASSED" in validation_html(factory.validation())
