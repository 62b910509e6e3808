"""A validation on one screen: how well the fit explains each record, and whether its residuals are white."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from casadi_engine.estimation.summary import (
    COLUMNS,
    LINES,
    aligned,
    limited,
    number,
    short,
    with_error,
    wrapped,
)
from casadi_engine.validation.residual_tests import ResidualTest

if TYPE_CHECKING:
    from casadi_engine.validation.parameter_check import ParameterCheck
    from casadi_engine.validation.validate import Validation

# Rows of outputs, and of reasons why a test could not be made, at most.
OUTPUTS, REASONS = 16, 4
# Parameters of which it is said where fresh data move them.
MOVED = 3


def summary(validation: Validation) -> str:
    """Return a validation as text of at most 45 lines and 100 columns, the verdict first.

    Errors stand in the unit of the output; p-values are those of the tests of `residual_tests`.
    """
    model = validation.fit.model.name
    lines = limited(wrapped(f"Validation of {model} on {', '.join(validation.records)}", "  "), 2)
    lines += [*limited(wrapped(verdict(validation), "  "), 3), ""]
    rows = output_rows(validation)
    lines += aligned([MEASURES, *(row[: len(MEASURES)] for row in rows[:OUTPUTS])], right=range(2, 9))
    if len(rows) > OUTPUTS:
        lines.append(f"  … and {len(rows) - OUTPUTS} more: validation.records")
    lines += ["", *_drives(validation)]
    for line in parameter_words(validation):
        lines += limited(wrapped(line, "    "), 4)
    reasons = list(dict.fromkeys(untested(validation)))
    for reason in reasons[:REASONS]:
        lines += limited(wrapped(f"  not tested: {reason}", "    "), 2)
    step = f"Next: {next_step(validation)}"
    return "\n".join([short(line, COLUMNS) for line in lines[: LINES - 2]] + ["", step])


MEASURES = ("record", "output", "unit", "fit % sim.", "fit % 1-step", "rmse", "S1", "S2", "whiteness p")


def output_rows(validation: Validation) -> list[tuple[str, ...]]:
    """Record, output, unit, fit % in simulation and one step ahead, rmse, S1, S2 and whiteness p as text."""
    units = {variable.name: variable.unit for variable in validation.fit.model.outputs}
    return [
        (
            short(record, 24),
            output,
            units.get(output, ""),
            number(check.fit_percent.get("simulation"), ".2f"),
            number(check.fit_percent.get("prediction"), ".2f"),
            number(check.rmse, ".3g"),
            number(check.S1, ".3g"),
            number(check.S2, ".3g"),
            p_text(check.whiteness),
        )
        for record, outputs in validation.records.items()
        for output, check in outputs.items()
    ]


def p_text(test: ResidualTest | ParameterCheck) -> str:
    """Write a p-value, or a dash where there is no test.

    >>> p_text(ResidualTest(30.0, 25, 0.2236, 1000)), p_text(ResidualTest(3e3, 25, 1e-300, 1000))
    ('0.22', '< 1e-16')
    """
    if test.p_value is None:
        return "-"
    if test.p_value < 1e-16:
        return "< 1e-16"
    return f"{test.p_value:.2g}"


def cross_rows(validation: Validation) -> list[tuple[str, str, str, str]]:
    """Record, output, drive and the p-value of the test against that drive."""
    return [
        (record, output, drive, p_text(test))
        for record, outputs in validation.records.items()
        for output, check in outputs.items()
        for drive, test in check.cross.items()
    ]


def all_tests(validation: Validation) -> dict[str, Any]:
    """Every test by the name that ``failed`` uses."""
    from casadi_engine.validation.validate import tests_of

    found: dict[str, Any] = {}
    for record, outputs in validation.records.items():
        for output, check in outputs.items():
            found |= tests_of(record, output, check)
    if validation.parameters is not None:
        found["parameters"] = validation.parameters
        if validation.parameters.limits is not None:
            found["bounds"] = validation.parameters.limits
    return found


def verdict(validation: Validation) -> str:
    """The verdict in one sentence, with the false-alarm rate it was made at."""
    tests = all_tests(validation)
    made = sum(test.p_value is not None for test in tests.values())
    kind = "residual tests" if validation.parameters is None else "tests"
    level = f"{made} {kind} at alpha = {validation.alpha:g}"
    if not made:
        return "NOT TESTED: no test could be made with these data"
    if validation.passed:
        return f"PASSED: nothing is left in the residuals that these tests can see ({level})"
    failed = validation.failed
    if not failed:
        return f"NOT TESTED: {made} {kind} saw nothing beside {validation.blind} (see note)"
    which = f": {'; '.join(failed[:2])}" + (f" and {len(failed) - 2} more" if len(failed) > 2 else "")
    return f"FAILED: {len(failed)} of {level}{which}"


def parameter_words(validation: Validation) -> list[str]:
    """Whether fresh data agree with the parameters of the fit, what these explain of the gap, and the notes."""
    check, said = validation.parameters, []
    if check is not None:
        if check.p_value is not None:
            word = "parameters disagree" if "parameters" in validation.failed else "parameters agree"
            if word == "parameters agree" and check.p_value < validation.alpha:
                word = "parameters may disagree"  # it is one of several tests, which share alpha
            said.append(
                f"{word} with those of the fit within their errors: p {p_text(check)} "
                f"(chi2 {check.statistic:.3g} in {check.dof} direction{'s' if check.dof != 1 else ''})"
            )
        said += [_gap_words(check, "parameters" in validation.failed)] if check.chi2 is not None else []
        said += _moved_words(check)
    return [*said, *(f"Note: {note}" for note in validation.notes)]


def _gap_words(check: ParameterCheck, beyond: bool) -> str:
    """beyond : the parameters would have to move farther than their errors allow"""
    before, after = check.chi2 or (math.nan, math.nan)
    if check.explained is None:
        return f"no gap beyond the noise of the fit: chi2/N {before:.3g}"
    share = f"{100 * check.explained:.3g} %"
    if beyond:
        return (
            f"the errors of the parameters do not explain the gap to the simulation: parameters moved beyond them take "
            f"{share} of it, chi2/N from {before:.3g} to {after:.3g}"
        )
    return (
        f"of the gap to the simulation, {share} is explained by the errors of the parameters: chi2/N {before:.3g}, "
        f"within these errors {after:.3g}"
    )


def _moved_words(check: ParameterCheck) -> list[str]:
    """The parameters that fresh data move by more than a standard error, the farthest ones."""
    far = {
        name: abs(one.fresh - one.fitted[0]) / one.fitted[1]
        for name, one in (check.moved or {}).items()
        if one.fitted[1]
    }
    names = [name for name in sorted(far, key=lambda name: -far[name]) if far[name] > 1.0][:MOVED]
    if not names or check.explained is None:
        return []
    moved = check.moved or {}
    words = [
        f"{name} {with_error(*moved[name].fitted)} to {moved[name].fresh:.4g} {moved[name].unit}"
        for name in names
    ]
    return [f"these data, beside the fit, move {'; '.join(words)}"]


def untested(validation: Validation) -> list[str]:
    """Why tests could not be made, one sentence each."""
    return [
        f"{name}: {test.why}"
        for name, test in all_tests(validation).items()
        if test.p_value is None and test.why
    ]


def next_step(validation: Validation) -> str:
    """What to type next."""
    if all(test.p_value is None for test in all_tests(validation).values()):
        return "give a longer record: ce.validate(fit, longer)"
    if "initial states" in validation.blind:
        return "look at the record from a start of your own: ce.simulate(fit, record, initial={state: value, ...})"
    if validation.blind:
        whose = "of the fit " if "decide the fit" in validation.blind else ""
        return f"look at the data {whose}first, as noted above, and test again"
    if validation.passed:
        return 'keep it: ce.report(validation, "report.html")'
    if validation.failed == ("parameters",):
        return "fit old and fresh data together, ce.estimate(model, [old, fresh]): does one set suit both?"
    if validation.failed and all(name.endswith("/size") for name in validation.failed):
        return (
            "look whether the sensors were noisier there, as what is left is white: noise=ce.Noise(...) states their "
            "level, and tests again"
        )
    return "look at the residual: ce.plot(validation); it says what the model lacks"


def _drives(validation: Validation) -> list[str]:
    """One row for each output: the p-value of the test against each drive, as many as fit."""
    rows = []
    for record, outputs in validation.records.items():
        for output, check in outputs.items():
            words = ", ".join(f"{drive} {p_text(test)}" for drive, test in check.cross.items())
            rows.append((short(record, 24), output, words))
    if not any(words for _, _, words in rows):
        return ["  no drives to test the residual against"]
    return ["p of the residual against each drive", *aligned(rows[:OUTPUTS], right=())]
