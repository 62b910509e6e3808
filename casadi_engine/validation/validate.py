"""validate: how well a fitted model explains data, and whether what is left is noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.distributions import p_words
from casadi_engine.errors import EstimationError, ExperimentError
from casadi_engine.estimation import Fit, Trace, estimate
from casadi_engine.estimation.faulty_samples import faults, wild_samples
from casadi_engine.estimation.fit_percent import fit_measures
from casadi_engine.estimation.loss import loss_of
from casadi_engine.estimation.varied_noise import sizes_of
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.twins import twin_of
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise
from casadi_engine.validation.correlation import Correlation, check_lags
from casadi_engine.validation.held import held_on, what_was_freed
from casadi_engine.validation.level_tests import mean_test, size_test
from casadi_engine.validation.parameter_check import ParameterCheck, Refit, noise_changed, refit
from casadi_engine.validation.projection import orthonormal
from casadi_engine.validation.residual_tests import ResidualTest, check_residual, rejected
from casadi_engine.validation.robust import pulled_in

Array = NDArray[np.float64]
# Output -> standard deviation of the noise, and from how many degrees of freedom it was found.
Levels = Mapping[str, tuple[float, float]]
# A test that a fit's own data are not asked for: it is zero on average there, and as large as it is.
# Lags that are tested, and samples of an output for each at least; samples from which on a plain pattern in them is
# beyond chance once in a hundred.
_LAGS, _OF_LAG, _LEAST = 25, 4, 15
# Beside what tests see nothing.
HERE = "single samples that are larger than all else"
IN_FIT = "single samples that decide the fit, whose noise level is theirs"
UNFOUND = "initial states that were not found"
NOT_FRESH = ResidualTest(None, None, None, 0, why="not fresh data")


@dataclass(frozen=True)
class OutputCheck:
    """One output of one record.

    fit_percent : {"simulation": %, "prediction": % or None}, (2.32); rmse, S1, S2 in the output's unit, (2.34), of the
    prediction where there is one, else of the simulation; whiteness, cross (by drive): the tests of the verdict;
    mean, size : on fresh data, whether the residual is off on average, and larger than the noise of the fit; elsewhere
    without a p-value; autocorrelation, cross_correlation (by drive) : with 99 % bands, for the eye
    """

    fit_percent: Mapping[str, float | None]
    rmse: float
    S1: float
    S2: float
    whiteness: ResidualTest
    cross: Mapping[str, ResidualTest]
    autocorrelation: Correlation
    cross_correlation: Mapping[str, Correlation]
    trace: Trace
    mean: ResidualTest = NOT_FRESH
    size: ResidualTest = NOT_FRESH


def tests_of(record: str, output: str, check: OutputCheck) -> dict[str, ResidualTest]:
    """The tests of one output by the names of the verdict."""
    own = {"whiteness": check.whiteness, "mean": check.mean, "size": check.size, **check.cross}
    return {f"{record}/{output}/{name}": test for name, test in own.items() if test is not NOT_FRESH}


@dataclass(frozen=True, eq=False)
class Validation:
    """The answer of ``validate``.

    records : record -> output -> OutputCheck
    passed : tests were made, none is rejected at ``alpha`` over all of them (Holm), and no single wild samples hide
    what they look for
    failed : the rejected ones as "record/output/whiteness", ".../mean", ".../size", "record/output/drive", "parameters"
    or "bounds"; fit : the parameters held and the initial states found on these data; parameters : whether fresh data
    agree with these within their errors, None for a fit's own data and for parameters that were given; notes : what the
    user should know; blind : beside what no test sees anything, "" where there is no such thing
    """

    records: Mapping[str, Mapping[str, OutputCheck]]
    passed: bool
    failed: tuple[str, ...]
    alpha: float
    fit: Fit
    parameters: ParameterCheck | None = None
    notes: tuple[str, ...] = ()
    blind: str = ""

    def __str__(self) -> str:
        from casadi_engine.validation.summary import summary

        return summary(self)


@one_blas_thread
def validate(
    fit: Fit | Model,
    data: Experiment | Sequence[Experiment] | None = None,
    *,
    parameters: Parameters | None = None,
    noise: Noise | None = None,
    alpha: float = 0.01,
    lags: int | None = None,
    known: Levels | None = None,
) -> Validation:
    """Test a fit on data: fit percentages (2.32), residual sizes (2.34), whiteness and independence of the drives.

    On fresh data percentages and sizes are those of the simulation with the fit's parameters. The tests count with the
    errors of these: whether the parameters that suit the fresh data agree with the fit's within both errors, and
    whether what no parameters explain is white, zero on average, no larger than the noise of the fit by half, and
    independent of the drives.

    fit : a Fit; or a model, with ``parameters`` and ``data``
    data : fresh experiments, on which only initial states are found, and parameters that vary by experiment where a
    record has another name than those of the fit; None tests the fit on its own data
    parameters : other values than the fit's; noise : other noise levels than the fit's
    alpha : false-alarm rate of the verdict over all tests together
    lags : of the tests; None for 25, or a quarter of an output's samples where these are fewer
    known : output -> (standard deviation, degrees of freedom) of the noise that what is left is held against, where a
    fit that holds the values of an earlier one is tested; found from ``fit`` where there are fresh ``data``

    Raises EstimationError if there are no data, ExperimentError for data that do not suit the model.

    >>> import numpy as np, casadi_engine as ce
    >>> rng = np.random.default_rng(1)
    >>> t = np.arange(400) * 0.01
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(400, 2.0), omega=4 * (1 - np.exp(-t / 0.8)) + 0.01 * rng.standard_normal(400))
    >>> check = ce.validate(ce.estimate(ce.one_inertia(), exp))
    >>> check.passed, round(check.records["run_up"]["omega"].rmse, 4)
    (True, 0.0091)
    """
    if not 0 < alpha < 1:
        raise ExperimentError(
            "alpha is not acceptable",
            seen=alpha,
            allowed="a number between 0 and 1",
            cure="give alpha=0.01, for instance, for one false alarm in a hundred",
        )
    held, loss, own, tested = _hold(fit, data, parameters, noise), loss_of(fit), fit, None
    if isinstance(fit, Fit) and loss.robust:
        own, tested = pulled_in(fit, loss), pulled_in(held, loss)
    tested = held if tested is None else tested
    again = refit(own, tested) if isinstance(own, Fit) and data is not None and parameters is None else None
    levels = (
        known if known is not None else _levels_of(own) if isinstance(own, Fit) and held is not fit else None
    )
    tests: dict[str, ResidualTest | ParameterCheck] = {}
    records: dict[str, dict[str, OutputCheck]] = {}
    for name, traces in held.traces.items():
        records[name] = {}
        for output, trace in traces.items():
            check = _check(tested, name, output, tested.traces[name][output], lags, again)
            if levels is not None:
                check = _with_level(check, (name, output), levels, again)
            records[name][output] = check if tested is held else _as_measured(check, trace)
            tests |= tests_of(name, output, check)
    if again is not None:
        tests["parameters"] = again.check
        if again.check.limits is not None:
            tests["bounds"] = again.check.limits
    failed = rejected(tests, alpha=alpha)
    notes = _notes(fit, held, again, alpha, failed) if isinstance(fit, Fit) else ()
    if held is fit and known is None:  # else the fit holds the values of an earlier one
        notes = ("these are the data of the fit itself: they tell nothing of fresh data", *notes)
    # beside a few samples that are larger than all else no test sees anything
    blind = "" if wild_samples(held, tails=True) is None else HERE
    if not blind and isinstance(fit, Fit) and wild_samples(fit, tails=True) is not None:
        blind = IN_FIT
    if held is not fit and not held.converged:
        failed, blind = (), UNFOUND
    passed = not failed and not blind and any(test.p_value is not None for test in tests.values())
    return Validation(
        records, passed, tuple(failed), alpha, held, None if again is None else again.check, notes, blind
    )


def _off_on_average(again: Refit, failed: Sequence[str], units: Mapping[str, str]) -> list[str]:
    """By how much outputs differ on average from what any parameters explain, where the mean is rejected."""
    said = []
    for (record, output), residual in again.residual.items():
        if f"{record}/{output}/mean" in failed:
            mean = float(residual.mean())
            said.append(
                f"{output} reads {abs(mean):.3g} {units.get(output, '')} {'more' if mean > 0 else 'less'} than the "
                f"model on average in {record}: an offset of its sensor, or something constant that the model lacks"
            )
    return said


def _held_otherwise(fit: Fit, held: Fit) -> list[str]:
    """Inputs that go on in another way between their samples than on the records of the fit, where those agree."""
    known = [{one.name: {r[one.name].hold for r in part if one.name in r} for one in fit.model.inputs}
             for part in (fit.data, held.data)]  # fmt: skip
    names = [name for name, own in known[0].items() if len(own) == 1 and known[1][name] - own]
    return [
        f'{name} is interpolated differently between its samples than in the fit: read these data with_hold({name}="'
        f'{next(iter(known[0][name]))}") where it is the same there'
        for name in names
    ]


def _is_coloured(words: str, key: str) -> bool:
    """True of what a fit says of the residual of the output of ``record/output``, in whatever record."""
    return words.startswith("the residual of ") and f"/{key.partition('/')[2]} is not white" in words


def _notes(fit: Fit, held: Fit, again: Refit | None, alpha: float, failed: Sequence[str]) -> tuple[str, ...]:
    """What the user should know beside the tests."""
    outputs = [out.name for out in fit.model.outputs]
    seen = [] if held is fit else [one.name for one in held.data if twin_of(one, fit.data, outputs)]
    said = [
        f"the parameters were found from the measurement of {name}: it tells nothing of fresh data"
        for name in seen
    ]
    if held is not fit and not held.converged:
        said.append(
            f"the initial states were not found on these data: {held.status}; the numbers are of that point"
        )
    if held is not fit:
        said += _held_otherwise(fit, held)
        said += [f"in the data of the fit: {words}" for words in faults(fit)]
    said += faults(held)
    if loss_of(fit).robust:
        said.append(
            "residuals beyond the knee of the Huber loss are clipped to it in these tests, as in the fit"
        )
    said += [
        f"the residual of {key} is not white, as that of the fit was not: a colour that the sensor has, or what the "
        "model lacks in both"
        for key in (name.removesuffix("/whiteness") for name in failed if name.endswith("/whiteness"))
        if held is not fit and any(_is_coloured(words, key) for words in fit.messages)
    ]
    if again is None:
        return tuple(said)
    said += _off_on_average(again, failed, {out.name: out.unit for out in fit.model.outputs})
    said += what_was_freed(fit, held)
    if again.check.at_bound:
        said.append(
            f"at a bound in the fit: {', '.join(again.check.at_bound)}; simulated with that value, while the tests "
            "count with errors to both sides of it"
        )
    if "bounds" in failed:
        said.append(f"fit and fresh data together go beyond {', '.join(again.check.beyond)}: it may be wrong")
    for output, (fresh, own) in again.levels.items():
        if own > 0 and (chance := noise_changed(fit, again, output)) < alpha:
            what = (
                "other noise, or something the model lacks that looks like noise"
                if fresh > own
                else "less noise"
            )
            said.append(
                f"what is left of {output} on these data is {fresh / own:.3g} times its noise in the fit "
                f"({p_words(chance)}): {what}"
            )
    return tuple(said)


def _hold(fit: Fit | Model, data: Any, parameters: Parameters | None, noise: Noise | None) -> Fit:
    """A Fit in which the parameters are held and the initial states found; the fit itself on its own data."""
    if isinstance(fit, Fit):
        if data is None and parameters is None and noise is None:
            return fit
        records = fit.data if data is None else data
        levels = noise or _noise_of(fit)
        method = str(fit.options.get("method", "exact"))
        if parameters is None:
            return held_on(fit, records, noise=levels, method=method, loss=loss_of(fit))
        model, source = fit.model, parameters
    else:
        if not isinstance(fit, Model):
            raise EstimationError(
                "there is nothing to validate",
                seen=type(fit).__name__,
                allowed="a Fit, or a Model with data and parameters",
                cure="give validate(fit, fresh); a stored result has numbers only: fit again, or use "
                "`casadi-engine validate PROBLEM.py --from RESULT`",
            )
        model, records, levels, method = fit, data, noise or Noise(), "exact"
        if records is None:
            raise EstimationError(
                "there are no data to validate on",
                seen="data=None with a model",
                allowed="an experiment or several",
                cure="give validate(model, data, parameters=...)",
            )
        source = model.parameters() if parameters is None else parameters
    return estimate(model, records, parameters=held_parameters(model, source), noise=levels, method=method,
                    progress=False)  # fmt: skip


def _noise_of(fit: Fit) -> Noise:
    """The noise of a fit, its gain held; with noise covariances the residual is the innovation."""
    estimated = {name: free for name, (_, free) in fit.noise.items()}
    if fit.innovations is not None and fit.innovations.kind == "process":
        estimated = dict.fromkeys(estimated, False)
    levels: dict[str, Any] = {
        name: "estimate" if estimated[name] else sigma for name, sigma in fit.residual_level.items()
    }
    return Noise(gain=fit.gain, **levels)


def held_parameters(model: Model, source: Parameters) -> Parameters:
    """The model's own parameters, all fixed at the values of ``source``; bounds widened where needed."""
    values, held = source.as_dict(), model.parameters()
    for name in held.names:
        value, parameter = values[name], held[name]
        parameter.set(value, min=min(parameter.min, value), max=max(parameter.max, value))
        held.fix(name)
    return held


def _levels_of(fit: Fit) -> Levels:
    """The noise of a fit, as ``validate`` takes it."""
    return {
        name: (sigma, max(fit.dof, 1.0) if fit.noise.get(name, (sigma, True))[1] else math.inf)
        for name, sigma in fit.residual_level.items()
    }


def _with_level(
    check: OutputCheck, place: tuple[str, str], levels: Levels, again: Refit | None
) -> OutputCheck:
    """The check of a fresh output with the tests of its mean and of its size; see ``level_tests``."""
    residual, mask, reach, fitted = check.trace.residual, check.trace.mask, 1.0, 0
    if again is not None and place in again.index:
        residual, mask, slopes = _within_errors(check.trace, place, again)
        reach, fitted = again.reach[place], slopes.shape[1]
    own = np.asarray(residual, dtype=float)[mask]
    check = replace(check, mean=mean_test(own, check.autocorrelation, reach))
    if place[1] not in levels:
        return check
    return replace(check, size=size_test(own, *levels[place[1]], check.autocorrelation, fitted))


def _within_errors(
    trace: Trace, place: tuple[str, str], again: Refit
) -> tuple[Array, NDArray[np.bool_], Array]:
    """The residual (N,) that no parameters explain, where there is one, and its slopes (N, p)."""
    index, count = again.index[place], len(trace.time)
    mask = np.zeros(count, dtype=bool)
    mask[index] = True
    residual, jacobian = np.full(count, np.nan), np.zeros((count, again.slopes[place].shape[1]))
    residual[index], jacobian[index] = again.residual[place], again.slopes[place]
    return residual, mask, jacobian


def _as_measured(check: OutputCheck, trace: Trace) -> OutputCheck:
    """The check of an output whose outliers were pulled in, with the sizes and the trace of what was measured."""
    model = trace.simulated if trace.predicted is None else trace.predicted
    sizes = fit_measures(trace.measured, model, mask=trace.mask)
    return replace(check, rmse=sizes.rmse, S1=sizes.S1, S2=sizes.S2, trace=trace)


def _before(time: Array, at: Array, values: Array) -> Array:
    """A held signal just before each time: what is set at a sample acts after it, and a controller makes it of the
    reading there, whose noise is no sign of a wrong model."""
    found: Array = values[np.maximum(np.searchsorted(at, time, side="left") - 1, 0)]
    return found


def _sizes(residual: Array, model: Array, mask: NDArray[np.bool_], jacobian: Array | None) -> Array | None:
    """(N,) how large the noise of each sample is, where it goes with what the output shows."""
    taken = None
    if jacobian is not None and jacobian.size:
        taken = np.square(orthonormal(jacobian[mask])).sum(axis=1)
    own = sizes_of(residual[mask], model[mask], taken)
    if own is None:
        return None
    size = np.ones(len(residual))
    size[mask] = own
    return size


def _acting(fit: Fit, record: str) -> dict[str, Array]:
    """The drives of a record by name; an input of which all acts behind what was recorded is what moves that."""
    model, found = fit.model, dict(fit.drives[record])
    inputs = {one.name for one in model.inputs}
    behind = {}
    for k, one in enumerate(model.drives):
        of = {symbol.name() for symbol in ca.symvar(ca.SX(model.drive_expressions[k]))} & inputs
        if len(of) == 1 and one.name not in inputs:
            behind[one.name] = of.pop()
    for drive, name in behind.items():
        if name in found and not np.ptp(found[name][1]) > 0:
            found[name] = found.pop(drive)
    return found


def _check(
    fit: Fit, record: str, output: str, trace: Trace, lags: int | None, again: Refit | None
) -> OutputCheck:
    model = trace.simulated if trace.predicted is None else trace.predicted
    sizes = fit_measures(trace.measured, model, mask=trace.mask)
    held = {c.name for one in fit.data if one.name == record for c in one.channels if c.hold == "zero"}
    late = dict(fit.model.late)  # all of such an input acts as another drive
    drives = {
        name: _before(trace.time, *values) if name in held else np.interp(trace.time, *values)
        for name, values in _acting(fit, record).items()
        if name not in late or np.ptp(values[1]) > 0
    }
    residual, mask, jacobian = trace.residual, trace.mask, None
    place = (record, output)
    if again is not None and place in again.index:
        residual, mask, jacobian = _within_errors(trace, place, again)
    few = None
    if lags is None:
        if (count := int(np.count_nonzero(mask))) < _LEAST:
            why = f"only {count} valid samples: whether they are white shows from {_LEAST} on"
            few = ResidualTest(None, None, None, count, why=why)
        lags = min(_LAGS, max(1, count // _OF_LAG))
    else:
        check_lags(lags)
        if (count := int(np.count_nonzero(mask))) <= 2 * (lags + 2):  # no test could be made
            raise ExperimentError(
                f"{record}/{output} has too few samples for so many lags",
                seen=f"lags={lags}, {count} valid samples",
                allowed=f"1 to {max(1, (count - 5) // 2)}, less than half of the samples",
                cure="leave lags out, or give fewer",
            )
    size = _sizes(residual, model, mask, jacobian)
    checks = check_residual(residual, drives, mask=mask, jacobian=jacobian, lags=lags, size=size)
    return OutputCheck(
        fit.fit_percent[record][output],
        sizes.rmse,
        sizes.S1,
        sizes.S2,
        few or checks.whiteness,
        checks.cross,
        checks.autocorrelation,
        checks.cross_correlation,
        trace,
    )
