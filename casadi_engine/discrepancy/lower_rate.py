"""A repair on records of a lower rate: everything is looked for there, and told in numbers of the whole data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.checked_errors import (
    FOR_INTERVALS,
    as_fitted,
    no_smaller_errors,
    with_errors_of,
)
from casadi_engine.discrepancy.confirmation import Residuals, gap
from casadi_engine.discrepancy.fresh import Portions
from casadi_engine.discrepancy.repaired import Gaps, NoiseFound, Repair, Side
from casadi_engine.discrepancy.start import Start
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.estimation.corner_widths import paths_of
from casadi_engine.estimation.fit import Trace
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.lower_rate import (
    lost_at_lower_rate,
    thinned,
    thinned_noise,
    unsuitable_record,
)
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.two_stages import bent_by_thinning
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.candidate_sensitivities import at_measurements
from casadi_engine.simulation.grid import lay_grid


@dataclass(frozen=True, eq=False)
class LowerRate:
    """The records of a repair at a rate ``factor`` times lower, and the fit without effects there and on all data.

    share : standard deviation of the noise there over that of the whole data; lost : share of the information left out
    """

    whole: Portions
    portion: Portions
    whole_noise: Noise | None
    noise: Noise
    whole_fit: Fit
    fit: Fit
    options: Mapping[str, Any]
    factor: int
    share: float
    lost: float

    @property
    def words(self) -> str:
        """What was searched on."""
        lost = f"{100 * max(self.lost, 0.0):.2g} % of the information left out"
        return f"records of a rate {self.factor} times lower ({lost}); the fits are of the whole data"

    # ---- back to the whole data

    def told(self, repair: Repair) -> Repair:
        """The repair with fits, errors and gaps of the whole data."""
        fit = self._refitted(repair.fit) if repair.effects else self.whole_fit
        options = {**repair.options, "searched on": self.words}
        if fit is None:
            why = "the repaired model was not refitted on the whole data: its values are those of the lower rate"
            fit = repair.fit
            repair = replace(repair, messages=(*repair.messages, why))
        noise = repair.noise
        if noise is not None:
            # what the fit leaves of the whole data, where nothing is left to be found
            own = fit.noise if repair.verdict in ("named", "class") and not noise.colour else {}
            sigma = {
                name: own[name] if free and name in own else (level / self.share, free)
                for name, (level, free) in noise.sigma.items()
            }
            noise = replace(noise, sigma=sigma)
        return replace(
            repair,
            null_fit=self.whole_fit,
            fit=fit,
            effects=tuple(with_errors_of(one, fit) for one in repair.effects),
            gaps=None if repair.gaps is None or noise is None else self._gaps(repair.gaps, fit, noise),
            data=self.whole.data,
            fresh=self.whole.fresh,
            noise=noise,
            options=options,
        )

    def _refitted(self, fit: Fit) -> Fit | None:
        """A fit of the lower rate on the whole data; None where it does not converge."""
        noise = {name: (level / self.share, own) for name, (level, own) in fit.noise.items()}
        warm = Start(fit.values, fit.initial, noise, fit.converged)
        try:
            found = estimate(
                fit.model, self.whole.data, parameters=as_fitted(fit), noise=self.whole_noise, warm=warm,
                progress=False, errors=FOR_INTERVALS, **self.options,
            )  # fmt: skip
        except CasadiEngineError:
            return None
        return no_smaller_errors(found, fit) if found.converged else None

    def _gaps(self, gaps: Gaps, fit: Fit, noise: NoiseFound) -> Gaps:
        before, after = gaps.validation_before, gaps.validation_after
        sigma = {name: level for name, (level, _) in noise.sigma.items()}
        return replace(
            gaps,
            estimation_before=self._side(gaps.estimation_before, self.whole_fit.traces, sigma),
            estimation_after=self._side(gaps.estimation_after, fit.traces, sigma),
            validation_before=None if before is None else self._fresh_side(before, sigma),
            validation_after=None if after is None else self._fresh_side(after, sigma),
        )

    def _fresh_side(self, side: Side, sigma: Mapping[str, float]) -> Side:
        """A side on fresh data, simulated over the whole records from the initial states that were found."""
        traces = {record.name: _traces(fit, record) for fit in side.fits for record in self.whole.fresh
                  if record.name in fit.initial}  # fmt: skip
        return self._side(side, traces, sigma)

    def _side(
        self, side: Side, traces: Mapping[str, Mapping[str, Trace]], sigma: Mapping[str, float]
    ) -> Side:
        parts = []
        for record, own in traces.items():
            for output, trace in own.items():
                there = np.isfinite(trace.residual)
                none = np.zeros(int(there.sum()), np.intp)
                left, seen = trace.residual[there], trace.measured[there]
                parts.append(Residuals(record, output, left, seen, none, sigma[output]))
        whole = gap(parts)
        within = side.within_errors
        if within is not None:
            # what the parameters' errors explain is the same chi-squared, of so many times more samples
            explained = (side.gap.chi2_per_sample - within) * side.gap.samples / whole.samples
            within = whole.chi2_per_sample - explained
        return replace(side, gap=whole, traces=traces, within_errors=within)


def _traces(fit: Fit, record: Experiment) -> dict[str, Trace]:
    """Output -> measured and simulated over a whole record, from a fit's parameters and initial states."""
    (path,) = paths_of(replace(fit, data=(record,)))
    out = path.function([fit.model.output_expressions])(*path.at_samples().arguments)[0]
    shown = at_measurements(path, np.broadcast_to(out, (len(fit.model.outputs), path.grid.samples))[None])
    found = {}
    for name, sample in path.grid.measured.items():
        channel = record[name]
        simulated = np.full(len(channel.time), np.nan)
        simulated[sample.index] = shown[name][0]
        found[name] = Trace(channel.time, channel.values, channel.mask, simulated, None)
    return found


def at_lower_rate(
    null_fit: Fit, parameters: Parameters, portion: Portions, noise: Noise | None, options: Mapping[str, Any]
) -> LowerRate | None:
    """The records at the lowest rate that keeps the information about the parameters; None where none does."""
    model = null_fit.model
    if options.get("interval", "auto") not in ("auto", "single"):
        return None
    for record in (*portion.data, *portion.fresh):
        if _unsuitable(null_fit, record):
            return None
    search = _search(model, portion.data, parameters, noise, options, null_fit)
    held = [name for name, one in null_fit.estimates.items() if one.at_bound is not False]
    factor, lost = lost_at_lower_rate(search, portion.fresh, held)
    if factor == 1:
        return None
    lower = replace(
        portion,
        data=tuple(thinned(model, record, factor) for record in portion.data),
        fresh=tuple(thinned(model, record, factor) for record in portion.fresh),
    )
    own = thinned_noise(noise or Noise(), model, lower.data[0])
    decimation = lower.data[0].decimation
    assert decimation is not None
    share = decimation.deviation
    levels = {name: (level * share, free) for name, (level, free) in null_fit.noise.items()}
    warm = Start(null_fit.values, null_fit.initial, levels, True)
    if bent_by_thinning(search, _search(model, lower.data, parameters, own, options, warm)):
        return None
    fit = estimate(
        model, lower.data, parameters=parameters, noise=own, warm=warm, progress=False, **dict(options)
    )
    if not fit.converged:
        return None
    return LowerRate(portion, lower, noise, own, null_fit, fit, dict(options), factor, share, lost)


def _search(
    model: Model,
    data: tuple[Experiment, ...],
    parameters: Parameters,
    noise: Noise | None,
    options: Mapping[str, Any],
    warm: Any,
) -> Search:
    """A search that is set up at an optimum."""
    return Search(
        model, data, parameters, noise, interval=options.get("interval", "auto"), initial=options.get("initial"),
        loss=read_loss("square"), ties="substitute", method=options.get("method", "exact"), max_iterations=1,
        tolerance=1e-6, warm=warm, progress=None,
    )  # fmt: skip


def _unsuitable(fit: Fit, record: Experiment) -> bool:
    measured = tuple(out.name for out in fit.model.outputs if out.name in record)
    return bool(unsuitable_record(fit.model, lay_grid(fit.model, record, outputs=measured), record))
