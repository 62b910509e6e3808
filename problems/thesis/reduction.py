"""Section 4.3.3: two masses suffice below 300 Hz. From modes, from receptances, and from responses.

    python problems/thesis/reduction.py [--quick]

The thesis finds no mode of the crankshaft between 21 and 335 Hz and concludes that two degrees of freedom do below
300 Hz. Its records are not public; the torques used here are those of simulated records.

Ours: counting modes (`Modes.needed`) tells which resonances a model has. It does not tell how exact it is, because a
mode that is left out yields below its resonance as well. `reduce` lumps the crankshaft rigidly and compares receptances
at every frequency; and the full and each lumped model are simulated under the same combustion and their engine orders
compared. At 1200 RPM the strong orders lie far below 300 Hz and two masses do; at 6000 RPM the second is at 200 Hz.
"""

import numpy as np
import shared
from shared import Line

import casadi_engine as ce
from casadi_engine.model import reduce

FULL = ce.crankshaft(reciprocating_speed="measured")
RANGE = 300.0  # Hz
LUMPED = (1, 2, 3, 4)
COLOURS = ("#CC79A7", shared.THESIS, "#009E73", shared.OURS)


def response(model, data):
    """Orders of the simulated speed below 300 Hz, of the third to eighth cycle."""
    speed = ce.simulate(model, data).only("theta", "omega").cycles(3, 8)
    rpm = np.ptp(data["theta"].values) / data.duration * 30 / np.pi
    return ce.orders(speed, orders=0.5 * np.arange(1, np.ceil(2 * RANGE * 60 / rpm - 0.01)))


def off(exact, found):
    """RMS of the error over all orders, in % of the RMS of the speed's fluctuation."""
    return 100 * float(np.linalg.norm(found.phasors - exact.phasors) / np.linalg.norm(exact.phasors))


def draw(lumped, exact, found, data, out):
    figure, axes = shared.panels(1, 3, width=14, height=3.8)
    receptance, zoom, orders = axes[0]
    hz = lumped[2].exact.hz
    receptance.loglog(hz, np.abs(lumped[2].exact.values[:, 0, 0]), color="black", label="seven inertias")
    whole = ce.simulate(FULL, data)["omega"]
    zoom.plot(1e3 * whole.time, whole.values, color="black", label="seven inertias")
    for dof, colour in zip(LUMPED, COLOURS, strict=True):
        receptance.loglog(
            hz, np.abs(lumped[dof].lumped.values[:, 0, 0]), color=colour, label=f"lumped to {dof}"
        )
        speed = ce.simulate(lumped[dof].model, data)["omega"]
        zoom.plot(1e3 * speed.time, speed.values, color=colour, linewidth=1, label=f"lumped to {dof}")
    receptance.axvline(RANGE, color="0.6", linestyle=":")
    receptance.set(
        xlabel="frequency [Hz]", ylabel="|speed / T_1| [rad/s/(N m)]", title="receptances (dotted: 300 Hz)"
    )
    receptance.set_xlim(1, 1000)
    zoom.set(
        xlim=(600, 700),
        ylim=(122.5, 127),
        xlabel="time [ms]",
        ylabel="speed [rad/s]",
        title="a cycle at 1200 RPM",
    )
    for rpm, one in exact.items():
        error = np.abs(found[2, rpm].phasors - one.phasors)[0]
        strong = one.amplitude[0] > 0.001 * one.amplitude.max()
        orders.semilogy(one.frequency_hz[0][strong], error[strong] / one.amplitude.max() * 100, "o-", markersize=3,
                        label=f"{rpm} RPM")  # fmt: skip
    orders.set(xlabel="frequency of an order [Hz]", ylabel="error [% of the strongest order]",
               title="two masses: error of each order")  # fmt: skip
    for ax in axes[0]:
        ax.legend(frameon=False, fontsize=7)
    figure.savefig(out / "reduction.png", dpi=110)


def page(quick, out):
    data = {
        rpm: shared.experiment(
            shared.record("crankshaft", rpm, sigma=0.0, scatter_seed=113, cycles=8, rtol=1e-9)
        )
        for rpm in ((1200, 6000) if quick else (1200, 3000, 6000))
    }
    exact = {rpm: response(FULL, one) for rpm, one in data.items()}
    lumped = {dof: reduce(FULL, dof=dof, up_to_hz=RANGE) for dof in LUMPED}
    found = {(dof, rpm): response(lumped[dof].model, one) for dof in LUMPED for rpm, one in data.items()}
    errors = {key: off(exact[key[1]], one) for key, one in found.items()}
    rows = []
    for dof, one in lumped.items():
        hz = " ".join(f"{mode:.1f}" for _, mode in one.frequencies if mode is not None) or "-"
        rows.append([f"{dof}", hz, f"{one.limit_hz:.0f} Hz", *(f"{errors[dof, rpm]:.1f} %" for rpm in data)])
    head = [
        "inertias",
        "modes [Hz]",
        "receptance within 10 % up to",
        *(f"speed at {rpm} RPM" for rpm in data),
    ]
    shared.print_table("The crankshaft lumped: errors below 300 Hz", head, rows)
    draw(lumped, exact, found, data[1200], out)
    needed, strict = FULL.modes().needed(RANGE), reduce(FULL, up_to_hz=RANGE).dof
    return [
        Line("section 4.3.3", "two degrees of freedom below 300 Hz", f"{needed} by the modes, of 20.5 and 335 Hz",
             "the same", needed == 2),
        Line("section 4.3.3", "sufficient", f"speed off by {errors[2, 1200]:.1f} % at 1200 RPM (one inertia: "
             f"{errors[1, 1200]:.0f} %)", "the same", errors[2, 1200] < 5 < 20 < errors[1, 1200]),
        Line("beyond 4.3.3", "at any speed", f"off by {errors[2, 6000]:.0f} % at 6000 RPM", "not at high speed",
             errors[2, 6000] > 10),
        Line("beyond 4.3.3", "at any frequency below", f"receptances within 10 % up to {lumped[2].limit_hz:.0f} Hz",
             "the crankshaft winds up before it resonates", 60 < lumped[2].limit_hz < 150),
        Line("beyond 4.3.3", "-", f"{strict} inertias for receptances within 10 % up to 300 Hz",
             "`reduce` decides by the error", strict > 4),
    ]  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "reduction", __doc__))
