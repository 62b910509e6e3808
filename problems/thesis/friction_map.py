"""Table 4.11: the friction coefficient C_eng over six speeds and six loads, fitted jointly.

    python problems/thesis/friction_map.py [--quick]

The thesis estimates C_eng at each operating point by itself, with the other parameters held at Table 4.7. Its records
are not public; these are simulated, four cycles each, and their truth is Table 4.11. (Its columns 50 and 60 are what
the text calls 57 and 67 N m; here they are taken at their word.)

Ours fits all records in one: J_eng, J_load, K_el and C_el are shared, C_eng is free in each. Read as a torque, C_eng
times speed hardly depends on speed: what looks like a damper is mostly dry friction that grows with the load.
"""

from dataclasses import replace

import numpy as np
import shared
from shared import SIGMA, TABLE_4_1, Line
from simulator import two_mass_shaft

import casadi_engine as ce

MODEL = ce.two_mass(reciprocating_speed="measured")
LOADS = (50, 60, 70, 80, 90, 100)  # N m
TABLE_4_11 = {  # RPM: C_eng [N m s/rad] at each load
    1000: (0.1895, 0.1959, 0.2042, 0.2116, 0.2188, 0.2319),
    1200: (0.1541, 0.1621, 0.1707, 0.1771, 0.1826, 0.1907),
    1400: (0.1354, 0.1421, 0.1504, 0.1558, 0.1565, 0.1628),
    1600: (0.1182, 0.1240, 0.1286, 0.1355, 0.1399, 0.1412),
    1800: (0.1134, 0.1136, 0.1189, 0.1246, 0.1261, 0.1337),
    2000: (0.1007, 0.1054, 0.1116, 0.1172, 0.1172, 0.1225),
}
POINTS = {
    (rpm, load): value for rpm, row in TABLE_4_11.items() for load, value in zip(LOADS, row, strict=True)
}


def name(point):
    return f"{point[0]}_RPM_{point[1]}_Nm"


def simulated(number, rpm, load):
    """One operating point, noisy, with the friction that the thesis found there."""
    shaft = replace(two_mass_shaft(), absolute_damping=np.array([POINTS[rpm, load], 0.0]))
    return shared.record("two_mass", rpm, load=float(load), shaft=shaft, cycles=4, scatter_seed=700 + number,
                         noise_seed=900 + number, rtol=1e-8)  # fmt: skip


def record(number, rpm, load):
    return shared.experiment(simulated(number, rpm, load), name((rpm, load)))


def one_by_one(data):
    """The thesis's way: every 20th sample, the others held at Table 4.7; (value, standard error) of C_eng."""
    found = []
    for one in data:
        parameters = MODEL.parameters()
        for held in ("J_eng", "J_load", "K_el", "C_el"):
            parameters.fix(held)
        fit = ce.estimate(MODEL, shared.conditioned(one, 20), parameters=parameters, noise=ce.Noise(omega=SIGMA),
                          progress=False)  # fmt: skip
        found.append((fit.values["C_eng"], fit.estimates["C_eng"].stderr))
    return np.array(found)


def jointly(data, points):
    """One fit of all records; the fit, and (value, standard error) of C_eng in each."""
    parameters = MODEL.parameters()
    parameters.vary_by_experiment("C_eng")
    fit = ce.estimate(MODEL, data, parameters=parameters, noise=ce.Noise(omega="estimate"), progress=False)
    found = [fit.estimates[f"C_eng@{name(point)}"] for point in points]
    return fit, np.array([(one.value, one.stderr) for one in found])


def friction_law(points, values):
    """Friction torque a + b speed + c load by least squares; numbers, and largest error of C_eng [%]."""
    rpm, load = np.array(points, dtype=float).T
    speed = rpm * np.pi / 30
    terms = np.column_stack([np.ones_like(speed), speed, load])
    law, *_ = np.linalg.lstsq(terms, values * speed, rcond=None)
    return law, 100 * np.abs(terms @ law / speed / values - 1).max()


def draw(points, found, out):
    figure, axes = shared.panels(1, 3, width=14, height=3.8)
    rpm, load = np.array(points, dtype=float).T
    truth = np.array([POINTS[point] for point in points])
    shown = {
        "C_eng, found [N m s/rad]": found[:, 0],
        "error in standard errors [1]": (found[:, 0] - truth) / found[:, 1],
        "friction torque C_eng speed [N m]": found[:, 0] * rpm * np.pi / 30,
    }
    for ax, (title, values) in zip(axes[0], shown.items(), strict=True):
        around = {"vmin": -3, "vmax": 3, "cmap": "RdBu_r"} if "error" in title else {"cmap": "viridis"}
        image = ax.scatter(load, rpm, c=values, s=420, marker="s", **around)
        for x, y, value in zip(load, rpm, values, strict=True):
            ax.text(x, y, f"{value:.2g}" if "error" in title else f"{value:.3g}", ha="center", va="center", fontsize=6,
                    color="black" if "error" in title else "white")  # fmt: skip
        ax.set(
            title=title, xlabel="load [N m]", ylabel="engine speed [RPM]", xlim=(44, 106), ylim=(900, 2100)
        )
        figure.colorbar(image, ax=ax)
    figure.savefig(out / "friction_map.png", dpi=110)


def page(quick, out):
    points = [
        point for point in POINTS if not quick or (point[0] in (1000, 2000) and point[1] in (50, 70, 100))
    ]
    data = [record(list(POINTS).index(point), *point) for point in points]
    truth = np.array([POINTS[point] for point in points])
    alone, (fit, found) = one_by_one(data), jointly(data, points)
    rows = []
    for rpm in TABLE_4_11:
        here = [k for k, point in enumerate(points) if point[0] == rpm]
        if here:
            words = [f"{truth[k]:.4f} {found[k, 0]:.4f}" for k in here]
            rows.append([f"{rpm}", *words])
    head = ["RPM", *(f"{load} N m" for load in sorted({point[1] for point in points}))]
    shared.print_table("Table 4.11: published (the truth here) and found jointly", head, rows)
    off, wrong = ((one[:, 0] - truth) / one[:, 1] for one in (found, alone))
    inside, few = (int((np.abs(one) < 1.96).sum()) for one in (off, wrong))
    width = [100 * np.median(one[:, 1] / truth) for one in (found, alone)]
    draw(points, found, out)
    law, misses = friction_law(points, found[:, 0])
    shared_off = {n: shared.error(fit, n, TABLE_4_1) for n in ("J_eng", "J_load", "K_el", "C_el")}
    return [
        Line("Table 4.11", "C_eng over speed and load", f"{inside} of {len(points)} within 95 % intervals", "the same",
             inside >= 31 / 36 * len(points)),
        Line("Table 4.11", "the others as at 1200 RPM", f"shared ones off by up to {max(shared_off.values()):.2f} %",
             "found with C_eng in one fit", all(shared_off[n] < 3 * shared.stderr(fit, n) for n in shared_off)),
        Line("Table 4.11", "one point at a time", f"its way: {few} of {len(points)} within, errors ± {width[1]:.2f} %; "
             f"jointly ± {width[0]:.2f} %", "also right, with wider errors", few > 0.8 * len(points)),
        Line("Table 4.11", "C_eng falls with speed, rises with load",
             f"torque {law[0]:.1f} + {law[1]:.4f} speed + {law[2]:.3f} load N m, within {misses:.1f} %",
             "three numbers for 36: dry friction that grows with load", misses < 10),
    ]  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "friction_map", __doc__))
