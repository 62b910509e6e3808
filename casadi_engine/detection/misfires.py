"""misfires: for every combustion of a record the probability that it was lost, from crank speed alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import ndtr

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.detection.plant import Disturbances, make_plant
from casadi_engine.detection.segments import cut_record, window_edges
from casadi_engine.detection.smoother import Prior, smooth
from casadi_engine.detection.torques import CYCLE, TorqueTables, learn_torques
from casadi_engine.errors import EstimationError, ExperimentError
from casadi_engine.estimation import Fit
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.slicing import crank_angle

Array = NDArray[np.float64]

SEGMENT = 0.007  # s: what is unknown at crank and load may change this often, or more
MOST_SEGMENTS = 8  # of a combustion
FIRST_LOOK = 2  # engine cycles from which the usual strength is taken at first
LOUD, POOR = 1.2, 2.0  # misfits from which it is told, and from which a model is not trusted
NEITHER = 4.3  # standard errors from lost and from usual: one in 100 000 by chance
APART = 0.4  # share by which the speed may differ from what the crank angle turns with: wrong units or signs
SPIKE = 20.0  # standard deviations, or means of all, from the median of five samples
FEWEST = 8  # samples of a combustion
LONGEST_LAG = 6


@dataclass(frozen=True, eq=False)
class Misfires:
    """The answer of ``misfires``: a row for each combustion of a record, K of them, as they followed.

    Attributes
    ----------
    record : its name
    cylinder : (K,) number of the cylinder; time : (K,) start of its combustion [s]; angle : (K,) the same [rad]
    probability : (K,) that the combustion was lost
    strength, stderr : (K,) its size, 1 for a usual one, and standard error; NaN for the last ``lag`` combustions
    level : (K,) size of the usual combustion, of that in the fit's records
    separation : (K,) d', the distance of a lost from a usual combustion in standard deviations; NaN as ``strength``
    misfit : how much the samples differ from what the model foretells, over its noise: 1 if both are right; what is
        more than noise is counted as noise from combustion to combustion, so that ``probability`` and ``separation``
        are honest about it, unless it has the shape of a combustion
    lag : combustions that were waited for before one was decided
    """

    record: str
    cylinder: NDArray[np.int64]
    time: Array
    angle: Array
    probability: Array
    strength: Array
    stderr: Array
    level: Array
    separation: Array
    misfit: float
    lag: int

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(K,) True where a combustion was lost more likely than not."""
        return self.probability > 0.5

    @property
    def neither(self) -> NDArray[np.bool_]:
        """(K,) True where the size is neither that of a lost nor that of a usual combustion, but between them.

        A partial burn, or a model that does not fit: whether it counts as lost is then not decided by the data.
        """
        usual = (1 - self.strength) * self.separation > NEITHER
        return usual & (self.strength > NEITHER * self.stderr)

    @property
    def trusted(self) -> bool:
        """False where the record refutes the model or its noise: the misfit is above 2, or below a half."""
        return bool(1 / POOR <= self.misfit <= POOR)

    @property
    def rate(self) -> dict[int, float]:
        """Cylinder -> expected share of its combustions that were lost [1]."""
        return {int(c): float(self.probability[self.cylinder == c].mean()) for c in np.unique(self.cylinder)}

    @property
    def expected_error(self) -> float:
        """Mean probability that a combustion is taken for the other kind, half way between both, by ``separation``."""
        return float(np.mean(ndtr(-self.separation[np.isfinite(self.separation)] / 2)))

    def rates(self, revolutions: float) -> Array:
        """Expected share of lost combustions in each whole block of so many revolutions in a row, (blocks,) [1].

        On-board diagnosis looks at 200 revolutions for the catalyst and 1000 for emissions.

        Raises
        ------
        ExperimentError : the record is shorter than a block
        """
        each = np.unique(self.cylinder).size / 2  # combustions of a revolution
        number = isinstance(revolutions, int | float | np.number) and not isinstance(revolutions, bool)
        if not number or not 1 <= revolutions <= len(self.cylinder) / each:
            raise ExperimentError(
                f"the record {self.record!r} holds no such block of revolutions",
                seen=repr(revolutions),
                allowed=f"1 to {len(self.cylinder) / each:.4g} revolutions",
                cure="ask for shorter blocks, or give a longer record",
            )
        size = max(round(revolutions * each), 1)
        whole = len(self.probability) // size
        return self.probability[: whole * size].reshape(whole, size).mean(axis=1)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, ready for JSON; None for NaN."""
        names = ("cylinder", "time", "angle", "probability", "strength", "stderr", "level", "separation")
        arrays = {
            name: [None if one != one else one for one in getattr(self, name).tolist()] for name in names
        }
        plain = {"record": self.record, "lag": self.lag, "misfit": self.misfit, "trusted": self.trusted}
        return {**plain, **arrays}

    def __str__(self) -> str:
        rows = [
            f"Combustions of {self.record}: {self.lost.sum()} of {len(self.lost)} lost",
            "cylinder  combustions  lost  expected share",
        ]
        for cylinder, share in self.rate.items():
            own = self.cylinder == cylinder
            rows.append(f"{cylinder:8d}  {own.sum():11d}  {self.lost[own].sum():4d}  {100 * share:12.3g} %")
        unsure = int(np.sum(np.abs(self.probability - 0.5) < 0.49))
        low, middle = np.nanmin(self.separation), np.nanmedian(self.separation)
        rows.append(f"uncertain (1 % to 99 %): {unsure}")
        rows.append(f"separation of lost from usual: {middle:.1f} standard deviations, {low:.1f} at least")
        if ndtr(-middle / 2) > 1e-3:
            rows.append("that is too little to decide each combustion: look at the rates, or at more load")
        between = self.strength[self.neither]
        if between.size:
            rows.append(
                f"{between.size} neither lost nor usual (sizes {between.min():.2f} to {between.max():.2f}): "
                "partial burns, or a model that does not fit"
            )
        if self.misfit > LOUD or not self.trusted:
            rows.append(f"the speed differs from the model by {self.misfit:.1f} times its noise")
        if not self.trusted:
            rows[-1] = f"not to be trusted: {rows[-1]}; "
            rows[-1] += "give the true sigma, an unfiltered record, or a model with the crankshaft's torsion"
        return "\n".join(rows)


@one_blas_thread
def misfires(
    fit: Fit,
    data: Experiment,
    *,
    lag: int = 3,
    lost: float = 0.01,
    scatter: float = 0.05,
    step: float = 20.0,
    road: float = 30.0,
    sigma: float | None = None,
    output: str = "omega",
) -> Misfires:
    """Find the probability of each combustion of a record that it was lost, from crank speed and crank angle alone.

    The fit gives the engine; the pressures of its records give the torque of a motored cylinder and of a combustion
    over the crank angle. The torque on the load, one on the engine, and the size of each combustion are estimated along
    the record by a smoother that waits for ``lag`` further combustions. It runs forwards only, but for the usual size
    of a combustion, first taken from two engine cycles. A load step or a jolt of the road is not taken for a misfire,
    because neither has its shape.

    Parameters
    ----------
    fit : of a model with cylinders and a linear core (``two_mass``, ``crankshaft``), whose records hold the pressures
    data : a record with the crank angle theta [rad], unwrapped, and the speed [rad/s] in equal steps of time; it needs
        no pressures and no load. Its angle is zero where that of the fit's records is: if it is a revolution off, which
        crank speed alone cannot show, the combustions are put down to the wrong cylinders
    lag : combustions to wait for, 0 to 6
    lost : probability of a combustion to be lost before the record is looked at
    scatter : standard deviation of a combustion's size, cylinders' differences included [1]
    step : standard deviation of the change of the torques on the engine and on the load in a combustion [N m]
    road : standard deviation of a shaking torque on the load, below about 10 Hz [N m]
    sigma : standard deviation of the noise on the speed [rad/s]; left out, that of the fit
    output : name of the speed, an output of the model

    Returns
    -------
    Misfires : probabilities, sizes and what can be told at all

    Raises
    ------
    ModelError : the fit's model is not of that kind
    ExperimentError : no crank angle, no speed, a crank that turns back, a speed that is not the angle's, samples not
        equally spaced or too few, a record shorter than an engine cycle
    EstimationError : an option is not acceptable

    Notes
    -----
    When the throttle closes until hardly anything burns, a combustion and a lost one are alike, and the probability
    stays between 0 and 1; ``separation`` says so. A model without the crankshaft's torsion misses lost combustions at
    high speed; ``misfit`` says so, and ``trusted`` is False.

    Examples
    --------
    Made-up pressures at 1200 RPM; cylinder 3 does not burn in one cycle.

    >>> import numpy as np, casadi_engine as ce
    >>> model, time = ce.two_mass(reciprocating_speed="measured"), np.arange(7200) / 7200.0
    >>> def run(lost):
    ...     data = {"theta": 125.6 * time, "omega": 125.6 + 0 * time, "T_load": 57 + 0 * time}
    ...     for place, cylinder in enumerate((1, 3, 4, 2)):
    ...         angle = data["theta"] - place * np.pi
    ...         cycle = np.floor(angle / (4 * np.pi) + 0.5)
    ...         own = angle - 4 * np.pi * cycle
    ...         burned = np.where((cylinder == 3) & (cycle == lost), 0, np.exp(-(((own - 0.5) / 0.3) ** 2)))
    ...         data[f"p{cylinder}"] = 1e5 * (1 + 9 * np.exp(-((own / 0.5) ** 2)) + 14 * burned)
    ...     units = {"theta": "rad", "omega": "rad/s", "T_load": "N m"} | {f"p{k}": "Pa" for k in (1, 2, 3, 4)}
    ...     known = ce.Experiment.from_arrays("run", time=time, units=units, **data)
    ...     speed = ce.simulate(model, known, initial={"omega_eng": 125.6, "omega_load": 125.6, "twist": -0.03})
    ...     noise = 0.1 * np.random.default_rng(int(lost)).standard_normal(time.size)
    ...     data["omega"] = speed["omega"].values + noise
    ...     return ce.Experiment.from_arrays("run", time=time, units=units, **data)
    >>> fit = ce.estimate(model, run(lost=3), noise=ce.Noise(omega=0.1), progress=False)
    >>> found = ce.misfires(fit, run(lost=6).only("theta", "omega"))
    >>> found.cylinder[found.lost], found.probability[found.lost].round(3)
    (array([3]), array([1.]))
    """
    _check_options(fit, lag, lost, scatter, step, road)
    tables = learn_torques(fit)
    noise = _noise(fit, output, sigma)
    time, theta, omega, valid = _samples(data, output, noise)
    h = float(time[-1] - time[0]) / (len(time) - 1)
    edges, places = _edges(data, theta, tables, lag)
    disturbances = Disturbances(float(step), float(road))
    plant = make_plant(fit, output, tables.enter, h, disturbances)
    pieces = min(MOST_SEGMENTS, max(1, math.ceil(float(np.diff(edges).max()) * h / SEGMENT)))
    segments = cut_record(theta, omega, valid, edges, pieces, plant, tables, noise)
    found = smooth(
        plant, disturbances, Prior(lost, scatter), segments, omega[valid][:1],
        lag=lag, first_look=FIRST_LOOK * len(tables.order),
    )  # fmt: skip
    strength, stderr = found.strength[0] / found.level[0], found.stderr[0] / found.level[0]
    return Misfires(
        data.name,
        cylinder=tables.order[places],
        time=time[edges[:-1]],
        angle=theta[edges[:-1]],
        probability=found.lost[0],
        strength=strength,
        stderr=stderr,
        level=found.level[0],
        separation=1 / np.hypot(stderr, scatter),
        misfit=math.sqrt(float(np.median(found.misfit[0]))),
        lag=lag,
    )


def _check_options(fit: Any, lag: Any, lost: Any, scatter: Any, step: Any, road: Any) -> None:
    if not isinstance(fit, Fit):
        raise EstimationError(
            "misfires needs a fit", seen=type(fit).__name__, allowed="a Fit", cure="make one by estimate"
        )
    if not isinstance(lag, int | np.integer) or isinstance(lag, bool) or not 0 <= lag <= LONGEST_LAG:
        raise _option("lag", lag, f"a whole number, 0 to {LONGEST_LAG}")
    for name, value, top in (
        ("lost", lost, 1.0),
        ("scatter", scatter, 1.0),
        ("step", step, 1e4),
        ("road", road, 1e4),
    ):
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not number or not 0 < value < top:
            raise _option(name, value, f"a number > 0, less than {top:g}")


def _option(name: str, seen: Any, allowed: str) -> EstimationError:
    return EstimationError(f"invalid `{name}`", seen=repr(seen), allowed=allowed, cure="leave it out")


def _noise(fit: Fit, output: str, sigma: float | None) -> float:
    if output not in fit.noise:
        raise ExperimentError(
            f"the fit has no output {output!r}",
            seen=repr(output),
            allowed=", ".join(fit.noise),
            cure="name the crank speed by output=",
        )
    noise = fit.residual_level[output] if sigma is None else sigma
    if isinstance(noise, bool) or not isinstance(noise, int | float | np.number) or not 0 < noise < math.inf:
        raise _option("sigma", sigma, "a number > 0 [rad/s]")
    return float(noise)


def _samples(data: Experiment, output: str, noise: float) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Times [s], crank angles [rad], speeds [rad/s] at the samples of the speed, and which of these are valid.

    They begin with the first valid one. A spike of one or two samples is not valid.
    """
    if not isinstance(data, Experiment):
        raise ExperimentError(
            "misfires needs one record",
            seen=type(data).__name__,
            allowed="an Experiment",
            cure="read one by read_experiment, and look at each alone",
        )
    for name, what in (("theta", "crank angle"), (output, "crank speed")):
        if name not in data:
            raise ExperimentError(
                f"experiment {data.name!r} has no {what}",
                seen=", ".join(data.names),
                allowed=f"a channel {name!r}",
                cure="add it by with_channel",
            )
    times, angles = crank_angle(data, "theta")
    speed = data[output]
    inside = (speed.time >= times[0]) & (speed.time <= times[-1])
    if not (speed.mask & inside).any():
        raise ExperimentError(f"the speed of {data.name!r} has no valid samples", seen="none", allowed="some")
    inside[: np.argmax(speed.mask & inside)] = False
    time, omega, valid = speed.time[inside], speed.values[inside], speed.mask[inside]
    steps = np.diff(time)
    if len(time) < 2 or np.ptp(steps) > 0.01 * steps.mean():
        raise ExperimentError(
            f"the speed of {data.name!r} is not sampled evenly",
            seen=f"{len(time)} samples"
            if len(time) < 2
            else f"steps of {steps.min():.4g} to {steps.max():.4g} s",
            allowed="equal steps of time",
            cure="interpolate theta and speed to equal steps first",
        )
    angle = np.interp(time, times, angles)
    turned = float(np.median(np.gradient(angle, time)[valid]))
    if not abs(np.median(omega[valid]) - turned) <= APART * turned:
        raise ExperimentError(
            f"speed and crank angle of {data.name!r} do not agree",
            seen=f"{np.median(omega[valid]):.4g} rad/s where the angle turns with {turned:.4g} rad/s",
            allowed=f"equal within {100 * APART:g} %",
            cure="check their units and signs, and that both are of the crank",
        )
    omega = np.interp(time, time[valid], omega[valid])
    off = np.abs(omega - median_filter(omega, 5))
    valid = valid & (off <= SPIKE * max(float(off.mean()), noise))
    return time, angle, np.interp(time, time[valid], omega[valid]), valid


def _edges(
    data: Experiment, theta: Array, tables: TorqueTables, lag: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    edges, places = window_edges(theta, tables)
    least = max(len(tables.order), lag + 1)
    if len(places) < least:
        raise ExperimentError(
            f"the record {data.name!r} is too short to find misfires",
            seen=f"{len(places)} whole combustions in {(theta[-1] - theta[0]) / CYCLE:.3g} engine cycles",
            allowed=f"{least} or more",
            cure="give a longer record",
        )
    fewest = int(np.diff(edges).min())
    if fewest < FEWEST:
        raise ExperimentError(
            f"the record {data.name!r} has too few samples to find misfires",
            seen=f"{fewest} in a combustion",
            allowed=f"{FEWEST} or more",
            cure="sample the speed faster",
        )
    return edges, places
