"""Future work (a): an analytic cylinder-pressure model, fitted to simulated and to real traces.

    python problems/thesis/pressure_model.py [--quick]

Where no pressure is measured the thesis wants the model of Eriksson and Andersson (SAE 2002-01-0371): compression and
expansion are polytropes, a Wiebe function leads from one to the other, and the ports blend into them. Its records are
not public: the traces here are simulated, by another burn law (a double exponential), and the real ones of a 196 cc
engine are taken where they lie beside the project. The model has no states; the sensor's offset is one.

A real sensor has an offset, which p_im and k_c cannot be told from: k_c is that of a motored record. What the real
ports do is not the model's, so that real traces are fitted while the valves are closed. E0NOLOAD1 lacks an edge of the
crank wheel beside the gap in each turn, so that its angles, counted from the edge after the gap, are one tooth low.
"""

import math

import numpy as np
import shared
from shared import BURN, DEG, GEOMETRY, Line, own_angle, pressure

import casadi_engine as ce

REAL = {"r": 0.0275, "L": 0.0842, "A_p": math.pi * 0.0677**2 / 4, "ratio": 8.5}
TRACES = shared.ROOT.parent / "shared" / "data" / "engine_tue"
TDC_DEG, TOOTH_DEG, EDGES = 243.7, 6.0, 58  # where the motored pressure peaks, after slot 0 of a 60 - 2 wheel
CLOSED = 140 * DEG  # from TDC, the valves are closed
NEAR = np.arange(-60, 90)


def trace_model(g):
    """One pressure [bar] over its angle, with the offset and the drift of a sensor."""
    b = ce.Blueprint("cylinder_pressure")
    p = {name: b.parameter(name, v, unit=u, min=low, max=high) for name, (v, u, low, high) in BURN.items()}
    x = b.parameter("x", 3.0, min=0, max=10)
    offset, angle = b.state("offset", unit="bar", scale=1.0), b.input("angle", unit="rad")
    b.ode("offset", b.parameter("drift", 0.0, unit="bar/s", min=-100, max=100))
    b.output("p", pressure(angle, p, x, g) / 1e5 + offset, unit="bar")
    return b.model()


def fit_trace(name, time, angle, values, g, absolute, known):
    """Fit one record; return (fit, peak error [%], peak place error [deg]) of the mean cycle, and its curves."""
    model = trace_model(g)
    parameters = model.parameters()
    for key, value in known.items():
        parameters.fix(key, value)
    parameters.fix("drift" if absolute else "p_em")
    base = 0.0 if absolute else np.median(values)  # with both ports open, about that of the ambient
    values = values if absolute else np.where(np.abs(angle) < CLOSED, values, np.nan)
    data = ce.Experiment.from_arrays(
        name, time=time, units={"angle": "rad", "p": "bar"}, angle=angle, p=values
    )
    start = {"offset": 0.0} if absolute else None
    fit = ce.estimate(model, data, parameters=parameters, initial=start, progress=False)
    trace = fit.traces[name]["p"]
    place = np.rint(np.interp(trace.time, time, angle) / DEG).astype(int)
    measured, modelled = (
        np.array([one[place == k].mean() for k in NEAR]) for one in (trace.measured, trace.simulated)
    )
    error = 100 * ((modelled.max() - base) / (measured.max() - base) - 1)
    return fit, float(error), int(NEAR[modelled.argmax()] - NEAR[measured.argmax()]), (measured, modelled)


def real_trace(name):
    """Times [s], own angles [rad], pressure [bar] of a real record."""
    with np.load(TRACES / f"{name}.npz") as arrays:
        time, theta, values = (arrays[key] for key in ("theta_time_s", "theta_deg", "p_rel_bar"))
        lost = EDGES - np.unique(arrays["edge_slot"] % 60).size
    theta = (theta - TDC_DEG + TOOTH_DEG * lost) * DEG
    theta = theta + (2 * math.pi if np.cos(theta[np.argmax(values)] / 2) < 0 else 0.0)
    return time, own_angle(theta), values


def spread(angle, values):
    """95 % interval of the place of the measured mean cycle's peak [deg], from cycles drawn again."""
    begins = np.flatnonzero(np.diff(np.rint(angle / DEG)) < 0) + 1
    cycles = [dict(zip(np.rint(a / DEG), v, strict=True)) for a, v in
              zip(np.split(angle, begins), np.split(values, begins), strict=True)]  # fmt: skip
    whole = np.array([[one[k] for k in NEAR] for one in cycles if {*NEAR} <= one.keys()])
    drawn = np.random.default_rng(0).integers(0, len(whole), (2000, len(whole)))
    return np.quantile(NEAR[whole[drawn].mean(axis=1).argmax(axis=1)], [0.025, 0.975])


def real_traces():
    """Peak and its place of the mean cycle of the real engine: name, errors, curves, interval, p_im [bar]."""
    if not (TRACES / "E0FULLOAD1.npz").is_file():
        return []
    cold = {"x": 0.0, "soc": 0.5, "dur": 3.0, "m": 6.0, "k_e": 1.3}  # no heat, and compression until late
    motored, *_ = fit_trace("motored", *real_trace("ENGINEOFF3"), REAL, False, cold)
    print(motored)
    found = []
    for name in ("E0FULLOAD1", "E0HALFLOAD1", "E0NOLOAD1"):
        trace = real_trace(name)
        fit, *errors = fit_trace(name, *trace, REAL, False, {"k_c": motored.values["k_c"]})
        found.append((name, *errors, spread(*trace[1:]), fit.values["p_im"] / 1e5))
    return found


def draw(curves, out):
    figure, axes = shared.panels(1, len(curves), width=3.6 * len(curves) + 1)
    for ax, (name, (measured, modelled)) in zip(axes[0], curves.items(), strict=True):
        ax.plot(NEAR, measured, color="0.6", linewidth=3, label="mean cycle")
        ax.plot(NEAR, modelled, color=shared.OURS, label="model")
        ax.set(xlabel="crank angle [deg]", ylabel="pressure (real: with offset) [bar]", title=name)
    axes[0, 0].legend(frameon=False)
    figure.savefig(out / "pressure_model.png", dpi=110)


def page(quick, out):
    made = shared.record(scatter_seed=105)
    angle, bars = own_angle(made["theta"]), made["p1"] / 1e5
    fit, peak, place, curve = fit_trace("simulated", made["time"], angle, bars, GEOMETRY, True, {})
    print(fit)
    real = [] if quick else real_traces()
    draw({"simulated": curve, **{one[0]: one[3] for one in real}}, out)
    lines = [
        Line("chapter 6 (a)", "an analytic pressure model", f"simulated trace: peak {peak:+.1f} %, {place:+d} deg",
             "within 5 % and 2 deg", abs(peak) < 5 and abs(place) <= 2),
        Line("chapter 6 (a)", "from a range of measurements", f"p_im {fit.values['p_im'] / 1e5:.3f} bar (0.553), "
             f"k_c {fit.values['k_c']:.3f} (1.33)", "what both laws share comes out right",
             abs(fit.values["p_im"] - 55275) < 300 and abs(fit.values["k_c"] - 1.33) < 0.01),
    ]  # fmt: skip
    for name, high, degrees, _, (low, top), intake in real:
        allowed = max(2.0, float(top - low) / 2)
        words = f"within 5 % and {allowed:.2g} deg" + "; from cycle to cycle the peak moves" * (allowed > 2)
        ours = f"real: {high:+.1f} %, {degrees:+d} deg; p_im {intake:.2f} bar"
        ours += f"; measured peak at {low:.0f} to {top:.0f} deg (95 %)"
        lines.append(Line("chapter 6 (a)", name, ours, words, abs(high) < 5 and abs(degrees) <= allowed))
    return lines


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "pressure_model", __doc__))
