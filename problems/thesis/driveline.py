"""Future work (c) and Figure 5.1: the chain goes on to the wheels; order map of a run-up, and ride quality.

    python problems/thesis/driveline.py [--quick]

The thesis stops at the dynamometer and leaves the rest of the powertrain to the future; its ride study (80 km/h, third
octaves against the four-hour boundary of ISO 2631) uses typical values that it does not print. So do we. Its records
are not public; the combustion here is that of a simulated record.

One builder takes the crankshaft on: clutch and gearbox, differential, driven wheels, car, all turned to the speed of
the crank by the ratio (J / RATIO², K / RATIO²). A run-up is planned from a record of the engine; ce.orders maps it.

Values: engine Table 4.12. Driveline: of the size of a 1300 kg car's in fourth gear, assumed. Quarter car: the reference
car of the international roughness index, per kilogram of its body (Sayers, Gillespie, Paterson, World Bank Technical
Paper 46, 1986; ASTM E1926). Road: ISO 8608, density 256 and 1024e-6 m³ at 0.1 cycles a metre, the geometric means of
classes C (128 to 512e-6) and D (512 to 2048e-6), falling with the frequency squared. Boundary: ISO 2631-1:1985,
fatigue-decreased proficiency at four hours, which its edition of 1997 gave up: vertically 0.53 m/s² from 4 to 8 Hz,
along 0.355 m/s² from 1 to 2 Hz; below 4 Hz it falls with the root of the frequency, above it rises with it, to 80 Hz
(its tables agree with these lines to their two digits). At 5 Hz and one hour it is 1.2 m/s² (Wilkinson, Maslen,
Rowlands, Royal Aircraft Establishment, 1976).
"""

import numpy as np
import shared
from shared import Line

import casadi_engine as ce
from casadi_engine.identifiability import plan
from casadi_engine.model import Driven

RATIO, WHEEL, MASS, SPEED = 3.9, 0.3, 1300.0, 80 / 3.6  # ratio, m, kg, m/s
RPM = np.pi / 30
DRIVELINE = (
    Driven(inertia=0.01, stiffness=1500.0, damping=2.0, description="clutch disc and gearbox"),
    Driven(inertia=0.03 / RATIO**2, stiffness=25e3 / RATIO**2 * 10, damping=0.1, description="differential"),
    Driven(inertia=2.0 / RATIO**2, stiffness=20e3 / RATIO**2, damping=20.0 / RATIO**2, description="driven wheels"),
    Driven(inertia=MASS * WHEEL**2 / RATIO**2, stiffness=60e3 / RATIO**2, damping=600.0 / RATIO**2, load="T_load",
           description="car behind its tyres"),
)  # fmt: skip
MODEL = ce.crankshaft(reciprocating_speed="measured", driven=DRIVELINE, outputs=("omega", "omega_load"))
THIRDS = 10.0 ** np.arange(0.0, 2.0, 0.1)  # centres of third octaves, 1 to 80 Hz
UP = 0.53 * np.maximum(
    np.sqrt(np.maximum(4 / THIRDS, 1)), THIRDS / 8
)  # boundaries [m/s², RMS in a third octave]
AHEAD = 0.355 * np.maximum(1, THIRDS / 2)
AXLE, SPRING, DAMPER, TYRE = 0.15, 63.3, 6.0, 653.0  # over the body's mass: 1, 1/s², 1/s, 1/s²
ROADS = {"C": 256e-6, "D": 1024e-6}  # m³, density of the height at 0.1 cycles a metre


def simulated(**options):
    """Speeds of the wheel and of the car, crank side, for a planned experiment; its first two seconds settle."""
    record = ce.read_experiment(
        shared.ROOT / "data" / "crankshaft" / "normal_1200rpm.csv.gz", optional=("omega_load",)
    )
    planned = plan(MODEL, record, load=40.0, **options).experiment
    start = {
        state.name: 0.0 if state.name.startswith("twist") else planned["omega"].values[0]
        for state in MODEL.states
    }
    return ce.simulate(MODEL, planned, initial=start)


def longitudinal(run):
    """Third-octave RMS of the car's acceleration from all orders [m/s²]."""
    settled = run.between(2.0, run.span[1]).only("theta", "omega_load")
    found = ce.orders(settled, channel="omega_load")
    hz, size = found.frequency_hz[0], found.amplitude[0] * 2 * np.pi * found.frequency_hz[0] * WHEEL / RATIO
    inside = np.abs(np.log10(hz[None, :] / THIRDS[:, None])) <= 0.05
    return np.sqrt((inside * size**2 / 2).sum(axis=1))


def vertical(road):
    """Third-octave RMS of the body of a quarter car [m/s²]."""
    hz = np.geomspace(0.5, 120, 20_000)
    s = 2j * np.pi * hz
    leg = SPRING + DAMPER * s
    z = TYRE * leg / ((s**2 + leg) * (AXLE * s**2 + leg + TYRE) - leg**2)
    density = road * 0.1**2 * SPEED / hz**2 * np.abs(s**2 * z) ** 2
    inside = np.abs(np.log10(hz[None, :] / THIRDS[:, None])) <= 0.05
    return np.sqrt((inside * density * np.gradient(hz)).sum(axis=1))


def draw(ahead, up, found, natural, out):
    figure, axes = shared.panels(1, 2, width=12, height=4)
    ride, lines = axes[0]
    ride.loglog(THIRDS, UP, "k--", label="boundary, vertical")
    ride.loglog(THIRDS, AHEAD, color="0.5", linestyle="--", label="boundary, longitudinal")
    for (road, values), colour in zip(up.items(), (shared.OURS, "#56B4E9"), strict=True):
        ride.loglog(THIRDS, values, "o-", color=colour, markersize=3, label=f"body, vertical, road {road}")
    strong = ahead > 1e-5
    ride.loglog(
        THIRDS[strong],
        ahead[strong],
        "s",
        color=shared.THESIS,
        markersize=4,
        label="body, longitudinal, engine",
    )
    ride.set(
        xlabel="third octave [Hz]",
        ylabel="RMS acceleration [m/s²]",
        title="Figure 5.1 again: 80 km/h, four hours",
    )
    for order in (0.5, 2, 4, 6.5):
        hz = found.rpm / 60 * order
        lines.loglog(hz, found.of(order), ".", markersize=4, label=f"order {order:g}")
    for hz in natural[1:5]:
        lines.axvline(hz, color="0.6", linestyle=":")
    lines.set(
        xlabel="frequency [Hz]",
        ylabel="crank speed [rad/s]",
        title="run-up: orders over frequency (dotted: modes)",
    )
    for ax in axes[0]:
        ax.legend(frameon=False, fontsize=7)
    figure.savefig(out / "driveline.png", dpi=110)


def page(quick, out):
    print(MODEL.modes())
    natural = MODEL.modes().frequencies_hz
    ahead = longitudinal(simulated(speed=SPEED / WHEEL * RATIO, duration=4.0))
    up = {name: vertical(road) for name, road in ROADS.items()}
    run = simulated(run_up=(800 * RPM, 3500 * RPM), duration=8.0 if quick else 20.0)
    found = ce.orders(run.between(1.0, run.span[1]), cycles=2)
    ce.plot(found, path=out / "driveline_run_up.png")
    draw(ahead, up, found, natural, out)
    worst = (ahead / AHEAD).max()
    over = {name: THIRDS[values > UP] for name, values in up.items()}
    bands = "; ".join(f"road {name}: from {hz.min():.1f} to {hz.max():.0f} Hz" for name, hz in over.items())
    top = found.peak(6.5)[1]
    return [
        Line("chapter 6 (c)", "the rest of the powertrain", f"{len(MODEL.states) // 2 + 1} inertias; modes "
             f"{natural[1]:.1f}, {natural[2]:.1f}, {natural[3]:.1f} Hz below the crankshaft's", "one builder",
             sum(natural < 300) == 4),
        Line("chapter 6 (c)", "order map of a run-up", f"order 6.5 peaks at {top:.0f} Hz, the mode is at "
             f"{natural[4]:.0f} Hz", "the map shows the mode", 6.5 in found.resonant and abs(top - natural[4]) < 5),
        Line("Figure 5.1", "longitudinal: under the boundary", f"at most {100 * worst:.2g} % of it", "the same",
             worst < 1),
        Line("Figure 5.1", "vertical: above it from 1 to 11 Hz", bands, "above it too; how far depends on road and car",
             all(hz.min() >= 1 and hz.max() <= 13 for hz in over.values())),
    ]  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "driveline", __doc__))
