"""Beyond Table 4.11: repair finds the law behind the 36 friction coefficients.

    python problems/thesis/friction_law.py [--quick]

The thesis keeps a table of C_eng over speed and load. Its records are not public; these are simulated with that table
as the truth (problems/thesis/friction_map.py). Here one C_eng is shared by all operating points, which cannot be right,
and `ce.repair` is asked what is missing: dry friction, friction that fades with speed (Stribeck), drag, or an effect of
our own, dry friction that grows with the load. Operating points that it has not seen have the last word.

The model is written as a blueprint, so that the engine's port shows the load beside the speed. The inertias and
the coupling are known within a factor of two: with wide bounds the fit without effects makes the load a flywheel of
5 kg m2 on a stiff shaft, which hides what depends on the load, and the search ends early.
"""

import friction_map
import numpy as np
import shared
from friction_map import POINTS, name
from shared import TABLE_4_1, Line

import casadi_engine as ce

SEEN = [(rpm, load) for rpm in (1000, 1400, 2000) for load in (50, 70, 100)]
FRESH = [(1200, 60), (1600, 80), (1800, 90)]
QUICK = [(1000, 50), (1000, 100), (2000, 50), (2000, 100)]


class LoadFriction(ce.Effect):
    """Dry friction that is a share of the load."""

    name, attaches, kin = "load_friction", ("inertia",), ("coulomb_friction",)
    sentence = "dry friction at {port} that grows with the load"
    amplitude = ce.effects.Amplitude("share", unit="1", min=0)
    nuisance = {}  # noqa: RUF012

    def law(self, port, p, math):
        return -p.share * port.load * math.sign(port.speed, width=1.0)


def two_masses():
    b = ce.Blueprint("two_masses_under_load")
    units = {"J": "kg m2", "K": "N m/rad", "C": "N m s/rad"}
    known = {"C_eng": 30} | dict.fromkeys(("J_eng", "C_el", "K_el", "J_load"), 2)  # within such a factor
    e = {
        n: b.parameter(n, v, unit=units[n[0]], min=v / known[n], max=known[n] * v)
        for n, v in TABLE_4_1.items()
    }
    torque, load = (b.input(n, unit="N m", scale=100) for n in ("T_eng", "T_load"))
    engine, brake = (b.state(n, unit="rad/s", scale=100) for n in ("omega_eng", "omega_load"))
    twist = b.state("twist", unit="rad", scale=0.01)
    port = b.port("engine", "inertia", {"speed": engine, "load": load}, description="the engine")
    coupling = e["K_el"] * twist + e["C_el"] * (brake - engine)
    b.ode("omega_eng", (torque + coupling - e["C_eng"] * engine + port) / e["J_eng"])
    b.ode("omega_load", (-coupling - load) / e["J_load"])
    b.ode("twist", brake - engine)
    b.output("omega", engine, unit="rad/s", scale=100)
    return b.model()


def record(point):
    made = friction_map.simulated(list(POINTS).index(point), *point)
    torque = made["T_1"] + made["T_2"] + made["T_3"] + made["T_4"]
    units = {"T_eng": "N m", "T_load": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(name(point), time=made["time"], units=units, T_eng=torque,
                                     T_load=made["T_load"], omega=made["omega"])  # fmt: skip


def coefficient(values, rpm, load):
    """C_eng [N m s/rad] that the law stands for at an operating point."""
    speed = rpm * np.pi / 30
    torque = values["C_eng"] * speed + values.get("engine.load_friction.share", 0.0) * load
    torque += values.get("engine.coulomb_friction.torque", 0.0)
    fading = values.get("engine.stribeck_friction.fading", 1.0)
    return (
        torque + values.get("engine.stribeck_friction.torque", 0.0) * np.exp(-((speed / fading) ** 2))
    ) / speed


def draw(values, out):
    figure, axes = shared.panels(1, 1, width=8, height=4)
    ax = axes[0, 0]
    for k, load in enumerate(friction_map.LOADS):
        rpm = np.linspace(950, 2050, 60)
        ax.plot(rpm, coefficient(values, rpm, load), color=f"C{k}", label=f"{load} N m")
        ax.plot([r for r, one in POINTS if one == load], [v for (_, one), v in POINTS.items() if one == load], "o",
                color=f"C{k}", markersize=4)  # fmt: skip
    ax.set(
        xlabel="engine speed [RPM]",
        ylabel="C_eng [N m s/rad]",
        title="Table 4.11 (dots) and the law that was found",
    )
    ax.legend(frameon=False, fontsize=7)
    figure.savefig(out / "friction_law.png", dpi=110)


def page(quick, out):
    seen, fresh = (QUICK, FRESH[:1]) if quick else (SEEN, FRESH)
    effects = [
        "coulomb_friction",
        *([] if quick else ["stribeck_friction", "quadratic_drag"]),
        LoadFriction(),
    ]
    data, last = [record(point) for point in seen], [record(point) for point in fresh]
    found = ce.repair(two_masses(), data, fresh=last, effects=effects)
    print(found)
    values = found.fit.values
    draw(values, out)
    off = {point: 100 * abs(coefficient(values, *point) / value - 1) for point, value in POINTS.items()}
    laws = sorted({one.split(".")[1] for one in values if "friction" in one})
    numbers = sum("friction" in one for one in values) + 1
    most, middle = max(off.values()), float(np.median(list(off.values())))
    return [
        Line("Table 4.11", "36 coefficients", f"{numbers} numbers: C_eng and {', '.join(laws)}",
             "a law in speed and load", numbers <= 5 and "load_friction" in laws),
        Line("Table 4.11", "a table", f"the law gives the 36 within {most:.1f} %, half of them within {middle:.1f} %",
             "most of them at points not seen", most < 8),
        Line("Table 4.11", "fresh data", f"verdict: {found.verdict}", "confirmed at speeds and loads not seen",
             found.verdict == "named"),
    ]  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "friction_law", __doc__))
