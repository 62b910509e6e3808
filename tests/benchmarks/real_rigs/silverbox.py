"""Silverbox, an electronic Duffing oscillator (Wigren and Schoukens 2013; ../shared/data/silverbox): what its rigs
share. m ÿ + d ẏ + k1 y + k3 y³ = u + offset; the models lack the cubic stiffness.

The generator's signal is band-limited (below 200 Hz), so the input between its samples is interpolated by that: twice
as many samples of it as of the output, which halve the residual against straight lines. The input has a mean of 6 mV
that the output does not show: an offset belongs to any model.
"""

import math

import numpy as np
from rigs_common import shared
from scipy.signal import resample_poly
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "mass, damper and spring per volt of the input",
    "natural frequency, damping ratio and gain, ports take accelerations",
    "millivolts and milliseconds",
)
STEP = 2**14 / 1e7  # s
OMEGA, ZETA, GAIN, OFFSET = 2 * math.pi * 70, 0.05, 1.0, 0.0  # start values
LENGTH, FINER = 1500, 2
MULTISINE, ARROW = 43_000, 36_000  # first samples


def build(writing=0, *, offset=True):
    b = ce.Blueprint("silverbox", time_unit="ms" if writing == 2 else None)
    (_mass_and_spring, _frequency, _milli)[writing](b, offset)
    m = b.model()
    return m, m.parameters()


def _mass_and_spring(b, offset):
    mass = b.parameter("m", 1 / GAIN / OMEGA**2, unit="s2", min=1e-7, max=1e-3)
    damping = b.parameter("d", 2 * ZETA / GAIN / OMEGA, unit="s", min=0, max=0.1)
    stiffness = b.parameter("k1", 1 / GAIN, unit="1", min=0.05, max=20)
    drift = b.parameter("offset", OFFSET, unit="V", min=-0.1, max=0.1) if offset else 0
    y, v = b.state("y", unit="V", scale=0.1), b.state("v", unit="V/s", scale=40)
    volts = b.input("u", unit="V", scale=0.05)
    mass_port = b.port("mass", "inertia", {"speed": v}, unit="V")
    spring = b.port("spring", "coupling", {"twist": y, "twist_rate": v, "stiffness": stiffness}, unit="V")
    b.ode("y", v)
    b.ode("v", (volts + drift - damping * v - stiffness * y + mass_port - spring) / mass)
    b.output("y", y, unit="V", scale=0.1)


def _frequency(b, offset):
    omega = b.parameter("w0", OMEGA, unit="rad/s", min=50, max=2000)
    zeta = b.parameter("zeta", ZETA, unit="1", min=0, max=1)
    gain = b.parameter("gain", GAIN, unit="1", min=0.05, max=20)
    drift = b.parameter("offset", OFFSET, unit="V", min=-0.1, max=0.1) if offset else 0
    y, v = b.state("y", unit="V", scale=0.1), b.state("v", unit="V/s", scale=40)
    volts = b.input("u", unit="V", scale=0.05)
    mass_port = b.port("mass", "inertia", {"speed": v}, unit="V/s2")
    spring = b.port("spring", "coupling", {"twist": y, "twist_rate": v, "stiffness": omega**2}, unit="V/s2")
    b.ode("y", v)
    b.ode("v", omega**2 * (gain * (volts + drift) - y) - 2 * zeta * omega * v + mass_port - spring)
    b.output("y", y, unit="V", scale=0.1)


def _milli(b, offset):
    mass = b.parameter("m", 1e6 / GAIN / OMEGA**2, unit="ms2", min=0.1, max=1e3)
    rate = b.parameter("decay", 2 * ZETA * OMEGA / 1e3, unit="1/ms", min=0, max=10)
    stiffness = b.parameter("k1", 1 / GAIN, unit="1", min=0.05, max=20)
    drift = b.parameter("offset", 1e3 * OFFSET, unit="mV", min=-100, max=100) if offset else 0
    y, v = b.state("y", unit="mV", scale=100), b.state("v", unit="mV/ms", scale=40)
    volts = b.input("u", unit="mV", scale=50)
    mass_port = b.port("mass", "inertia", {"speed": v}, unit="mV")
    spring = b.port("spring", "coupling", {"twist": y, "twist_rate": v, "stiffness": stiffness}, unit="mV")
    b.ode("y", v)
    b.ode("v", (volts + drift - stiffness * y + mass_port - spring) / mass - rate * v)
    b.output("y", y, unit="mV", scale=100)


def initial(writing=0):
    return {"y": 10.0, "v": 0.0} if writing == 2 else {"y": 0.01, "v": 0.0}


def record(name, first, length=LENGTH):
    margin = 200
    rows = {"skiprows": 1 + first - margin, "max_rows": length + 2 * margin}
    table = np.loadtxt(shared("silverbox", "SNLS80mV.csv"), delimiter=",", usecols=(0, 1), **rows)
    around = table[:, 0]
    fine = resample_poly(around, FINER, 1, window=("kaiser", 8.0))
    fine = fine[margin * FINER : (margin + length) * FINER - FINER + 1]
    sparse = np.full(len(fine), np.nan)
    sparse[::FINER] = table[margin : margin + length, 1]
    time = STEP / FINER * np.arange(len(fine))
    return ce.Experiment.from_arrays(
        name, time=time, units={"u": "V", "y": "V"}, inputs=("u",), u=fine, y=sparse
    )


def by_hand(records):
    estimation, fresh = ([_plain(one) for one in part] for part in records)
    return {name: fit(one, estimation, fresh) for name, one in _structures().items()}


def _plain(exp):
    y = exp["y"]
    return Record(y.time, exp["u"].values[:, None], np.where(y.mask, y.values, np.nan))


def _structures():
    def made(more=lambda y, p: 0.0, fixed=None, **starts):
        def rhs(x, u, p):
            # time in ms, so that both states are of one size
            offset = p.get("offset", 0.0)
            force = u[0] + offset - p["k1"] * x[0] + more(x[0], p)
            return 1e3 * np.array([x[1], (force - p["d"] * x[1]) / p["m"]])

        # where two starts had ended
        whole = {"m": [5.3], "d": [0.22], "k1": [1.0], "offset": [-0.005]} | starts
        whole = {name: values for name, values in whole.items() if name != fixed}
        return Structure(
            rhs,
            lambda x, u, p: x[0] + p.get("zero", 0.0),
            whole,
            lambda one: np.array([one.output[0], 0.0]),
            state_scale=0.02,
        )

    def cubic(y, p):
        return -p["k3"] * y**3

    def square(y, p):
        return -p["k3"] * y**3 - p["k2"] * y**2

    return {
        "nothing added": made(),
        "nothing added, no offset": made(fixed="offset"),
        "cubic stiffness": made(cubic, k3=[4.0]),
        "cubic stiffness, no offset": made(cubic, fixed="offset", k3=[4.0]),
        "cubic stiffness, offset of the output": made(cubic, k3=[4.0], zero=[0.002]),
        "cubic and quadratic stiffness": made(square, k3=[4.0], k2=[0.0]),
    }
