"""Cascaded tanks (Schoukens, Mattsson, Wigren and Noël 2016; ../shared/data/tanks): a pump fills the upper tank, which
empties into the lower one, by the square root of the level; the lower level is measured.

The model lacks the overflow at 10 V: what leaves the upper tank over its edge comes partly into the lower one. No
effect of the library at one port is that; "unnamed" is right, and so is an effect between the two tanks. By hand an
offset of the pump goes with it (without it the share that comes into the lower tank is above one).
"""

import casadi as ca
import numpy as np
from rigs_common import shared
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "a factor for each flow, volts and seconds",
    "time constants at a level of 5 V, levels in shares of it",
    "a factor for each flow, per minute",
)
truth = (set(), {"upper_to_lower.overflow"}, {"upper_to_lower.overflow", "upper.constant_torque"})
same = "overflow, constant inflow"
NULL = {
    "first": [0.54, 0.7],
    "second": [0.9, 1.15],
    "pump": [0.75, 1.1],
}  # of the fit by hand, 10 s as the unit of time
FIRST, SECOND, PUMP, SPAN = 0.05, 0.05, 0.05, 10.0  # start values; V


def build(writing=0):
    b = ce.Blueprint("tanks", time_unit="min" if writing == 2 else None)
    (_factors, _time_constants, _minutes)[writing](b)
    m = b.model()
    return m, m.parameters()


def root(level, smallest=1e-3):
    """Square root of a level, as flat as a parabola below an empty tank."""
    return ca.sqrt(ca.fmax(level, smallest))


def _factors(b, *, minute=1.0):
    first = b.parameter("k1", FIRST * minute, min=1e-3 * minute, max=minute)
    second = b.parameter("k3", SECOND * minute, min=1e-3 * minute, max=minute)
    pump = b.parameter("k4", PUMP * minute, min=1e-3 * minute, max=minute)
    upper, lower = b.state("upper", unit="V", scale=5), b.state("lower", unit="V", scale=5)
    volts = b.input("u", unit="V")
    rate = "V/min" if minute > 1 else "V/s"
    into_upper = b.port("upper", "inertia", {"speed": upper}, unit=rate)
    into_lower = b.port("lower", "inertia", {"speed": lower}, unit=rate)
    b.ode("upper", pump * volts - first * root(upper) + into_upper)
    b.ode("lower", first * root(upper) - second * root(lower) + into_lower)
    b.output("y", lower, unit="V", scale=5)


def _minutes(b):
    _factors(b, minute=60.0)


def _time_constants(b):
    level = 5.0
    first = b.parameter("tau1", level**0.5 / FIRST, unit="s", min=1, max=1e4)
    second = b.parameter("tau2", level**0.5 / SECOND, unit="s", min=1, max=1e4)
    pump = b.parameter("fill", level / PUMP, unit="V s", min=1, max=1e4)
    upper, lower = b.state("upper", unit="1"), b.state("lower", unit="1")
    volts = b.input("u", unit="V")
    into_upper = b.port("upper", "inertia", {"speed": upper}, unit="1/s")
    into_lower = b.port("lower", "inertia", {"speed": lower}, unit="1/s")
    least = 1e-3 / level
    b.ode("upper", volts / pump - root(upper, least) / first + into_upper)
    b.ode("lower", root(upper, least) / first - root(lower, least) / second + into_lower)
    b.output("y", level * lower, unit="V", scale=5)


def initial(writing=0):
    return {"upper": 1.0, "lower": 1.0} if writing == 1 else {"upper": 5.0, "lower": 5.0}


def records():
    table = np.genfromtxt(shared("tanks", "tanks.csv"), delimiter=",", skip_header=1, usecols=(0, 1, 2, 3))
    return tuple(
        [_record(name, table[:, k], table[:, 2 + k])] for k, name in enumerate(("estimation", "validation"))
    )


def _record(name, u, y, every=1):
    time = 4.0 * every * np.arange(len(y[::every]))
    # the pump's voltage holds from sample to sample
    mean = u[: len(time) * every].reshape(-1, every).mean(axis=1)
    made = ce.Experiment.from_arrays(
        name, time=time, units={"u": "V", "y": "V"}, hold={"u": "zero", "y": "first"}, u=mean, y=y[::every]
    )
    return made.masked("y", y[::every] < SPAN)  # the sensor reads no more


def by_hand():
    estimation, fresh = (
        [Record(e["y"].time, e["u"].values[:, None], e["y"].values, held=True) for e in part]
        for part in records()
    )
    return {name: fit(one, estimation, fresh) for name, one in _structures().items()}


def _structures():
    def made(*, over=False, **starts):
        def rhs(x, u, p):
            # 10 s as the unit of time
            upper, lower = (np.sqrt(np.maximum(one, 1e-3)) for one in x)
            filled = (
                p["pump"] * u[0] + p.get("into_upper", 0) - p["first"] * upper - p.get("drag", 0) * x[0] ** 2
            )
            moved = p["first"] * upper - p["second"] * lower + p.get("into_lower", 0)
            if over:
                spilled = np.where(x[0] >= SPAN, np.maximum(filled, 0), 0)
                filled, moved = filled - spilled, moved + p.get("share", 0) * spilled
                moved = np.where((x[1] >= SPAN) & (moved > 0), 0, moved)
            return 0.1 * np.array([filled, moved])

        def level(x, u, p):
            return np.minimum(x[1], SPAN) if over else x[1]

        # where three starts had ended
        ended = {"first": [0.47] * 2, "second": [0.46] * 2, "pump": [0.39] * 2} if over else NULL
        whole = {**ended, **starts}
        return Structure(rhs, level, whole, lambda one: np.repeat(one.output[0], 2), state_scale=1.0)

    none, share = [0.0] * 2, [0.9, 1.7]
    return {
        "nothing added": made(),
        "overflow that is lost": made(over=True),
        "overflow": made(over=True, share=share),
        "constant inflow": made(into_upper=none),
        "constant inflows": made(into_upper=none, into_lower=none),
        "drag of the upper level": made(drag=[0.001] * 2),
        "overflow, constant inflow": made(over=True, share=share, into_upper=none),
        "overflow, constant inflows": made(over=True, share=share, into_upper=none, into_lower=none),
    }
