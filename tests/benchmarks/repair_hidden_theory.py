"""What theory allows for a hidden effect: how sure it is told from the others, and which ones it is confused with.

Scores are calibrated at the optimum of the fit without the effect, so that is where R and q are taken: from the fit
to a record without noise. Beside it stands what they are at the true parameters.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import repair_engine as engine
import two_mass as page
from repair_detectable import WANTED
from simulator.hidden_runs import Case

import casadi_engine as ce
from casadi_engine.discrepancy.classes import clusters, separation, theoretical_class
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.gauss_newton import settle
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import screen

RATE = 1440.2
SEPARABLE = 5.0


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
    (record,) = engine.simulated([Case((place.hidden(size),), 1, 2)], load=place.load, rate=RATE, sigma=0.0)
    model = engine.model(sensors)
    pars = page.parameters(model)
    for key, value in point["values"].items():
        pars[key].set(float(np.clip(value, pars[key].min, pars[key].max)))
    data = engine.experiment(record, sensors=sensors, clean=True)
    noise = ce.Noise(**dict.fromkeys(engine.SENSORS[sensors], engine.SIGMA))
    fit = ce.estimate(model, data, parameters=pars, noise=noise, progress=False)
    scores = screen(fit, noise=engine.white(sensors)).scores
    here = told(scores, place, size, mu=point["mu"])
    there = told(at_the_truth(place.load, sensors), place, size)
    return {
        "mu": point["mu"],
        "mu linear": point["linear"],
        "mu of the fit": float(np.sqrt(fit.cost)),
        "at optimum": here,
        "at truth": there,
        "d": here["d"],
        "theory": here["class"],
        "separable": bool(point["mu"] >= WANTED and here["d"] >= SEPARABLE),
    }


def told(scores, place, size, mu=None):
    """mu by the slopes, least d, size of the class and its names, those of the truth's own row; mu : the true one."""
    candidates = scores.candidates
    truth = truth_of(candidates, place, size)
    unit = float(np.sqrt(scores.information[truth]))
    slope = size * unit
    if mu is None:
        mu = slope
    others = [k for k, c in enumerate(candidates) if scores.testable[k] and c.key != candidates[truth].key]
    same = next((row for row in clusters(scores) if truth in row), [truth])
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
