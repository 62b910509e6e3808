"""What theory allows for a hidden effect: how sure it is told from the others, and which ones it is confused with.

All of it is for a record without noise. Three answers stand side by side. By refits: every rival that could come near
is put into the model and refitted to the record; d^2 is what it leaves more than the true effect does, which is what
any method that refits can tell them apart by. By slopes (R and q) at the optimum of the fit without the effect, where
scores are taken; and at the true parameters, where the refits end. Slopes agree with the refits where the effect is
small. Where the fit without it was driven far they do not: what differs there may be alike at the truth.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "problems"))

import repair_engine as engine
import two_mass as page
from repair_detectable import WANTED
from simulator.hidden_runs import Case

import casadi_engine as ce
from casadi_engine.discrepancy.classes import clusters, separation, theoretical_class
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.gauss_newton import settle
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import screen

RATE = 1440.2
# Rivals that are refitted: so many by the scores, and so many by their likeness at the true parameters.
SEPARABLE, SEPARATED, RIVALS = 5.0, 3.3, 4
OPTIONS = {"interval": "auto", "initial": None, "method": "exact", "max_iterations": 40}


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
    refitter = Refitter(model, pars, (data,), noise, OPTIONS)
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
    """d of every rival by its refit to the record without noise, the least, and how many are below 3.3."""
    truth = truth_of(scores.candidates, place, size)
    own = scores.candidates[truth].key
    best = {}  # key -> its best candidate by the scores
    for k in np.argsort(-scores.drop, kind="stable"):
        if scores.testable[k]:
            best.setdefault(scores.candidates[k].key, int(k))
    there = truth_of(true_scores.candidates, place, size)
    near = {}  # key -> its candidate nearest to the true one at the true parameters
    for k in np.argsort(-np.abs(true_scores.correlation[there]), kind="stable"):
        near.setdefault(true_scores.candidates[k].key, int(k))
    rivals = dict.fromkeys([*list(best)[:RIVALS], *list(near)[:RIVALS]])
    left, leaves = {}, {own: fit.cost}
    for key in [own, *(key for key in rivals if key != own)]:
        tried = [(scores, best[key])] if key in best else []
        if key in near:
            tried.append((scores, _like(scores.candidates, true_scores.candidates[near[key]])))
        if key == own:
            tried = [(scores, truth)]
        costs = [fit.cost]
        for _, k in dict.fromkeys((id(s), k) for s, k in tried if k is not None):
            one = addition(scores.candidates[k], float(scores.amplitude[k]), float(scores.drop[k]))
            if key == own:
                one = addition(scores.candidates[k], size, float(scores.drop[k]))
            done = refitter(fit, [one])
            if done.converged:
                costs.append(done.cost)
        leaves[key] = min(costs)
    for key, cost in leaves.items():
        if key != own:
            left["/".join(key[::-1])] = float(np.sqrt(max(cost - leaves[own], 0.0)))
    left = dict(sorted(left.items(), key=lambda pair: pair[1]))
    return {
        "left": float(np.sqrt(leaves[own])),
        "d": min(left.values(), default=float("inf")),
        "class": 1 + sum(d < SEPARATED for d in left.values()),
        "rivals": left,
    }


def _like(candidates, other):
    """The candidate of the same label, or one of the same key."""
    own = [k for k, c in enumerate(candidates) if c.key == other.key]
    return next((k for k in own if candidates[k].label == other.label), own[0] if own else None)


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
