"""Tables 4.6, 4.8 to 4.10 and Figure 4.15: engine orders, the resonance, and 1000 simulations with random C_el.

    python problems/thesis/engine_orders.py [--quick]

The thesis finds order amplitudes of the speed by FFT. The first order is largest at 1200 RPM, so the resonance is near
20 Hz; and over 1000 simulations with C_el drawn evenly from [1, 10] the first order spreads by 4.77, the main frequency
(order 2) hardly. Its records are not public; these are simulated, with cylinders that differ by 3 % (identical ones
make no first order). Amplitudes have another scale, so ratios are compared.

Ours: `ce.orders` fits all orders at once in the crank angle, with standard errors. The 1000 runs are analysed after 20
cycles, when their start on the orbit of C_el = 2.5 is forgotten. The receptance says the same without simulating, and a
run-up of a misfiring engine finds the resonance between the five speeds.
"""

import time
from dataclasses import dataclass

import numpy as np
import shared
from shared import Line

import casadi_engine as ce
from casadi_engine.model import receptance

MODEL = ce.two_mass(reciprocating_speed="measured")
TABLE_4_10 = {
    "first order": (0.4963, 2.3709, 0.8222, 0.3818),
    "main frequency": (5.9916, 6.3757, 6.2323, 0.1108),
}
SPEEDS = (1000, 1200, 1400, 1800, 2000)  # RPM, of Table 4.6


@dataclass(frozen=True)
class Falling:
    """A load [N m] that lets the engine speed up evenly, by `rate` [rad/s²]."""

    rate: float

    def __call__(self, seconds):
        return 57.0 - self.rate * (1 / 2.557 + 1 / 5.646 + 0.1541 * seconds)


def in_rpm(record, name):
    return shared.experiment(record, name).in_units({"omega": "rpm"})


def steady_and_run_up(out, quick):
    """Orders of five steady records and, two cycles at a time, of a run-up."""
    options = {"scatter_seed": 61, "noise_seed": 62, "rtol": 1e-9}
    found = ce.orders([in_rpm(shared.record(rpm=rpm, **options), f"{rpm} RPM") for rpm in SPEEDS])
    print(found)
    if quick:
        return found, None
    options = {"load": Falling(7.0), "duration": 14.0, "cycles": 400, "misfire": {2: "all"}, "rtol": 1e-8}
    run_up = shared.record(rpm=900, scatter_seed=63, **options)
    sweep = ce.orders(in_rpm(run_up, "run-up"), cycles=2)
    ce.plot(sweep, path=out / "engine_orders_run_up.png")
    return found, sweep


def simulated(drawn, cycles):
    """Amplitudes (count, 2) [RPM] of first order and main frequency over the last ten of so many cycles."""
    made = shared.record(rpm=1200, sigma=0.0, scatter=0.0, cycles=cycles, rate=1440.0, rtol=1e-9)
    start = dict(zip(("omega_eng", "omega_load", "twist"), made["states"][1:, 0], strict=True))
    data, rows = shared.experiment(made), []
    for value in drawn:
        one = ce.simulate(MODEL, data, parameters={"C_el": value}, initial=start)
        last = one.only("theta", "omega").cycles(cycles - 9, cycles).in_units({"omega": "rpm"})
        rows.append(ce.orders(last, orders=(1, 2)).amplitude[0])
    return np.array(rows)


def engine_and_model():
    """Largest relative error of orders 2, 4 and 6 of a crankshaft, of two masses fitted to another record of it."""
    paths = [shared.ROOT / "data" / "crankshaft" / f"{kind}_1200rpm.csv.gz" for kind in ("misfire", "normal")]
    misfire, normal = (ce.read_experiment(path, optional=("omega_load",)) for path in paths)
    model = ce.simulate(ce.estimate(MODEL, misfire, progress=False), normal)
    measured, modelled = (ce.orders(data, orders=(2, 4, 6)).amplitude for data in (normal, model))
    return np.abs(modelled / measured - 1).max()


def statistics(amplitudes):
    """Largest, mean and standard deviation over the smallest."""
    return np.array([amplitudes.max(), amplitudes.mean(), amplitudes.std()]) / amplitudes.min()


def draw(found, sweep, late, natural, out):
    figure, axes = shared.panels(1, 3, width=14, height=3.6)
    *bars, ax = axes[0]
    for one, amplitudes, name in zip(bars, late.T, TABLE_4_10, strict=True):
        one.hist(amplitudes, 30, color=shared.OURS)
        one.set(title=f"Figure 4.15: {name}", xlabel="amplitude [RPM]", ylabel="simulations")
    ax.plot(found.rpm, found.of(1), "o-", color=shared.OURS, label="steady records")
    if sweep is not None:
        ax.plot(sweep.rpm, sweep.of(1), ".", color=shared.MEASURED, label="run-up with misfire")
    ax.axvline(60 * natural, color="0.4", linestyle=":", label=f"natural: {natural:.2f} Hz")
    ax.set(title="Table 4.6: order 1", xlabel="engine speed [RPM]", ylabel="amplitude [RPM]", yscale="log")
    ax.legend(frameon=False, fontsize=7)
    figure.savefig(out / "engine_orders.png", dpi=110)


def compare_amplitudes(title, ways):
    rows = []
    for k, (name, (low, high, mean, spread)) in enumerate(TABLE_4_10.items()):
        rows.append([name, "published", f"{high / low:.3f}", f"{mean / low:.3f}", f"{spread / low:.3f}"])
        for way, values in ways.items():
            rows.append([name, way, *(f"{one:.3f}" for one in statistics(values[:, k]))])
    shared.print_table(title, ["amplitude", "way", "max/min", "mean/min", "std/min"], rows)


def page(quick, out):
    found, sweep = steady_and_run_up(out, quick)
    rigid, natural = MODEL.modes().frequencies_hz[[0, -1]]
    drawn = np.random.default_rng(415).uniform(1, 10, 100 if quick else 1000)
    begun = time.process_time()
    late = simulated(drawn, 30)
    seconds = time.process_time() - begun
    hz = np.array([20.0, 40.0])
    exact = np.array([np.abs(receptance(MODEL, hz, {"C_el": c}).values[:, 0, 0]) for c in (1, 10, *drawn)])
    ways = {"settled": late, "first ten cycles": simulated(drawn[:100], 10), "receptance": exact}
    compare_amplitudes(f"Table 4.10: {len(drawn)} simulations with C_el in [1, 10], {seconds:.1f} s", ways)
    draw(found, sweep, late, natural, out)
    (first, main), ideal = (statistics(values)[0] for values in late.T), exact[0] / exact[1]
    off = 100 * engine_and_model()
    rpm, peak = found.peak(1)
    took = f"{1000 * seconds / len(drawn):.0f} s" + (f", counted from {len(drawn)}" if quick else "")
    lines = [
        Line("Table 4.6", "first order largest at 1200 RPM = 20 Hz", f"{rpm:.0f} RPM, {peak:.1f} Hz", "the same",
             found.resonant[0] == 1 and abs(rpm - 1200) < 5),
        Line("(4.11)", "natural frequencies 0.04 and 20.34 Hz", f"{rigid:.2f} and {natural:.2f} Hz", "the same",
             f"{rigid:.2f} {natural:.2f}" == "0.04 20.34"),
        Line("Table 4.8", "orders 2, 4, 6 (values lost)", f"model within {off:.1f} %", "the same", off < 5),
        Line("Table 4.10", "first order: largest/smallest 4.777", f"{first:.2f}, by receptance {ideal[0]:.3f}",
             "the same", abs(ideal[0] - 4.777) < 0.01 and 3.5 < first < 4.8),
        Line("Table 4.10", "main frequency: largest/smallest 1.064", f"{main:.3f}, by receptance {ideal[1]:.3f}",
             "the same: C_el hardly matters", 1.04 < main < 1.06),
        Line("Table 4.10", "1000 runs", took, "-", seconds < 0.06 * len(drawn)),
    ]  # fmt: skip
    if sweep is not None:
        hz = np.linspace(18, 24, 601)
        top = hz[np.argmax(np.abs(receptance(MODEL, hz).values[:, 0, 0]))]
        words = f"run-up: first order largest at {sweep.peak(1)[1]:.1f} Hz, receptance at {top:.1f} Hz"
        lines.append(
            Line("beyond 4.6", "-", words, "finer than five speeds", abs(sweep.peak(1)[1] - top) < 1)
        )
    return lines


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "engine_orders", __doc__))
