"""How small a hidden effect can be found, without the package: refits of the null plant to the independent simulator.

A record of the simulator with an effect of some size, without noise, is fitted by the plant without effects
(`repair_null_plant.py`: iterated, within a user's bounds). What is left has the norm mu in units of the noise; the
detectable size is where mu = c_alpha + 1.645, found with a power of 95 %. It is sought on this curve itself, since a
curved refit takes up far more of some effects than a linear one. Where no size that makes sense is left over so far,
or where at 4 or 10 times the detectable size nothing is left that could be detected, the place is not testable here.

`python tests/benchmarks/repair_detectable.py [--json FILE]` prints the table.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from repair_null_plant import NAMES, refitted
from simulator import hidden
from simulator.hidden_runs import Case, simulate_hidden

# Twice the rate of the studies' records: the null plant takes the samples between as the middles of its steps.
RATE = 2880.4
THRESHOLD, POWER = 3.75, 1.645
WANTED = THRESHOLD + POWER
TIMES = (4, 10)
_CLOSE, _ROUNDS = 0.02, 12


@dataclass(frozen=True)
class Place:
    """An effect at a port: its details, a size to begin with, the largest that makes sense, the sensors needed."""

    effect: str
    at: str
    start: float
    most: float
    details: dict = field(default_factory=dict, hash=False)
    sensors: int = 1
    load: float = 57.0

    @property
    def event(self):
        """True for what happens once, in one record."""
        return self.effect in ("misfire", "load_step")

    @property
    def name(self):
        """``effect at port``."""
        return f"{self.effect} at {self.at}"

    def hidden(self, size):
        """The simulator's effect."""
        return hidden(self.effect, self.at, size, **self.details)


# Viscous friction at the engine and in the coupling is what the parameters C_eng and C_el are: nothing to be found.
PLACES = (
    Place("coulomb_friction", "engine", 1.0, 40),
    Place("coulomb_friction", "load", 1.0, 40),
    Place("coulomb_friction", "coupling", 0.5, 40),
    Place("viscous_friction", "load", 0.01, 0.4),
    Place("quadratic_drag", "engine", 1e-4, 3e-3),
    Place("quadratic_drag", "load", 1e-4, 3e-3),
    Place("stribeck_friction", "engine", 1.0, 60, {"fading": 140.0}),
    Place("stribeck_friction", "load", 1.0, 60, {"fading": 140.0}),
    Place("constant_torque", "engine", 1.0, 40),
    Place("constant_torque", "load", 1.0, 40),
    Place("cubic_stiffness", "coupling", 2e4, 2e6),
    Place("backlash", "coupling", 3e-4, 0.03, load=5.0),  # at 57 N m the coupling never unloads
    Place("misfire", "cylinder_2", 0.1, 1.0, {"cycles": (4,)}),
    Place("misfire", "cylinder_3", 0.1, 1.0, {"cycles": (7,)}),
    Place("cylinder_imbalance", "cylinder_1", 0.01, 0.5),
    Place("cylinder_imbalance", "cylinder_4", 0.01, 0.5),
    Place("load_step", "engine", 1.0, 40, {"time": 0.437}),
    Place("load_step", "load", 1.0, 40, {"time": 0.437}),
    Place("sensor_offset", "sensor_omega", 0.1, 20),
    Place("sensor_delay", "sensor_omega", 1e-5, 2e-3),
    Place("sensor_offset", "sensor_omega_load", 0.1, 20, sensors=2),
    Place("sensor_delay", "sensor_omega_load", 1e-5, 2e-3, sensors=2),
)


@dataclass(frozen=True)
class Point:
    """A refit at one size; values : parameters of the null plant there; at_bound : those at a user's bounds."""

    size: float
    mu: float
    linear: float
    values: dict
    at_bound: tuple
    converged: bool


@dataclass(frozen=True)
class Detectable:
    """A place with some sensors: its detectable size (None: never), the curve, and times -> why it is not testable."""

    size: float | None
    curve: tuple
    points: dict
    untestable: dict


def clean_records(effects, load, *, seed=0):
    """Records without noise, with and without effects: one engine, ten cycles."""
    cases = [Case(tuple(e), seed, 0) for e in effects]
    return simulate_hidden("two_mass", cases, rate=RATE, duration=1.0, sigma=0.0, load=load)


def points_at(asked, warm=None):
    """(place, sensors) -> Point, for asked : (place, sensors) -> size; warm : the same -> parameters of a start."""
    found = {}
    for load in sorted({place.load for place, _ in asked}):
        own = [key for key in asked if key[0].load == load]
        sizes = sorted({(key[0].name, asked[key]) for key in own})
        named = {place.name: place for place, _ in own}
        made = clean_records([(named[name].hidden(size),) for name, size in sizes], load)
        records = [made[sizes.index((place.name, asked[place, s]))] for place, s in own]
        start = {r: (warm or {})[key] for r, key in enumerate(own) if key in (warm or {})}
        for key, left in zip(own, refitted(records, [s for _, s in own], start), strict=True):
            found[key] = Point(asked[key], **asdict(left))
    return found


def detectable(keys):
    """(place, sensors) -> Detectable, all keys side by side: the secant rule on log mu against log size, bracketed."""
    curves = {key: {} for key in keys}

    def look(asked):
        warm = {k: _parameters(min(curves[k].values(), key=lambda p: abs(np.log(p.size / s))))
                for k, s in asked.items() if curves[k]}  # fmt: skip
        for key, point in points_at(asked, warm).items():
            curves[key][point.size] = point

    look({key: key[0].start for key in keys})
    look({key: key[0].most for key in keys})
    for _ in range(_ROUNDS):
        asked = {key: s for key in keys if (s := _next(list(curves[key].values()), key[0].most)) is not None}
        if not asked:
            break
        look(asked)
    sizes = {key: _reached(list(curves[key].values())) for key in keys}
    for times in TIMES:
        asked = {k: times * s for k, s in sizes.items() if s is not None and times * s <= k[0].most}
        look(asked)
    return {key: _answer(key, sizes[key], curves[key]) for key in keys}


def _parameters(point):
    return np.array([point.values[name] for name in NAMES])


def _reached(points):
    """The smallest size at which mu is as wanted, None if there is none."""
    return min((p.size for p in points if abs(p.mu / WANTED - 1) < _CLOSE), default=None)


def _next(points, most):
    """The next size to look at, None where the curve needs no further one."""
    if _reached(points) is not None:
        return None
    points = sorted(points, key=lambda p: p.size)
    above = next((p for p in points if p.mu > WANTED), None)
    below = [p for p in points if p.mu < WANTED and (above is None or p.size < above.size)]
    if above is None:
        return None
    if not below:
        return above.size * max(WANTED / above.mu, 0.02)
    under = below[-1]
    slope = np.log(above.mu / under.mu) / np.log(above.size / under.size)
    guess = np.log(under.size) + np.log(WANTED / under.mu) / max(slope, 1e-3)
    low, high = np.log(under.size), np.log(above.size)
    inside = 0.05 * (high - low)
    return float(min(np.exp(np.clip(guess, low + inside, high - inside)), most))


def _answer(key, size, curve):
    place, _ = key
    largest = curve[place.most]
    if size is None:
        why = (
            f"mu is {largest.mu:.2g} at {place.most:g}, the largest size that makes sense"
            if largest.mu < WANTED
            else "mu jumps over the wanted value"
        )
        return Detectable(None, _sorted(curve), {}, dict.fromkeys(TIMES, why))
    points, untestable = {1: curve[size]}, {}
    for times in TIMES:
        if times * size > place.most:
            untestable[times] = (
                f"{times * size:.3g} is more than {place.most:g}, the largest that makes sense"
            )
        elif curve[times * size].mu < WANTED:
            point = curve[times * size]
            bound = f" with {', '.join(point.at_bound)} at a bound" if point.at_bound else ""
            untestable[times] = f"the curve falls back: mu is {point.mu:.2g}{bound}"
        else:
            points[times] = curve[times * size]
    return Detectable(size, _sorted(curve), points, untestable)


def _sorted(curve):
    return tuple(curve[size] for size in sorted(curve))


def all_keys(sensors=(1, 2), places=PLACES):
    """(place, sensors) of all places that these sensors reach."""
    return [(place, s) for s in sensors for place in places if place.sensors <= s]


def error_of_the_method():
    """mu of records without effects: what the null plant's integration leaves."""
    found = 0.0
    for load in sorted({place.load for place in PLACES}):
        (record,) = clean_records([()], load)
        found = max(found, *(left.mu for left in refitted([record, record], [1, 2])))
    return found


def table(found):
    """Markdown: detectable sizes; mu at 1, 4 and 10 times, of the iterated refit and of one linear refit."""
    out = [
        "| place | sensors | detectable | largest | mu at 1, 4, 10 x | by one linear refit | at bounds, not testable |",
        "|---|---|---|---|---|---|---|",
    ]
    for (place, sensors), one in found.items():
        mu = ", ".join(f"{p.mu:.3g}" for p in one.points.values())
        linear = ", ".join(f"{p.linear:.3g}" for p in one.points.values())
        said = [f"{t} x: {', '.join(p.at_bound)}" for t, p in one.points.items() if p.at_bound]
        said += [f"{t} x not testable: {why}" for t, why in one.untestable.items()]
        if one.size is None:
            said = [f"not testable: {one.untestable[TIMES[0]]}"]
        size = "-" if one.size is None else f"{one.size:.4g}"
        out.append(
            f"| {place.name} | {sensors} | {size} | {place.most:g} | {mu} | {linear} | {'; '.join(said)} |"
        )
    return "\n".join(out)


def to_json(found):
    """Plain data of the answer without the curve, by "place, sensors"."""
    return {
        f"{place.name}, {sensors}": {k: v for k, v in asdict(one).items() if k != "curve"}
        for (place, sensors), one in found.items()
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--sensors", default="1,2")
    chosen = parser.parse_args()
    sensors = tuple(int(s) for s in chosen.sensors.split(","))
    found = detectable([key for key in all_keys(sensors) if chosen.only in key[0].name])
    if chosen.json:
        lines = [f" {json.dumps(name)}: {json.dumps(one)}" for name, one in to_json(found).items()]
        chosen.json.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(table(found))
    print(f"\nmu of records without effects: {error_of_the_method():.2g}")


if __name__ == "__main__":
    main()
