"""Hidden effects of known size: does the library name them?

`python tests/benchmarks/repair_hidden.py --work FOLDER [--seeds 8] [--jobs 2] [--sensors 1,2] [--scores]`

The independent simulator hides one sharp effect at one port; sizes are 4 and 10 times the detectable one, which
`repair_detectable.py` finds without the package. Every record goes through what `ce.repair` does for the first effect:
the fit within the bounds of problems/two_mass.py from four starts, the screen at 1 %, the refits of its proposals, the
class. It is compared with the class that theory allows at that size, from R at the true parameters alone.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "problems"))

import repair_engine as engine
import two_mass as page
from repair_detectable import PLACES, detectable_sizes
from simulator.hidden_runs import Case

import casadi_engine as ce
from casadi_engine.discrepancy.classes import clusters, separation, theoretical_class
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.gauss_newton import settle
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.refit import Refitter
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.search import Search, members_of, proposals

TIMES = (4, 10)
PIECE = 1
RATE, EVERY = 1440.2, 2  # every second sample of those that the detectable sizes are worked out for
STARTS = 4
OPTIONS = {"interval": "auto", "initial": None, "method": "exact", "max_iterations": 200}
_AT_THE_TRUTH = {}


def sizes_of(folder, sensors):
    """place name -> detectable size, worked out once."""
    store = engine.Store(folder, "detectable")
    if str(sensors) not in store.done():
        store.add(str(sensors), detectable_sizes(sensors, every=EVERY)[0])
    return store.done()[str(sensors)]


def one_piece(name, sensors, times, detectable, seeds, refits):
    """Records of one place and size: what was said of each."""
    place = next(p for p in PLACES if p.name == name)
    size = times * detectable
    cases = [
        Case((place.hidden(size),), 500_000 + 1000 * times + s, 600_000 + 1000 * times + s) for s in seeds
    ]
    records = engine.simulated(cases, load=place.load, rate=RATE)
    return [one_record(record, place, size, sensors, refits) for record in records]


def one_record(record, place, size, sensors, refits):
    """The fit, the screen and the class of one record, as ``ce.repair`` makes them."""
    clock = time.process_time()
    data, model, noise = engine.experiment(record, sensors=sensors), engine.model(sensors), noise_of(sensors)
    pars = page.parameters(model)
    fit = ce.estimate(model, data, parameters=pars, noise=noise, starts=STARTS, progress=False)
    screens = []

    def scores(fit):
        screens.append(screen(fit))
        return screens[-1]

    search = Search(Refitter(model, pars, (data,), noise, OPTIONS), scores, 1, lambda _: None)
    if fit.converged and refits:
        search.run(fit)
    screened = screens[0] if screens else screen(fit)
    order, candidates = screened.order, screened.candidates
    said, amplitude = (), None
    if len(search.stations) > 1:
        last = search.stations[-1]
        lead, said = last.lead, [(m.name, m.at) for m in last.members]
        found = last.fit.estimates[last.effects[-1].amplitude]
        amplitude = [found.value, found.stderr]
    elif not refits and screened.significant:
        lead = proposals(screened)[0]
        members = members_of(screened, lead, {lead: float(screened.scores.drop[lead])})
        said = [(m.name, m.at) for m in members]
    truth = truth_of(candidates, place, size)
    theory = theory_of(place, size, sensors)
    alike = theory.pop("alike")
    return {
        **theory,
        "mu at the fit": size * float(np.sqrt(screened.scores.information[truth])),
        "theory at the fit": len(theoretical_class(screened.scores, truth, size)),
        "z": float(screened.scores.z[truth]),
        "converged": fit.converged,
        "chi2/N": fit.cost / fit.n,
        "values": {n: fit.values[n] for n in engine.TRUTH},
        "alarm": bool(screened.significant),
        "score lead": candidates[order[0]].label,
        "score right": candidates[order[0]].key in alike,
        "lead": candidates[lead].label if said else None,
        "right": bool(said) and said[0] in alike,
        "members": ["/".join(m[::-1]) for m in said],
        "inside": bool(alike & set(said)),
        "rounds": [[list(r.refits), r.kept] for r in search.rounds],
        "amplitude": amplitude if said and said[0] == (place.effect, place.at) else None,
        "cpu": time.process_time() - clock,
    }


def noise_of(sensors):
    """The level as it is known to be."""
    return ce.Noise(**dict.fromkeys(engine.SENSORS[sensors], engine.SIGMA))


def at_the_truth(load, sensors):
    """Scores of the library on a record without effects at the true parameters: the theory's rows."""
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


def theory_of(place, size, sensors):
    """What theory allows at this size: mu, the least separation d, how long the class is; and the truth's own row."""
    scores = at_the_truth(place.load, sensors)
    candidates = scores.candidates
    truth = truth_of(candidates, place, size)
    mu = size * float(np.sqrt(scores.information[truth]))
    others = [k for k, c in enumerate(candidates) if scores.testable[k] and c.key != candidates[truth].key]
    same = next((row for row in clusters(scores) if truth in row), [truth])
    return {
        "mu": mu,
        "d": float(separation(mu, scores.correlation[truth, others]).min()),
        "theory": len(theoretical_class(scores, truth, size)),
        "alike": {candidates[k].key for k in same} | {candidates[truth].key},
    }


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


def stem(refits):
    """Name of the study's file."""
    return "hidden" if refits else "hidden_scores"


def table(folder, refits):
    """Markdown: pooled by sensors and size, and per effect."""
    found = {}
    for piece, rows in engine.Store(folder, stem(refits)).done().items():
        name, sensors, times, _ = piece.rsplit(", ", 3)
        found.setdefault((name, int(sensors), int(times)), []).extend(rows)
    out = [
        "| sensors | size | records | named right, or in a class at most 1.5 times theory's | by scores alone first"
        " | single wrong name | separable (d >= 5): single right name |",
        "|---|---|---|---|---|---|---|",
    ]
    for sensors in (1, 2):
        for times in TIMES:
            rows = [r for (_, s, t), own in found.items() if (s, t) == (sensors, times) for r in own]
            if rows:
                out.append(f"| {sensors} | {times} x | {' | '.join(cells(rows))} |")
    rows = [r for own in found.values() for r in own]
    out += [f"| all | | {' | '.join(cells(rows))} |", ""]
    out += ["| effect | " + out[0].partition("| size | ")[2], "|---|---|---|---|---|---|"]
    for effect in dict.fromkeys(p.effect for p in PLACES):
        rows = [r for (name, _, _), own in found.items() if name.startswith(effect + " ") for r in own]
        if rows:
            out.append(f"| {effect} | {' | '.join(cells(rows))} |")
    cpu = np.median([r["cpu"] for own in found.values() for r in own])
    out += ["", f"{cpu:.2f} s CPU a record (median)"]
    return "\n".join(out)


def good(row):
    """Named right, or in a class not larger than theory's by more than half."""
    single = row["right"] and len(row["members"]) == 1
    return single or (row["inside"] and len(row["members"]) <= 1.5 * row["theory"])


def cells(rows):
    """The columns of the table."""

    def share(hits, of):
        return f"{hits}/{of}" + (f" = {100 * hits / of:.1f} %" if of else "")

    apart = [r for r in rows if r["d"] >= 5 and r["theory"] == 1]
    wrong = sum(len(r["members"]) == 1 and not r["inside"] for r in rows)
    return [
        str(len(rows)),
        share(sum(good(r) for r in rows), len(rows)),
        share(sum(r["score right"] for r in rows), len(rows)),
        share(wrong, len(rows)),
        share(sum(r["right"] and len(r["members"]) == 1 for r in apart), len(apart)),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", required=True)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--sensors", default="1,2")
    parser.add_argument("--times", default="4,10")
    parser.add_argument("--only", default="")
    parser.add_argument("--scores", action="store_true", help="classes from the scores alone, without refits")
    chosen = parser.parse_args()
    refits = not chosen.scores
    store, pieces = engine.Store(chosen.work, stem(refits)), {}
    for first in range(0, chosen.seeds, PIECE):  # a few of everything first
        for sensors in [int(s) for s in chosen.sensors.split(",")]:
            sizes = sizes_of(chosen.work, sensors)
            for place in PLACES:
                if place.sensors > sensors or chosen.only not in place.name:
                    continue
                for times in [int(t) for t in chosen.times.split(",")]:
                    if times * sizes[place.name] > place.most:  # no engine has so much of it
                        continue
                    seeds = range(first, min(first + PIECE, chosen.seeds))
                    name = f"{place.name}, {sensors}, {times}, {first}"
                    pieces[name] = (place.name, sensors, times, sizes[place.name], seeds, refits)
    engine.run_pieces(store, pieces, one_piece, jobs=chosen.jobs)
    print(table(chosen.work, refits))


if __name__ == "__main__":
    main()
