"""Whiteness and independence of residuals: one calibrated p-value per output, and per output and drive.

With M the projection that removes the mean and what the fitted parameters could absorb, a white residual's
sums r_k = Σ e(t) e(t − k) have a known mean and covariance: whiteness is judged by their quadratic form. (A
regression on the own past, which estimates that covariance, alarms in 23 of 100 records of 60 samples at 1 %.)
Independence asks whether K regressors φ(t), a drive and its past, still explain e: r = Σ φ(t) e(t) has the
covariance σ² Φᵀ M Φ, so rᵀ (σ² Φᵀ M Φ)⁺ r is χ² with as many degrees of freedom as that matrix has rank,
whatever the colour of the drive. (A sum of squared correlations over lags is χ² only for a white drive: an
engine's torque, periodic and narrow band, breaks it.)

References: G. M. Ljung and G. E. P. Box (1978) for the whiteness test, here after any regression;
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from casadi_engine.distributions import beta_sf, f_sf
from casadi_engine.errors import ExperimentError
from casadi_engine.estimation.fit_percent import BoolArray, FloatArray, as_samples
from casadi_engine.validation.correlation import (
    CONSTANT_DRIVE,
    Correlation,
    IntArray,
    autocorrelation,
    centred,
    check_lags,
    cross_correlation,
    drive_samples,
    is_constant,
    lagged_products,
)
from casadi_engine.validation.projection import ABSORBED, WEAKEST, QuadraticForm, orthonormal
from casadi_engine.validation.whitening import Whitener

# A residual of which its past leaves less than this share unexplained has no noise in it.
PREDICTED = 1e-8
# Rounds of colour and regression coefficients.
ROUNDS = 4
# Samples below which the law of the statistic is drawn; drawings, and the share of them that its tail goes on from.
FEW, DRAWN, OF_TAIL = 150, 2000, 20
# Products of the exact covariance at most; where more columns were fitted, their directions count as any others.
MOST_PRODUCTS = 1e9
# Residual energy below this share, after removing what the parameters explain, is rounding.
NOTHING_LEFT = 1e-20
# The second opinion on the noise's colour counts only below this p-value (see _independence).
SURE = 1e-4


@dataclass(frozen=True)
class ResidualTest:
    """Outcome of one test of the residual: a small p-value speaks against the model.

    statistic : about χ² with ``dof`` degrees of freedom when nothing is left in the residual
    dof : rank of the tested directions (lags that the data can tell apart)
    p_value : from the law of the statistic in finite samples (beta, or F; χ² for large N)
    samples : valid residual samples used
    noise_order : order of the autoregression by which the residual was whitened first, 0 if it was white
    why : why there is no test; the numbers are None then
    """

    statistic: float | None
    dof: int | None
    p_value: float | None
    samples: int
    noise_order: int = 0
    why: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for result.json (None, with ``why``, where there is no number)."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class ResidualChecks:
    """All that is said about one output's residual; see `check_residual`."""

    whiteness: ResidualTest
    cross: Mapping[str, ResidualTest]
    autocorrelation: Correlation
    cross_correlation: Mapping[str, Correlation]

    def to_dict(self) -> dict[str, Any]:
        """Return nested plain dictionaries for result.json."""
        return {
            "whiteness": self.whiteness.to_dict(),
            "cross": {name: test.to_dict() for name, test in self.cross.items()},
            "autocorrelation": self.autocorrelation.to_dict(),
            "cross_correlation": {name: c.to_dict() for name, c in self.cross_correlation.items()},
        }


def whiteness(
    residual: ArrayLike, *, mask: ArrayLike | None = None, jacobian: ArrayLike | None = None, lags: int = 25
) -> ResidualTest:
    """Test whether a residual is uncorrelated with its own past, all lags 1..lags in one p-value.

    Parameters
    ----------
    residual : (N,) y − ŷ; NaN means missing when no mask is given
    mask : (N,) bool, True marks a valid sample; pairs count where both are present
    jacobian : (N, d) ∂ŷ/∂θ of the fitted parameters (initial states too), any scaling. Without it the loss of
        d directions is ignored: each R_e(k) is then low by about d/N, harmless while d ≪ √N
    lags : number of lags. Where samples come at a regular stride only, a lag counts strides

    A constant residual, or too few samples, gives no p-value and a ``why``.

    Raises
    ------
    ExperimentError : shapes, mask or ``lags`` do not fit, or no valid sample

    >>> import numpy as np
    >>> white = np.random.default_rng(0).standard_normal(1000)
    >>> whiteness(white).p_value > 0.01, whiteness(np.cumsum(white)).p_value < 1e-6
    (True, True)
    """
    check_lags(lags)
    return _whiteness(_prepare(residual, mask, jacobian, skip=0), lags)


def independence(
    residual: ArrayLike,
    drive: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    jacobian: ArrayLike | None = None,
    lags: int = 25,
) -> ResidualTest:
    """Test whether a residual is uncorrelated with a drive now and up to ``lags`` samples ago.

    A coloured residual is whitened first, together with the drive and the Jacobian (generalised least
    squares): its colour is an autoregression of the order that Akaike's criterion picks, fitted to the
    residual itself, so that the false-alarm rate holds; ``noise_order`` says which.

    Parameters
    ----------
    residual : (N,) y − ŷ; NaN means missing when no mask is given
    drive : (N,) the drive at the residual's times, complete, any unit
    mask : (N,) bool, True marks a valid residual sample
    jacobian : (N, d) ∂ŷ/∂θ of the fitted parameters. On fresh data it makes the test blind to the error
        that the parameters brought along, so that only a wrong structure is reported
    lags : largest lag in samples; the first ``lags`` samples serve as the drive's past

    A constant drive, one whose effect the parameters absorbed altogether, a constant residual, or too few
    samples give no p-value and a ``why``.

    Raises
    ------
    ExperimentError : shapes, mask or ``lags`` do not fit, no valid sample, or a drive that is not finite

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> drive, noise = np.sin(0.1 * np.arange(1000.0)), rng.standard_normal(1000)
    >>> independence(noise, drive).p_value > 0.01, independence(noise + drive, drive).p_value < 1e-6
    (True, True)
    """
    check_lags(lags)
    data = _prepare(residual, mask, jacobian, skip=lags)
    return _independence(data, _Coloured.of(data), drive_samples(drive, np.size(residual)), lags)


def check_residual(
    residual: ArrayLike,
    drives: Mapping[str, ArrayLike],
    *,
    mask: ArrayLike | None = None,
    jacobian: ArrayLike | None = None,
    lags: int = 25,
    cross_lags: int = 30,
    size: FloatArray | None = None,
) -> ResidualChecks:
    """Return both tests and the correlation functions of one output's residual against all drives.

    Parameters
    ----------
    residual, mask, jacobian : see `independence`
    drives : name -> (N,) drive at the residual's times
    lags : lags of the tests and of the autocorrelation
    cross_lags : lags of the cross-correlation functions, both ways
    size : (N,) how large the noise of each sample is beside that of the others, where it is not of one size: the tests
        are of the residual over it

    Raises
    ------
    ExperimentError : as `whiteness` and `independence`

    Source: section 2.2.3 of the thesis, (2.35), (2.36).
    """
    check_lags(lags)
    signals = {name: drive_samples(drive, np.size(residual)) for name, drive in drives.items()}
    data = _prepare(residual, mask, jacobian, skip=lags, size=size)
    noise = _Coloured.of(data)
    return ResidualChecks(
        whiteness=_whiteness(_prepare(residual, mask, jacobian, skip=0, size=size), lags),
        cross={name: _independence(data, noise, drive, lags) for name, drive in signals.items()},
        autocorrelation=autocorrelation(residual, mask=mask, lags=lags),
        cross_correlation={
            name: cross_correlation(residual, drive, mask=mask, lags=cross_lags)
            for name, drive in signals.items()
        },
    )


def rejected(tests: Mapping[str, Any], *, alpha: float = 0.01) -> tuple[str, ...]:
    """Return the names of the tests that fail when a right model may fail *any* of them with chance alpha.

    tests : name -> what has a ``p_value``

    Holm's step-down rule: the smallest p-value is held against alpha/m, the next against alpha/(m − 1), …
    Tests without a p-value do not count.

    Raises
    ------
    ExperimentError : alpha outside (0, 1)

    Source: S. Holm, Scand. J. Statist. 6 (1979).
    """
    if not 0.0 < alpha < 1.0:
        raise ExperimentError(
            "the false-alarm rate does not fit", seen=alpha, allowed="between 0 and 1", cure="give alpha=0.01"
        )
    p_values = sorted((test.p_value, name) for name, test in tests.items() if test.p_value is not None)
    failed = []
    for position, (p_value, name) in enumerate(p_values):
        if p_value > alpha / (len(p_values) - position):
            break
        failed.append(name)
    return tuple(failed)


@dataclass(frozen=True, eq=False)
class _Residual:
    """A residual ready for testing: only the rows that take part, zeros where a sample is missing.

    e : (n,) the residual with mean and Jacobian projected out
    valid : (n,) bool; the first and the last row are valid
    nuisance : (n, q) orthonormal directions that were projected out
    rows : where these rows lie in the whole record
    why : why no test is possible
    size : (n,) of the noise, which the rows were divided by; None where it is one
    """

    e: FloatArray
    valid: BoolArray
    nuisance: FloatArray
    rows: slice
    why: str | None = None
    size: FloatArray | None = None

    @property
    def samples(self) -> int:
        return int(np.count_nonzero(self.valid))

    def enough_for(self, directions: int) -> str | None:
        needed = 2 * directions + self.nuisance.shape[1]
        if self.why is None and self.samples <= needed:
            return (
                f"only {self.samples} valid samples: testing {directions} directions needs more than {needed}"
            )
        return self.why


def _prepare(
    residual: ArrayLike,
    mask: ArrayLike | None,
    jacobian: ArrayLike | None,
    *,
    skip: int,
    size: FloatArray | None = None,
) -> _Residual:
    """Check the arrays, drop ``skip`` rows, keep the stride at which samples exist, project."""
    values = as_samples(residual, "the residual")
    e, valid = centred(values, mask)
    nuisance = np.ones((values.size, 1))
    if jacobian is not None:
        nuisance = np.column_stack([nuisance, _sensitivities(jacobian, valid)])
    if size is not None:
        e, nuisance = e / size, nuisance / size[:, None]
    present = np.flatnonzero(valid[skip:]) + skip
    if present.size < 2:
        lack = f"only {present.size} valid samples after the first {skip}"
        return _Residual(np.zeros(0), np.zeros(0, dtype=bool), np.zeros((0, 1)), slice(0, 0), lack)
    rows = slice(int(present[0]), int(present[-1]) + 1, int(np.gcd.reduce(np.diff(present))))
    e, valid = e[rows], valid[rows]
    basis = orthonormal(nuisance[rows] * valid[:, None])
    rest = e - basis @ (basis.T @ e)
    why: str | None = None
    if not e.any():
        why = "the residual is constant: nothing to test"
    elif rest @ rest <= NOTHING_LEFT * (e @ e):
        why = "the fitted parameters explain the whole residual: nothing to test"
    return _Residual(rest, valid, basis, rows, why, None if size is None else size[rows])


def _sensitivities(jacobian: ArrayLike, valid: BoolArray) -> FloatArray:
    """Return the Jacobian as (N, d), zero where the residual is missing."""
    matrix = np.asarray(jacobian, dtype=float)
    matrix = matrix.reshape(-1, 1) if matrix.ndim == 1 else matrix
    if matrix.ndim != 2 or matrix.shape[0] != valid.size:
        raise ExperimentError(
            "the Jacobian does not fit the residual",
            seen=f"Jacobian {np.shape(jacobian)}, residual ({valid.size},)",
            allowed="(N, d), one row per sample",
        )
    matrix = np.where(valid[:, None], matrix, 0.0)
    if not np.isfinite(matrix).all():
        raise ExperimentError(
            "the Jacobian is not finite",
            seen=f"{int(np.count_nonzero(~np.isfinite(matrix)))} of {matrix.size} entries",
            cure="the sensitivities diverged: look at the parameters and the step",
        )
    return matrix


def _whiteness(data: _Residual, lags: int) -> ResidualTest:
    """Judge the sums of products with the residual's own past, all lags together, by their exact covariance."""
    why = data.enough_for(lags)
    if why is not None:
        return ResidualTest(None, None, None, data.samples, why=why)
    steps = np.arange(1, lags + 1)
    present = data.valid.astype(float)
    pairs = np.rint(lagged_products(present, present, steps))
    steps, pairs = steps[pairs > 0], pairs[pairs > 0]
    if not steps.size:
        return ResidualTest(
            None, None, None, data.samples, why="no lag can be tested: too few pairs of samples"
        )
    freedom = data.samples - data.nuisance.shape[1]
    mean, covariance = _moments(data, steps, pairs)
    size = np.sqrt(np.maximum(np.diag(covariance), WEAKEST * pairs))
    strength, directions = np.linalg.eigh(covariance / np.outer(size, size))
    usable = strength > ABSORBED
    turn, rank = directions[:, usable] / np.sqrt(strength[usable]), int(usable.sum())

    def statistic_of(sums: FloatArray, squares: FloatArray) -> FloatArray:
        """Of sums (..., K) of products and of squares (...)."""
        found = ((sums * (freedom / squares)[..., None] - mean) / size) @ turn
        return np.asarray((found**2).sum(axis=-1))

    statistic = float(
        statistic_of(lagged_products(data.e, data.e, steps), np.asarray(float(data.e @ data.e)))
    )
    if data.samples < FEW:
        return ResidualTest(statistic, rank, _by_drawing(data, steps, statistic, statistic_of), data.samples)
    # Residuals are few: the sum of squares varies by 2 rank + 4 rank^2/freedom, as does F with so many below.
    below = freedom / 2 + 4
    p_value = float(f_sf(statistic / rank * below / (below - 2), rank, below))
    return ResidualTest(statistic, rank, p_value, data.samples)


def _by_drawing(
    data: _Residual,
    steps: IntArray,
    statistic: float,
    statistic_of: Callable[[FloatArray, FloatArray], FloatArray],
) -> float:
    """How often white noise in the place of the residual makes the statistic as large, or that of the ranks of
    neighbours, which one large sample does not rule (Bartels 1982, J. Am. Stat. Assoc. 77, 40): by drawings of it."""
    drawn = np.random.default_rng(0).standard_normal((DRAWN, data.e.size)) * data.valid
    drawn -= (drawn @ data.nuisance) @ data.nuisance.T
    sums = np.stack([np.einsum("dn,dn->d", drawn[:, k:], drawn[:, :-k]) for k in steps], axis=1)
    by_products = _chance(statistic, statistic_of(sums, np.einsum("dn,dn->d", drawn, drawn)))
    own, others = (_neighbours(e[:, data.valid]) for e in (data.e[None], drawn))
    middle = float(others.mean())
    by_ranks = _chance(abs(float(own[0]) - middle), np.abs(others - middle))
    return min(1.0, 2 * min(by_products, by_ranks))


def _neighbours(e: FloatArray) -> FloatArray:
    """(D,) sums of products of the ranks of neighbours, of rows (D, n)."""
    ranks = np.argsort(np.argsort(e, axis=1), axis=1) - (e.shape[1] - 1) / 2
    return np.asarray((ranks[:, 1:] * ranks[:, :-1]).sum(axis=1))


def _chance(statistic: float, drawn: FloatArray) -> float:
    """The share of drawings that are as large; where they are few, their mean excess goes on from them."""
    found, tail = np.sort(drawn), len(drawn) // OF_TAIL
    begins = found[-tail - 1]
    if statistic <= begins:
        return float((1 + np.count_nonzero(found >= statistic)) / (len(found) + 1))
    excess = max(float((found[-tail:] - begins).mean()), 1e-300)
    return float(np.exp((begins - statistic) / excess) / OF_TAIL)


def _moments(data: _Residual, steps: IntArray, pairs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean (K,) and covariance (K, K) of Σ e(t) e(t − k) of white noise of unit variance after projection.

    With the symmetric shifts B_k and the projection M = I − QQᵀ they are tr(M B_k) and 2 tr(M B_j M B_k).
    """
    q, size = data.nuisance, data.e.size
    mean = -np.sum([lagged_products(column, column, steps) for column in q.T], axis=0)
    covariance = np.diag(pairs)
    if q.size * q.shape[1] * steps.size > MOST_PRODUCTS:
        return mean, covariance * (1 - q.shape[1] / data.samples) ** 2
    inner = np.empty((steps.size, q.shape[1], q.shape[1]))
    for k, column in enumerate(q.T):
        shifted = np.zeros((steps.size, size))
        for row, step in zip(shifted, steps, strict=True):
            row[step:] = column[:-step] / 2
            row[:-step] += column[step:] / 2
        shifted *= data.valid
        covariance -= 4 * shifted @ shifted.T
        inner[:, k] = shifted @ q
    flat = inner.reshape(steps.size, -1)
    return mean, covariance + 2 * flat @ flat.T


def _independence(data: _Residual, noise: _Coloured, drive: FloatArray, lags: int) -> ResidualTest:
    """Regress the residual on the drive and its past, both whitened where the residual is coloured.

    The colour comes from the residual as it is, which keeps the size. But then the trace of a strong
    drive passes for colour and whitens itself away. So where the residual is coloured, the colour of what
    the drive does *not* explain gets a say too: it is too eager in short records, hence heard only if sure.
    """
    why = CONSTANT_DRIVE if is_constant(drive) else data.enough_for(lags + 1)
    if why is not None:
        return ResidualTest(None, None, None, data.samples, why=why)
    rows = slice(data.rows.start - lags, data.rows.stop - lags, data.rows.step)
    past = sliding_window_view(drive - drive.mean(), lags + 1)[rows, ::-1].copy()
    if not data.valid.all():
        past *= data.valid[:, None]
    if data.size is not None:
        past /= data.size[:, None]
    form, test = _regress(noise, past, data)
    if not noise.colour.order or form is None or (test.p_value or 0.0) < SURE:
        return test
    unexplained = Whitener.of(_unexplained(data, past), data.valid)
    ratio = unexplained.largest_gain_over(noise.colour)
    if _p_value(ratio * form.value / float(noise.e @ noise.e), form.rank, data) > SURE:
        return test  # the other colour could not raise the statistic far enough
    _, second = _regress(_Coloured.of(data, _colour(_beside(data, past))), past, data)
    return second if second.p_value is not None and second.p_value < SURE else test


@dataclass(frozen=True, eq=False)
class _Coloured:
    """A residual and its nuisance directions under one noise model (whitened, projected)."""

    colour: Whitener
    e: FloatArray
    nuisance: FloatArray

    @staticmethod
    def of(data: _Residual, colour: Whitener | None = None) -> _Coloured:
        """Whiten with the given colour, or with the residual's own; white if there is nothing to test."""
        if data.why is not None:
            return _Coloured(Whitener.white(data.valid), data.e, data.nuisance)
        colour = _colour(data) if colour is None else colour
        if not colour.order:
            return _Coloured(colour, data.e, data.nuisance)
        whitened = colour.apply(np.column_stack([data.e, data.nuisance]))
        nuisance = orthonormal(whitened[:, 1:])
        return _Coloured(colour, whitened[:, 0] - nuisance @ (nuisance.T @ whitened[:, 0]), nuisance)


def _colour(data: _Residual) -> Whitener:
    """Return the colour of the noise of which the regression left the residual (restricted likelihood).

    Of the remainder alone it would have too little power where the fitted parameters took some: white noise beside 20
    parameters of 100 samples then passes for coloured, and drives alarm in 17 of 100 records at 1 %.
    """
    e, nuisance, freedom = data.e, data.nuisance, data.samples - data.nuisance.shape[1]
    uncertain = nuisance * np.sqrt(e @ e / freedom)
    for _ in range(ROUNDS):
        colour = Whitener.of(e, data.valid, uncertain)
        if not colour.order:
            break
        whitened = colour.apply(np.column_stack([data.e, nuisance]))
        frame, triangle = np.linalg.qr(whitened[:, 1:])
        taken = frame.T @ whitened[:, 0]
        rest = whitened[:, 0] - frame @ taken
        if rest @ rest <= PREDICTED * (data.e @ data.e):
            return Whitener.of(data.e, data.valid)  # without noise, as a sine: nothing to restrict
        root = np.linalg.solve(triangle.T, nuisance.T).T  # nuisance times the inverse triangle
        e, uncertain = data.e - root @ taken, root * np.sqrt(rest @ rest / freedom)
    return colour


def _unexplained(data: _Residual, past: FloatArray) -> FloatArray:
    """Return what the drive leaves of the residual (ordinary least squares)."""
    form = QuadraticForm.of(past.T @ data.e, past, data.nuisance)
    if form is None:
        return data.e
    explained = past @ form.coefficients
    return np.asarray(data.e - explained + data.nuisance @ (data.nuisance.T @ explained))


def _beside(data: _Residual, past: FloatArray) -> _Residual:
    """Return the residual with the drive among the directions that were fitted."""
    basis = orthonormal(np.column_stack([data.nuisance, past]))
    return replace(data, e=data.e - basis @ (basis.T @ data.e), nuisance=basis)


def _regress(
    noise: _Coloured, past: FloatArray, data: _Residual
) -> tuple[QuadraticForm | None, ResidualTest]:
    """Return the test of the drive's past under one noise model (generalised least squares)."""
    past = noise.colour.apply(past)
    form = QuadraticForm.of(past.T @ noise.e, past, noise.nuisance)
    if form is None:
        why = "the mean and the fitted parameters absorb everything that this drive could explain"
        return None, ResidualTest(None, None, None, data.samples, noise.colour.order, why)
    return form, _verdict(form, noise.e, data, order=noise.colour.order)


def _verdict(form: QuadraticForm, e: FloatArray, data: _Residual, *, order: int) -> ResidualTest:
    """Turn the quadratic form into a χ² statistic and its p-value."""
    share = min(form.value / float(e @ e), 1.0)
    freedom = data.samples - data.nuisance.shape[1]
    return ResidualTest(share * freedom, form.rank, _p_value(share, form.rank, data), data.samples, order)


def _p_value(share: float, rank: int, data: _Residual) -> float:
    """Return the chance that ``rank`` regressors explain at least this share of a residual by accident.

    For Gaussian residuals and given regressors the share follows a beta law exactly; χ² is its limit, too
    timid while N is not far above the rank.
    """
    freedom = data.samples - data.nuisance.shape[1]
    return float(beta_sf(share, rank / 2, (freedom - rank) / 2))
