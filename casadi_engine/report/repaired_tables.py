"""Tables of a repair for its page: the gap, whiteness, parameters before and after, a class."""

from __future__ import annotations

from casadi_engine.discrepancy.repaired import FoundEffect, Repair, Side
from casadi_engine.discrepancy.summary import chi2_words, levels, noise_of_chi2
from casadi_engine.discrepancy.wording import in_unit
from casadi_engine.estimation.summary import number, with_error
from casadi_engine.experiment.units import unit_words
from casadi_engine.report.tables import table


def class_table(effect: FoundEffect) -> str:
    """The effects that are not excluded in the place of one."""
    rows = [(one.label, f"{one.rho:+.3f}", f"{100 * one.probability:.3g} %") for one in effect.members]
    caption = f"The class of {effect.key}: these data do not exclude any of them"
    return table(("effect", "correlation", "probability, equal before"), rows, right=(1, 2), caption=caption)


def gap_table(result: Repair) -> str:
    """The gap beside the noise, before and after."""
    gaps = result.gaps
    assert gaps is not None
    units, sigma = {variable.name: variable.unit for variable in result.model.outputs}, levels(result)
    rows = []
    for words, before, after in (
        ("search", gaps.estimation_before, gaps.estimation_after),
        ("fresh", gaps.validation_before, gaps.validation_after),
    ):
        if before is None or after is None:
            continue
        for output, old in before.gap.rmse.items():
            rows.append(
                (
                    words, output, units.get(output, "1"), number(sigma.get(output), ".4g"), f"{old:.4g}",
                    f"{after.gap.rmse[output]:.4g}",
                    f"{before.gap.fit_percent[output]:.2f}", f"{after.gap.fit_percent[output]:.2f}",
                    *(chi2_words(side.gap.chi2_per_sample, result) for side in (before, after)),
                )
            )  # fmt: skip
    header = (
        "data", "output", "unit", "sigma", "rms before", "rms after", "fit % before", "fit % after",
        "χ²/N before", "χ²/N after",
    )  # fmt: skip
    noise = noise_of_chi2(result).replace("chi2/N", "χ²/N", 1)
    caption = "The gap in simulation; χ²/N of 1 is noise alone" + (f". {noise}" if noise else "")
    return table(header, rows, right=range(3, 10), caption=caption)


_WHITENESS = "Whiteness of the residuals; on fresh data, of what errors of the parameters do not explain"


def whiteness_table(result: Repair) -> str:
    """Whiteness before and after."""
    gaps = result.gaps
    assert gaps is not None
    rows = []
    for before, after in (
        (gaps.estimation_before, gaps.estimation_after),
        (gaps.validation_before, gaps.validation_after),
    ):
        if before is not None and after is not None:
            rows += _test_rows(before, after)
    header = ("record", "output", "p before", "p after")
    return table(header, rows, right=(2, 3), caption=_WHITENESS)


def _test_rows(before: Side, after: Side) -> list[tuple[str, str, str, str]]:
    return [
        (record, output, p_text(p), p_text(after.whiteness_p[record][output]))
        for record, outputs in before.whiteness_p.items()
        for output, p in outputs.items()
    ]


def parameter_table(result: Repair) -> str:
    """Parameters before and after."""
    rows, kept = [], []
    for name, new in result.fit.estimates.items():
        old = result.null_fit.estimates.get(name)
        if new.fixed:
            kept.append(f"{name} = {number(new.value)}{in_unit(new.unit)}")
            continue
        after = with_error(new.value, None if new.at_bound else new.stderr)
        rows.append(
            (
                name,
                "-" if old is None else with_error(old.value, None if old.at_bound else old.stderr),
                f"{after}, at its {new.at_bound} bound" if new.at_bound else after,
                unit_words(new.unit),
                "" if old is None else f"{new.value - old.value:+.3g}",
            )
        )
    header = ("parameter", "before ± standard error", "after ± standard error", "unit", "change")
    caption = "Parameters"
    caption += f". Fixed: {', '.join(kept)}" if kept else ""
    return table(header, rows, right=(4,), caption=caption)


def p_text(value: float | None) -> str:
    """A p-value."""
    if value is None:
        return "-"
    return "< 1e-16" if value < 1e-16 else f"{value:.2g}"
