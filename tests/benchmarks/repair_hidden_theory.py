"""What theory allows for a hidden effect: how sure it is told from the others, and which ones it is confused with.

All of it is for a record without noise. Three answers stand side by side. By refits: every rival that could come near
is put into the model and refitted to the record; d^2 is what it leaves more than the true effect does, which is what
any method that refits can tell them apart by. By slopes (R and q) at the optimum of the fit without the effect, where
scores are taken; and at the true parameters, where the refits end. Slopes agree with the refits where the effect is
small. Where the fit without it was driven far they do not: what differs there may be alike at the truth.
"""

import contextlib
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "problems"))

import repair_engine as engine
import two_mass as page
from repair_detectable import WANTED
from simulator.hidden_runs import Case
from single_shooting import settle

import casadi_engine as ce
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.score import score, separation
from casadi_engine.discrepancy.screening import screen
from casadi_engine.errors import CasadiEngineError

RATE = 1440.2
# Rivals that are refitted: those nearer than AWAY by slopes here or there, one at least and the nearest RIVALS of each,
# and further ones while none of those refitted can be told from the truth.
SEPARABLE, SEPARATED, AWAY, RIVALS, ITERATIONS = 5.0, 3.3, 12.0, 4, 80
# Rows that correlate more are one row with several names.
SAME_ROW = 0.9999


def theory_of(folder, place, sensors, times, size):
    """mu, least separation d, the class, at the optimum without the effect and at the true parameters; once."""
    store = engine.Store(folder, "theory")
    name = f"{place.name}, {sensors}, {times}"
    if name not in store.done():
        store.add(name, _theory(folder, place, sensors, times, size))
    return store.done()[name]


def _theory(folder, place, sensors, times, size):
    points = engine.Store(folder, "detectable").done()[f"{place.name}, {sensors}"]["points"]
    point = points[str(times)]
    (record,) = engine.simulated([Case((place.hidden(size),), 0, 0)], load=place.load, rate=RATE, sigma=0.0)
    model = engine.model(sensors)
    pars = page.parameters(model)
    data = engine.experiment(record, sensors=sensors, clean=True)
    noise = ce.Noise(**dict.fromkeys(engine.SENSORS[sensors], engine.SIGMA))
    near = pars.copy()
    for key, value in point["values"].items():
        near[key].set(float(np.clip(value, near[key].min, near[key].max)))
    fits = [ce.estimate(model, data, parameters=p, noise=noise, progress=False) for p in (near, pars)]
    fit = min(fits, key=lambda one: one.cost)
    screened = screen(fit, noise=engine.white(sensors))
    mu = min(point["mu"], float(np.sqrt(fit.cost)))
    here = told(screened.scores, place, size, mu=mu)
    there = told(at_the_truth(place.load, sensors), place, size)
    refitter = Refitter(model, pars, (data,), noise)
    refits = by_refits(refitter, fit, screened.scores, at_the_truth(place.load, sensors), place, size)
    return {
        "mu": mu,
        "mu of the yardstick": point["mu"],
        "mu linear": point["linear"],
        "mu of the fit": float(np.sqrt(fit.cost)),
        "at optimum": here,
        "at truth": there,
        "by refits": refits,
        "d": refits["d"],
        "theory": refits["class"],
        "separable": bool(mu >= WANTED and refits["d"] >= SEPARABLE),
    }


def by_refits(refitter, fit, scores, true_scores, place, size):
    """d of the nearest rivals by their refits to the record without noise, the least, and how many are below 3.3."""
    truth, there = truth_of(scores.candidates, place, size), truth_of(true_scores.candidates, place, size)
    own = scores.candidates[truth].key
    slope = size * float(np.sqrt(true_scores.information[there]))
    here, far = _nearest(scores, truth, float(np.sqrt(fit.cost))), _nearest(true_scores, there, slope)
    orders = [_order(near, own) for near in (here, far)]
    # from an optimum in a corner of the bounds a refit takes minutes, and ends no lower than from the page's values
    driven = any(fit.estimates[name].at_bound is not False for name in fit.free)
    least = min(
        _refit(refitter, fit, scores.candidates[truth], size, warm=warm, interval=interval)
        for warm in ((False,) if driven else (False, True))
        for interval in intervals_of(place)
    )
    left = {}
    for rank in range(max(map(len, orders))):
        if rank >= RIVALS and any(d >= SEPARATED for d in left.values()):
            break
        for key in dict.fromkeys(order[rank] for order in orders if rank < len(order)):
            name = "/".join(key[::-1])
            if name in left:
                continue
            costs = [fit.cost]
            if key in here and not driven:
                k = here[key][1]
                costs.append(
                    _refit(refitter, fit, scores.candidates[k], float(scores.amplitude[k]), warm=True)
                )
            if key in far:
                k = far[key][1]
                share = float(true_scores.correlation[there, k]) / float(np.sqrt(true_scores.information[k]))
                costs.append(_refit(refitter, fit, true_scores.candidates[k], slope * share))
            left[name] = float(np.sqrt(max(min(costs) - least, 0.0)))
    left = dict(sorted(left.items(), key=lambda pair: pair[1]))
    return {
        "left": float(np.sqrt(least)),
        "d": min(left.values(), default=float("inf")),
        "class": 1 + sum(d < SEPARATED for d in left.values()),
        "rivals": left,
    }


def intervals_of(place):
    """Multiple shooting, and single where the start's play would be lost by it."""
    return ("auto", "single") if place.effect == "backlash" else ("auto",)


def _order(near, own):
    """Rivals by some slopes, the nearest first: those nearer than AWAY, one at least."""
    order = sorted((key for key in near if key != own), key=lambda key: (near[key][0], key))
    return [key for number, key in enumerate(order) if near[key][0] < AWAY or number < 1]


def _nearest(scores, truth, mu):
    """key -> (d by slopes, candidate): of every effect at every port the point of its grid nearest to the truth."""
    found = {}
    for k in np.flatnonzero(scores.testable):
        d = float(separation(mu, scores.correlation[truth, k]))
        key = scores.candidates[k].key
        if key not in found or d < found[key][0]:
            found[key] = (d, int(k))
    return found


def _refit(refitter, fit, candidate, amplitude, *, warm=False, interval="auto"):
    """Chi-squared of the model with a candidate, from the optimum without it or from the page's values; never more
    than without it."""
    one = addition(candidate, amplitude)
    model = refitter.extended([one])
    options = {"noise": refitter.noise, "progress": False, "max_iterations": ITERATIONS, "interval": interval}
    with contextlib.suppress(CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
        pars = refitter.parameters_of(model, [one])
        made = ce.estimate(model, refitter.data, parameters=pars, warm=fit if warm else None, **options)
        return min(made.cost, fit.cost)
    return fit.cost


def told(scores, place, size, mu=None):
    """mu by the slopes, least d, size of the class and its names, those of the truth's own row; mu : the true one."""
    candidates = scores.candidates
    truth = truth_of(candidates, place, size)
    unit = float(np.sqrt(scores.information[truth]))
    slope = size * unit
    if mu is None:
        mu = slope
    others = [k for k, c in enumerate(candidates) if scores.testable[k] and c.key != candidates[truth].key]
    same = same_row(scores, truth)
    names = theoretical_class(scores, truth, mu / unit) if unit > 0 else [truth]
    return {
        "mu by slopes": slope,
        "d": float(separation(mu, scores.correlation[truth, others]).min()),
        "class": len(names),
        "names": ["/".join(candidates[k].key[::-1]) for k in names],
        "alike": sorted({candidates[k].key for k in same} | {candidates[truth].key}),
        "z": float(scores.z[truth]),
        "first": candidates[int(np.argmax(np.where(scores.testable, scores.statistic, -1)))].label,
    }


def same_row(scores, truth):
    """The testable candidates that are one row with the true one, under other names."""
    return np.flatnonzero(scores.testable & (np.abs(scores.correlation[truth]) > SAME_ROW)).tolist()


def theoretical_class(scores, truth, size):
    """One candidate of every effect that data of this kind cannot tell from a true one of the given size: those with
    d < SEPARATED (wrong in 5 % of records), the truth first."""
    d = separation(size * np.sqrt(scores.information[truth]), scores.correlation[truth])
    found = {scores.candidates[truth].key: truth}
    for k in np.argsort(d, kind="stable"):
        if scores.testable[k] and d[k] < SEPARATED:
            found.setdefault(scores.candidates[k].key, int(k))
    return list(found.values())


_AT_THE_TRUTH = {}


def at_the_truth(load, sensors):
    """Scores of the library on a record without effects at the true parameters."""
    if (load, sensors) not in _AT_THE_TRUTH:
        _AT_THE_TRUTH[load, sensors] = _at_the_truth(load, sensors)
    return _AT_THE_TRUTH[load, sensors]


def _at_the_truth(load, sensors):
    (record,) = engine.simulated([Case((), 1, 2)], load=load, rate=RATE)
    made = engine.model(sensors)
    data, start = engine.experiment(record, sensors=sensors), engine.first_state(record)
    null, _, _ = settle(
        made, [data], made.parameters(), np.array(list(engine.TRUTH.values())), {data.name: start},
        noise=engine.white(sensors), iterations=0,
    )  # fmt: skip
    candidates = library_candidates(null, [data], ce.effects.library())
    return score(compress(null, candidates, engine.white(sensors)))


def truth_of(candidates, place, size):
    """The candidate nearest to what was hidden."""
    own = [k for k, c in enumerate(candidates) if c.key == (place.effect, place.at)]

    def distance(k):
        c = candidates[k]
        if place.effect == "misfire":
            (cycle,) = place.details["cycles"]
            return abs(c.nuisance["first"] - cycle) + abs(c.nuisance["last"] - cycle)
        if place.effect == "backlash":
            return np.inf if c.size is None else abs(np.log(c.size / size))
        return sum(abs(c.nuisance[name] - value) for name, value in place.details.items())

    return min(own, key=distance)
