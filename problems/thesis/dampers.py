"""Future work (b): the damping coefficients, by the experiments that choose_experiments picks.

    python problems/thesis/dampers.py [--quick]

The thesis fixes every damper: estimated, C_el did not converge, and it leaves "a suitable identification technique for
the damping coefficients" to the future. Its records are not public; those used here are simulated, with its values.

Ours asks first, from the model and one record of the engine, which experiment would tell which damper and how well
(Cramér-Rao, everything else free and tied as in (4.15), (4.16)); then makes the chosen one and fits it. What no
single experiment tells within 20 % is named: fix it, or give it a prior. C_eng comes out many of its tiny
standard errors off: the linear form puts all cylinders at the wheel's angle and misses 0.003 N m of friction torque.
"""

import math
from dataclasses import dataclass

import shared
from shared import SIGMA, Line, stderr

import casadi_engine as ce
from casadi_engine.identifiability import plan
from casadi_engine.model import thesis_ties

MODEL = ce.crankshaft(reciprocating_speed="measured", outputs=("omega", "omega_load"))
DAMPERS = {"C21": 15.0, "C32": 2.5, "C65": 2.5, "C76": 2.5, "C_eng": 0.1541}
WANTED = {"C21": 0.05, "C76": 0.01, "C_eng": 0.01}
RPM = math.pi / 30
WHEEL, BOTH = ("omega",), ("omega", "omega_load")
RUN_UPS = ((1000, 2600, 2.0), (800, 3000, 20.0))  # RPM, RPM, s; the first one is quick


@dataclass(frozen=True)
class RunUp:
    """Load [N m] that is let go at time 0, so that the engine speeds up by `rate` [rad/s²] at constant combustion."""

    rate: float

    def __call__(self, time):
        inertia = 1 / 33.39 + 4 / 22.3 + 1 / 5.968 + 1 / 5.646
        return 57.0 + (self.rate * inertia if time <= 0 else -0.1541 * self.rate * time)


def parameters():
    """Six numbers of Table 4.12, J7, K76 and all dampers free; ties (4.15), (4.16)."""
    made = thesis_ties(MODEL.parameters())
    made.free("J7", "K76", *DAMPERS)
    return made


def candidates(quick):
    record = ce.read_experiment(shared.ROOT / "data" / "crankshaft" / "normal_1200rpm.csv.gz")

    def planned(**options):
        return plan(MODEL, record, outputs=options.pop("outputs", WHEEL), **options)

    every = {2: "all"}
    made = {f"misfire {rpm} RPM": planned(speed=rpm * RPM, misfire=every) for rpm in (1000, 1400, 1800)}
    made["normal 1200 RPM"] = planned()
    made["misfire 1200 RPM"] = planned(misfire=every)
    made["misfire 1200 RPM, load speed too"] = planned(misfire=every, outputs=BOTH)
    made["load step of 30 N m"] = planned(load_step=(0.2, 30.0))
    for first, last, seconds in RUN_UPS[:1] if quick else RUN_UPS:
        name = f"run-up {first}-{last} RPM in {seconds:g} s"
        made[name] = planned(run_up=(first * RPM, last * RPM), duration=seconds)
    return made


def confirm(quick):
    """Make the run-up that was chosen, and fit everything to it, from starts 20 % off."""
    first, last, seconds = RUN_UPS[0 if quick else 1]
    load = RunUp((last - first) * RPM / seconds)
    made = shared.record(
        "crankshaft", first, load=load, duration=seconds, cycles=1000, scatter_seed=5, rtol=1e-8
    )
    made["T_load"][0] = made["T_load"][1]  # the load that is there from time 0 on
    start = parameters()
    for k, name in enumerate(start.keys()):
        if start[name].vary and start[name].tie is None:
            start[name].set((1.2, 0.8)[k % 2] * start[name].value)
    model = ce.crankshaft(reciprocating_speed="measured")
    return ce.estimate(
        model, shared.experiment(made), parameters=start, noise=ce.Noise(omega=SIGMA), progress=False
    )


def draw(choice, fit, out):
    figure, axes = shared.panels(1, 1, width=11, height=4.4)
    ax = axes[0, 0]
    for k, (label, one) in enumerate(choice.candidates.items()):
        values = [100 * (one.relative[name] or math.nan) for name in DAMPERS]
        chosen = label in choice.chosen
        ax.plot(values, "o" if chosen else ".", color=f"C{k}", markersize=9 if chosen else 6, label=label)
    ax.plot(
        [shared.error(fit, name, DAMPERS) for name in DAMPERS], "x", color="black", label="error of the fit"
    )
    ax.axhline(20, color="0.6", linestyle=":")
    ax.set_xticks(range(len(DAMPERS)), list(DAMPERS))
    ax.set(yscale="log", ylabel="standard error [% of the value]", title="attainable errors of the dampers")
    ax.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(out / "dampers.png", dpi=110)


def page(quick, out):
    noise = ce.Noise(omega=SIGMA, omega_load=SIGMA)
    choice = ce.choose_experiments(
        MODEL, candidates(quick), parameters=parameters(), noise=noise, criterion=WANTED, size=1
    )
    print(choice)
    planned, fit = {name: 100 * (choice.relative[name] or math.inf) for name in DAMPERS}, confirm(quick)
    rows = [
        [name, f"{planned[name]:.2g}", f"{stderr(fit, name):.2g}", f"{shared.error(fit, name, DAMPERS):.2g}"]
        for name in DAMPERS
    ]
    head = ["damper", "planned error %", "claimed by the fit %", "error found %"]
    shared.print_table(f"{choice.chosen[0]}, made and fitted ({fit.status})", head, rows)
    draw(choice, fit, out)
    return compare(choice, planned, fit)


def compare(choice, planned, fit):
    def off(name):
        return shared.error(fit, name, DAMPERS)

    normal = choice.candidates["normal 1200 RPM"].relative
    hours = {name: choice.length_for(name, 0.05) / 3600 for name in ("C32", "C65")}
    told = {name: f"{name} {off(name):.2g} ± {stderr(fit, name):.2g} %" for name in ("C21", "C76")}
    return [
        Line("chapter 6", "normal records give no dampers", f"C21 ± {100 * normal['C21']:.0f} %, C76 ± "
             f"{100 * normal['C76']:.1f} %", "true of C21", normal["C21"] > 0.5 and normal["C76"] < 0.03),
        Line("chapter 6 (b)", "a technique is wanted: C21, C76",
             f"a {choice.chosen[0]}, off by {', '.join(told.values())}", "chosen by its attainable error",
             all(off(n) < 3 * stderr(fit, n) for n in told) and planned["C21"] < 5),
        Line("chapter 6 (b)", "the sum of the absolute dampers", f"C_eng off by {off('C_eng'):.2g} %",
             "told; the linear form is off by more than its error", off("C_eng") < 0.1),
        Line("chapter 6 (b)", "C32 and C65, between cylinders",
             f"planned ± {planned['C32']:.0f} and {planned['C65']:.0f} %; 5 % take {hours['C32']:.1f} and "
             f"{hours['C65']:.1f} h of it", "many run-ups, or fix them", min(planned["C32"], planned["C65"]) > 20),
    ]  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(shared.run(page, "dampers", __doc__))
