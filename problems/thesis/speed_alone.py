"""Future work (a): identification from crank speed alone, with modelled cylinder pressures.

    python problems/thesis/speed_alone.py [--quick]

The thesis leaves open what to do where no pressure is measured. Its records are not public; those here are simulated,
by a burn law other than the model's (problems/thesis/pressure_model.py), so that the model is wrong as it would be.

The burn law is fitted to one cylinder's trace once; then strengths x_1..x_4 of the combustions, their phasing and the
intake pressure are estimated from crank speed alone, with the engine known, and with J_eng, J_load, K_el and C_el free.
C_eng has to be known: the mean torque of the combustions and the friction only show as their difference.
"""

import casadi as ca
import numpy as np
import shared
from shared import BURN, CYCLE, DEG, GEOMETRY, SIGMA, TABLE_4_1, TDC, Line, own_angle, pressure, stderr

import casadi_engine as ce

STRENGTHS = [f"x_{c}" for c in (1, 2, 3, 4)]
FREE = ("J_eng", "J_load", "K_el", "C_el")


def burn_law(made):
    """The burn law of cylinder 1, from its trace."""
    b = ce.Blueprint("cylinder_pressure")
    p = {name: b.parameter(name, v, unit=u, min=low, max=high) for name, (v, u, low, high) in BURN.items()}
    b.ode("offset", 0 * b.state("offset", unit="bar", scale=1.0))
    x = b.parameter("x", 3.0, min=0, max=10)
    b.output("p", pressure(b.input("angle", unit="rad"), p, x, GEOMETRY) / 1e5, unit="bar")
    data = ce.Experiment.from_arrays("trace", time=made["time"], units={"angle": "rad", "p": "bar"},
                                     angle=own_angle(made["theta"]), p=made["p1"] / 1e5)  # fmt: skip
    fit = ce.estimate(b.model(), data, initial={"offset": 0.0}, progress=False)
    return {name: fit.values[name] for name in BURN}


def speed_model():
    """Two masses driven by four modelled pressures; its inputs are each cylinder's own angle."""
    b = ce.Blueprint("two_mass_speed_alone")
    units = {"J": "kg m2", "K": "N m/rad", "C": "N m s/rad"}
    e = {
        name: b.parameter(name, v, unit=units[name[0]], min=0.05 * v, max=20 * v)
        for name, v in TABLE_4_1.items()
    }
    p = {name: b.parameter(name, v, unit=u, min=low, max=high) for name, (v, u, low, high) in BURN.items()}
    speed, torque, u = b.input("omega", unit="rad/s", scale=100), 0, ca.SX.sym("u")
    sine = ca.sin(u)
    f = sine + GEOMETRY["r"] / GEOMETRY["L"] * sine * ca.cos(u) / ca.sqrt(
        1 - (GEOMETRY["r"] / GEOMETRY["L"] * sine) ** 2
    )
    factor = ca.Function("factor", [u], [f, ca.jacobian(f, u)])
    for c, name in enumerate(STRENGTHS, start=1):
        angle = b.input(f"angle_{c}", unit="rad")
        lever, slope = factor(angle)
        gas = (pressure(angle, p, b.parameter(name, 3.0, min=0, max=10), GEOMETRY) - 1e5) * GEOMETRY["A_p"]
        torque += b.drive(
            f"T_{c}", GEOMETRY["r"] * lever * (gas - 0.7 * GEOMETRY["r"] * slope * speed**2), scale=100
        )
    load = b.drive("T_load", b.input("T_load", unit="N m", scale=100), scale=100)
    engine, brake = (b.state(name, unit="rad/s", scale=100) for name in ("omega_eng", "omega_load"))
    twist = b.state("twist", unit="rad", scale=0.01)
    coupling = e["K_el"] * twist + e["C_el"] * (brake - engine)
    b.ode("omega_eng", (torque + coupling - e["C_eng"] * engine) / e["J_eng"])
    b.ode("omega_load", (-coupling - load) / e["J_load"])
    b.ode("twist", brake - engine)
    b.output("omega", engine, unit="rad/s", scale=100)
    return b.model()


def fit_speed(model, made, known, free):
    """Strengths and phasing from speed alone, the rest of the burn law from the traces; free: of the engine.

    The phasing is one number, soc: start and duration together would fit the scatter from cycle to cycle.
    """
    own = {f"angle_{c}": own_angle(made["theta"], c) for c in TDC}
    units = {"omega": "rad/s", "T_load": "N m", **dict.fromkeys(own, "rad")}
    data = ce.Experiment.from_arrays("speed", time=made["time"], units=units, omega=made["omega"],
                                     T_load=made["T_load"], **own)  # fmt: skip
    parameters = model.parameters()
    for name in parameters:
        parameters.fix(name, known.get(name))
    parameters.free(*STRENGTHS, "soc", "p_im", *free)
    fit = ce.estimate(model, data, parameters=parameters, noise=ce.Noise(omega=SIGMA), progress=False)
    errors, near = [], np.arange(-60, 90, 0.25) * DEG
    for c in TDC:
        found = np.array(pressure(ca.DM(near), fit.values, fit.values[f"x_{c}"], GEOMETRY)).ravel()
        cycle, angle = np.floor((made["theta"] - TDC[c]) / CYCLE + 0.5), own[f"angle_{c}"]
        tops = [np.argmax(np.where(cycle == k, made[f"p{c}"], 0)) for k in range(1, 9)]
        peak, place = made[f"p{c}"][tops].mean(), angle[tops].mean()
        errors.append((100 * (found.max() / peak - 1), (near[found.argmax()] - place) / DEG))
    return fit, np.abs(errors).max(axis=0)


def draw(made, fits, out):
    figure, axes = shared.panels(1, 4, width=14)
    near = np.arange(-90, 120, 0.5) * DEG
    for ax, c in zip(axes[0], (1, 3, 4, 2), strict=True):
        angle = own_angle(made["theta"], c)
        inside = np.abs(angle) < 2
        ax.plot(
            angle[inside] / DEG, made[f"p{c}"][inside] / 1e5, ".", color="0.6", markersize=1, label="true"
        )
        for (name, fit), colour in zip(fits.items(), (shared.OURS, shared.THESIS), strict=True):
            found = np.array(pressure(ca.DM(near), fit.values, fit.values[f"x_{c}"], GEOMETRY)).ravel()
            ax.plot(near / DEG, found / 1e5, color=colour, linewidth=1, label=name)
        ax.set(xlabel="crank angle [deg]", ylabel="pressure [bar]", title=f"cylinder {c}")
    names = axes[0, 0].get_legend_handles_labels()
    figure.legend(*names, loc="outside lower center", ncols=3, frameon=False, markerscale=6)
    figure.suptitle("Pressures found from crank speed alone; cylinder 2 misfires")
    figure.savefig(out / "speed_alone.png", dpi=110)


def page(quick, out):
    normal, lost = shared.record(scatter_seed=105), shared.record(scatter_seed=102, misfire={2: "all"})
    model, known = speed_model(), burn_law(normal)
    _, off = fit_speed(model, normal, known, ())
    silent, less = fit_speed(model, lost, known, ())
    free, far = fit_speed(model, lost, known, FREE)
    measured = ce.two_mass(reciprocating_speed="measured")
    best = ce.estimate(measured, shared.experiment(lost), noise=ce.Noise(omega=SIGMA), progress=False)
    fits = [free]  # one engine's scatter says little of errors
    for seed in (302, 305) if quick else range(301, 308):
        other = shared.record(scatter_seed=seed, noise_seed=seed, misfire={2: "all"})
        fits.append(fit_speed(model, other, known, FREE)[0])
    ways = {"pressure measured": best, "crank speed alone": free}
    shared.print_errors("Two masses from misfire", TABLE_4_1, ways)
    draw(lost, {"engine known": silent, "engine free but for C_eng": free}, out)
    loss = [stderr(one, name) / stderr(best, name) for one in fits for name in FREE]
    errors = np.array([[shared.error(one, name, TABLE_4_1) for name in FREE] for one in fits])
    white, own = (np.array([[stderr(o, n, own=w) for n in FREE] for o in fits]) for w in (False, True))
    beyond, within = (errors / white).max(axis=1).min(), (errors / own).max()
    found = "x_2 at its bound 0" if silent.estimates["x_2"].at_bound else f"x_2 = {silent.values['x_2']:.2f}"
    return [
        Line("chapter 6 (a)", "no pressure in a car", f"engine known: peaks within {off[0]:.1f} %, {off[1]:.1f} deg",
             "crank speed alone is enough", off[0] < 5 and off[1] < 2),
        Line("chapter 6 (a)", "misfire detection without pressure",
             f"{found}; other peaks within {less[0]:.1f} %, {less[1]:.1f} deg", "the silent cylinder shows",
             silent.values["x_2"] < 0.1 and less[0] < 5 and less[1] < 2),
        Line("chapter 6 (a)", "engine unknown but for C_eng", f"peaks within {far[0]:.1f} %, {far[1]:.1f} deg",
             "still within 5 % and 2 deg", far[0] < 5 and far[1] < 2),
        Line("chapter 6 (a)", "what is lost", f"standard errors grow {min(loss):.1f} to {max(loss):.1f} times; "
             f"{errors.min():.1f} to {errors.max():.1f} % off", "the burn law's error, more than noise",
             min(loss) > 1 and max(loss) < 10 and beyond > 3 and errors.max() < 15),
        Line("beyond", "-", f"off by {beyond:.0f} errors of noise or more; {within:.1f} at most by the residual's",
             "the fit sees the burn law's error in its residual", within < 3 < beyond),
    ]  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "speed_alone", __doc__))
