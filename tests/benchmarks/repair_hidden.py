"""Hidden effects of known size: does the repair name them, and is the repaired model as good as the true structure?

`python tests/benchmarks/repair_hidden.py --work FOLDER [--seeds 8] [--first 0] [--jobs 2] [--sensors 1,2] [--table]`

The independent simulator hides one sharp effect at one port; sizes are 4 and 10 times the detectable one, which
`repair_detectable.py` finds without the package. A record is what a user has: one run to search in and a run of the
same plant at another load and speed to confirm on; the whole of `ce.repair` in its default settings is what a user
does. What it names is compared with the class that theory allows, at the optimum of the fit without the effect to a
record without noise; what it predicts with the best fit of the true structure to the same data, on the fresh ones.
It can be stopped and goes on where it was; a part of it covers all places first, one seed after the other.
"""

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "problems"))

import repair_engine as engine
import two_mass as page
from repair_detectable import PLACES, TIMES, all_keys, detectable
from repair_hidden_tables import tables
from repair_hidden_theory import intervals_of, theory_of
from simulator.hidden_runs import Case

import casadi_engine as ce
from casadi_engine.discrepancy.fresh import side
from casadi_engine.discrepancy.fresh_fits import held_fit
from casadi_engine.discrepancy.noise_choice import NoiseChoice
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.effects import Effect, library
from casadi_engine.errors import CasadiEngineError

RATE = 1440.2
# The fresh record: another load and another speed.
FRESH_LOAD, FRESH_SPEED = 0.7, 1400.0
ALPHA = 0.01
# Made by `repair_detectable.py --json` (five minutes); without the file it is made again.
SIZES = Path(__file__).parent / "repair_detectable.json"


def detectable_of(folder, keys):
    """key -> what `repair_detectable` found: kept beside this file, else worked out once."""
    store = engine.Store(folder, "detectable")
    known = json.loads(SIZES.read_text(encoding="utf-8")) if SIZES.exists() else {}
    for name in [f"{place.name}, {s}" for place, s in keys]:
        if name in known and name not in store.done():
            store.add(name, known[name])
    missing = [(place, s) for place, s in keys if f"{place.name}, {s}" not in store.done()]
    if missing:
        for (place, s), one in detectable(missing).items():
            store.add(f"{place.name}, {s}", asdict(one))
    return {(place, s): store.done()[f"{place.name}, {s}"] for place, s in keys}


def pieces_of(keys, found, seeds, times):
    """name -> (place, sensors, times, size, seed), seed by seed, mixed within a seed; and what is not testable."""
    pieces, left_out = {}, {}
    for seed in seeds:
        own = []
        for place, sensors in keys:
            one = found[place, sensors]
            for t in times:
                if str(t) in one["untestable"]:
                    left_out[f"{place.name}, {sensors}, {t}"] = one["untestable"][str(t)]
                    continue
                own.append((place, sensors, t, t * one["size"], seed))
        for k in np.random.default_rng(seed).permutation(len(own)):
            place, sensors, t, _, _ = own[k]
            pieces[f"{place.name}, {sensors}, {t}, {seed}"] = own[k]
    return pieces, left_out


# ---- records: all of a seed side by side, since the simulator is faster so


def records_of(folder, seed, pieces):
    """piece -> (record, fresh record) of one seed; kept as arrays in a file."""
    path = Path(folder) / f"records_{seed}.npz"
    if path.exists():
        with np.load(path) as file:
            made = _unpacked({key: file[key] for key in file.files})
        if set(pieces) <= set(made):
            return made
    made = {}
    for load in sorted({place.load for place, *_ in pieces.values()}):
        own = {name: piece for name, piece in pieces.items() if piece[0].load == load}
        plain = engine.simulated([_case(p, False) for p in own.values()], load=load, rate=RATE)
        fresh = engine.simulated(
            [_case(p, True) for p in own.values()], load=FRESH_LOAD * load, speed_rpm=FRESH_SPEED, rate=RATE
        )
        made |= dict(zip(own, zip(plain, fresh, strict=True), strict=True))
    np.savez_compressed(path, **{f"{n}|{k}|{key}": np.asarray(v) for n, both in made.items()
                                 for k, one in enumerate(both) for key, v in one.items()})  # fmt: skip
    return made


def _unpacked(arrays):
    made = {}
    for name, values in arrays.items():
        piece, k, key = name.split("|")
        made.setdefault(piece, ({}, {}))[int(k)][key] = values
    return made


def _case(piece, fresh):
    """A run: engines differ from seed to seed and from size to size, the noise from piece to piece.

    What happens once, a misfire or a load step, happens in the record alone.
    """
    place, sensors, times, size, seed = piece
    number = 1000 * times + 100 * (sensors - 1) + PLACES.index(place)
    effects = () if fresh and place.event else (place.hidden(size),)
    return Case(
        effects, 500_000 + 1000 * times + 2 * seed + fresh, 1_000_000 + 200_000 * seed + 2 * number + fresh
    )


# ---- one record


def one_piece(folder, name, place, sensors, times, size, seed, record, fresh):
    """What repair makes of one record, with theory's word and the true structure beside it."""
    model = engine.model(sensors)
    data = engine.experiment(record, sensors=sensors)
    other = engine.experiment(fresh, sensors=sensors, name="fresh")
    noise = ce.Noise(**dict.fromkeys(engine.SENSORS[sensors], engine.SIGMA))
    clock = time.process_time()
    found = ce.repair(
        model, data, parameters=page.parameters(model), fresh=other, noise=noise, alpha=ALPHA, progress=False
    )
    cpu = time.process_time() - clock
    row = {"seed": seed, "size": size, "cpu": cpu, "status": found.status, "verdict": found.verdict}
    row |= {
        "confirmed": found.confirmed,
        "effects": [_said(one) for one in found.effects],
        "withdrawn": [_said(one) for one in found.withdrawn],
        "unknown": None if found.unknown is None else found.unknown.sentence,
        "null": _side(found.null_fit),
        "rounds": [[list(map(list, r.proposals)), list(map(list, r.refits)), r.kept] for r in found.rounds],
        "best": [[r.label, r.z] for r in found.best_scores[:3]],
        "timing": dict(found.timing),
    }
    row["amplitude"] = _amplitude(found, place, size)
    idle = [one for one in map(_Named, found.effects) if one.event]
    row["after"] = _both(found.fit, other, sensors, idle)
    same = [(e.name, e.at) for e in found.effects] == [(place.effect, place.at)]
    rival = found.fit if same else None  # the best of the true structure cannot be worse
    row["true"] = _true_structure(place, size, model, data, other, noise, sensors, rival)
    theory_of(folder, place, sensors, times, size)  # kept in a file of its own
    row["cpu in all"] = time.process_time() - clock
    return row


class _Named:
    """A found effect, with its key, the name of its amplitude and whether it is an event of one record."""

    def __init__(self, effect):
        self.amplitude = next(iter(effect.parameters))
        self.key = self.amplitude.rpartition(".")[0]
        self.event = effect.name in ("misfire", "load_step")


def _said(effect):
    """Name, port, class and size of an effect found."""
    return {
        "name": effect.name,
        "at": effect.at,
        "members": [[m.name, m.at] for m in effect.members],
        "amplitude": [effect.amplitude.value, effect.amplitude.stderr],
        "values": dict(effect.values),
        "z": effect.z,
        "drop": effect.drop,
        "frequency": effect.selection_frequency,
    }


def _amplitude(found, place, size):
    """(value - truth)/stderr of the effect that is the right one, None without it."""
    for effect in found.effects:
        if (effect.name, effect.at) == (place.effect, place.at):
            value, stderr = effect.amplitude.value, effect.amplitude.stderr
            return None if not stderr else {"value": value, "stderr": stderr, "z": (value - size) / stderr}
    return None


def _side(fit):
    """chi2/N and the parameters of a fit."""
    return {
        "chi2/N": fit.cost / fit.n,
        "values": {name: fit.values[name] for name in engine.TRUTH},
        "at_bound": [name for name in fit.free if fit.estimates[name].at_bound is not False],
        "converged": fit.converged,
    }


def _both(fit, other, sensors, idle):
    """A fit on its own and on fresh data, where initial states alone are found: chi2/N and the residual tests, on the
    fresh data as they are, and for what errors of the parameters do not explain."""
    noise = engine.white(sensors)
    held = held_fit(fit, other, noise=noise, idle=idle)
    own, fresh = ce.validate(fit), ce.validate(held)
    white = side([(held, null_model(held))], NoiseChoice(noise), source=fit).whiteness_p["fresh"]
    return {
        **_side(fit),
        "fresh chi2/N": held.cost / held.n,
        "passed": own.passed,
        "fresh passed": fresh.passed,
        "fresh beside errors": min(white.values()) * len(white) >= ALPHA,
        "failed": [*own.failed, *fresh.failed],
    }


def true_model(model, place, size, data):
    """The model with the true effect's family at the true port, its parameters at the truth."""
    effect = next(one for one in library() if one.name == place.effect)
    numbers = dict(zip(model.parameter_names, map(float, model.parameter_vector(None)), strict=True))
    effect = effect.fitted(ce.effects.port_view(model, place.at), data, numbers)
    values = {effect.amplitude.name: size} | _details(place, effect)
    return model.with_effect(effect, at=place.at, values=values)


def _details(place, effect: Effect):
    if place.effect == "misfire":
        (cycle,) = place.details["cycles"]
        return {"first": cycle, "last": cycle}
    return {name: place.details[name] for name in effect.nuisance}


def _true_structure(place, size, model, data, other, noise, sensors, rival=None):
    """The best fit of the true structure to the same data, from the page's values and from the truth."""
    made = true_model(model, place, size, data)
    pars = page.parameters(model).extended(made)
    near = pars.copy()
    for key, value in engine.TRUTH.items():
        near[key].set(value)
    fits = [
        ce.estimate(made, data, parameters=p, noise=noise, interval=interval, progress=False)
        for p in (near, pars)
        for interval in intervals_of(place)
    ]
    if rival is not None:
        fits.append(rival)
    fit = min(fits, key=lambda one: (not one.converged, one.cost))
    name = next(n for n in fit.free if n.startswith(f"{place.at}.{place.effect}."))
    one = fit.estimates[name]
    found = _both(fit, other, sensors, [name] if place.event else [])
    return found | {
        "amplitude": [one.value, one.stderr],
        "z": (one.value - size) / one.stderr if one.stderr else None,
    }


# ---- the study


def run(folder, seeds, sensors, times, jobs, only=""):
    """Do what is not done yet; what is not testable is told."""
    keys = [key for key in all_keys(sensors) if only in key[0].name]
    found = detectable_of(folder, keys)
    store = engine.Store(folder, "hidden")
    untestable = engine.Store(folder, "untestable")
    for seed in seeds:
        pieces, left_out = pieces_of(keys, found, [seed], times)
        for name, why in left_out.items():
            if name not in untestable.done():
                untestable.add(name, why)
        done = store.done()
        for name in set(pieces) & set(done):  # where theory's file was thrown away
            theory_of(folder, *pieces[name][:4])
        missing = {name: piece for name, piece in pieces.items() if name not in done}
        if not missing:
            continue
        records = records_of(folder, seed, pieces)
        calls = [(folder, name, *piece, *records[name]) for name, piece in missing.items()]
        for name, row in _made(calls, jobs):
            store.add(name, row)


def _named_piece(*args):
    try:
        return args[1], one_piece(*args)
    except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError) as error:
        return args[1], {
            "failed": repr(error)
        }  # a record that breaks the repair is told, and not the end of the study


def _made(calls, jobs):
    """(name, row) of every call as it comes."""
    if jobs == 1:
        return (_named_piece(*args) for args in calls)
    from joblib import Parallel, delayed

    return Parallel(n_jobs=jobs, return_as="generator_unordered")(delayed(_named_piece)(*a) for a in calls)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", required=True)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--sensors", default="1,2")
    parser.add_argument("--times", default=",".join(map(str, TIMES)))
    parser.add_argument("--only", default="", help="places whose name holds this")
    parser.add_argument("--table", action="store_true", help="the tables of what is done, without going on")
    chosen = parser.parse_args()
    if not chosen.table:
        sensors = tuple(int(s) for s in chosen.sensors.split(","))
        times = [int(t) for t in chosen.times.split(",")]
        seeds = range(chosen.first, chosen.first + chosen.seeds)
        run(chosen.work, seeds, sensors, times, chosen.jobs, chosen.only)
    print(tables(*(engine.Store(chosen.work, name).done() for name in ("hidden", "theory", "untestable"))))


if __name__ == "__main__":
    main()
