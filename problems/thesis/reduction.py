"""Section 4.3.3: below 300 Hz two masses suffice. Computed from the modes, and held against responses.

    python problems/thesis/reduction.py [--quick]

The thesis finds no mode of the crankshaft between 21 and 335 Hz and concludes that two degrees of freedom do below
300 Hz. Its records are not public; the torques used here are those of a simulated record at 1200 RPM.

Counting modes tells which resonances a model has, not how exact it is: a mode that is left out yields below its
resonance too. `reduce` lumps the crankshaft rigidly to fewer inertias and compares receptances at every frequency, from
every cylinder's torque to the speed of the damping wheel. How much that matters depends on the torques; the speeds of
the full and of each lumped model under the same combustion tell.
"""

import numpy as np
import shared
from shared import Line

import casadi_engine as ce
from casadi_engine.model import reduce

FULL = ce.crankshaft(reciprocating_speed="measured")
RANGE = 300.0  # Hz


def speed(model, data):
    """Simulated speed of the wheel [rad/s] from a start that is fitted to the record."""
    return ce.simulate(model, data)["omega"]


def below(channel):
    """The channel's values below 300 Hz, zero phase, without the ends where the filter has not settled."""
    alone = ce.Experiment("speed", (channel,)).low_pass(cutoff_hz=RANGE, channels="omega", order=8)
    return alone["omega"].values[500:-500]


def off(exact, found):
    """RMS difference, % of the RMS fluctuation."""
    return 100 * float(np.sqrt(np.mean((found - exact) ** 2)) / np.std(exact))


def draw(exact, lumped, data, spectra, out):
    figure, axes = shared.panels(1, 3, width=14, height=3.8)
    receptance, zoom, orders = axes[0]
    hz = lumped[2].exact.hz
    receptance.loglog(hz, np.abs(lumped[2].exact.values[:, 0, 0]), color="black", label="seven inertias")
    for dof, colour in COLOURS.items():
        receptance.loglog(
            hz, np.abs(lumped[dof].lumped.values[:, 0, 0]), color=colour, label=f"lumped to {dof}"
        )
        found = speed(lumped[dof].model, data)
        zoom.plot(1e3 * found.time, found.values, color=colour, linewidth=1, label=f"lumped to {dof}")
    zoom.plot(1e3 * exact.time, exact.values, color="black", linewidth=1, label="seven inertias")
    receptance.axvline(RANGE, color="0.6", linestyle=":")
    receptance.set(xlabel="frequency [Hz]", ylabel="|speed / T_1| [rad/s/(N m)]", title="receptance")
    zoom.set(xlim=(200, 300), xlabel="time [ms]", ylabel="speed [rad/s]", title="a cycle at 1200 RPM")
    for rpm, values in spectra.items():
        orders.plot(values[:, 0], values[:, 1], "o-", markersize=3, label=f"{rpm} RPM")
    orders.axhline(10, color="0.6", linestyle=":")
    orders.set(yscale="log", xlabel="frequency of an order [Hz]", ylabel="error of its amplitude, two masses [%]",
               title="even orders at three engine speeds")  # fmt: skip
    for ax in axes[0]:
        ax.legend(frameon=False, fontsize=7)
    figure.savefig(out / "reduction.png", dpi=110)


def amplitudes(channel, data, top=RANGE):
    """Frequency [Hz] and complex amplitude of the even orders below the range, over whole cycles."""
    angle = np.interp(channel.time, data["theta"].time, data["theta"].values)
    even = np.arange(0, 8 * np.pi, 4 * np.pi / 720) + 4 * np.pi
    values = np.interp(even, angle, channel.values)
    rpm = np.ptp(angle) / np.ptp(channel.time) * 30 / np.pi
    numbers = np.arange(2, top * 60 / rpm, 2)
    parts = [2 * np.mean(values * np.exp(-1j * n * even)) for n in numbers]
    return numbers * rpm / 60, np.array(parts)


def page(quick, out):
    data = {
        rpm: shared.experiment(
            shared.record("crankshaft", rpm, sigma=0.0, scatter_seed=113, cycles=4, rtol=1e-9)
        )
        for rpm in (1200, 3000, 6000)
    }
    exact = {rpm: speed(FULL, one) for rpm, one in data.items()}
    rows, spread, lumped = [], {}, {}
    for dof in (1, 2, 3, 4):
        lumped[dof] = one = reduce(FULL, dof=dof, up_to_hz=RANGE)
        for rpm in data:
            found = speed(one.model, data[rpm])
            spread[dof, rpm] = off(below(exact[rpm]), below(found))
        hz = " ".join(f"{mode:.1f}" for _, mode in one.frequencies if mode is not None) or "-"
        rows.append([f"{dof}", hz, f"{one.limit_hz:.0f} Hz", *(f"{spread[dof, rpm]:.1f} %" for rpm in data)])
    head = [
        "inertias",
        "modes [Hz]",
        "receptances within 10 % up to",
        *(f"speed at {rpm} RPM" for rpm in data),
    ]
    shared.print_table("The crankshaft lumped: errors, of the speed below 300 Hz", head, rows)
    for rpm in data:
        hz, a = amplitudes(exact[rpm], data[rpm])
        _, b = amplitudes(speed(lumped[2].model, data[rpm]), data[rpm])
        print(
            rpm,
            [(f"{x:.0f}", f"{abs(u):.3g}", f"{100 * abs(v - u) / abs(u):.1f}") for x, u, v in zip(hz, a, b)],
        )
    return rows


if __name__ == "__main__":
    page(False, None)
