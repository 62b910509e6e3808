"""Innovations form over many seeds: `python tests/benchmarks/innovations_study.py [--seeds 50] [--write]`.

Two masses with known process and measurement noise (innovations_data.py, which owes nothing to the package), starts
within 20 %: the estimated gain against the Riccati gain, parameter errors against those of output error, whiteness.
`--write` puts the dated table into INNOVATIONS.md beside this file.
"""

import argparse
import datetime
import sys
import time
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).parent))

import innovations_data as source

import casadi_engine as ce

NAMES = tuple(source.TRUTH)
STATES = ("omega_eng", "omega_load", "twist")
WAYS = {
    "output error": ce.Noise(omega="estimate"),
    "innovations, K free": ce.Noise(omega="innovations"),
    "Riccati, Q and R known": ce.Noise(omega=source.SIGMA, process=source.PROCESS),
    "Riccati, Q free, R known": ce.Noise(
        omega=source.SIGMA, process=dict.fromkeys(source.PROCESS, "estimate")
    ),
    "Riccati, Q and R free": ce.Noise(omega="estimate", process="estimate"),
}
COMMAND = "tests/benchmarks/innovations_study.py"
CHI2_99 = 11.3  # of three degrees of freedom


def two_masses():
    """The two-mass model with torques as inputs."""
    b = ce.Blueprint("two_mass_torques")
    je = b.parameter("J_eng", 0.39, unit="kg m2", min=1e-3, max=100)
    jl = b.parameter("J_load", 0.18, unit="kg m2", min=1e-3, max=100)
    k = b.parameter("K_el", 2000.0, unit="N m/rad", min=1, max=1e6)
    c = b.parameter("C_el", 2.5, unit="N m s/rad", min=0, max=1000)
    d = b.parameter("C_eng", 0.15, unit="N m s/rad", min=0, max=100)
    we = b.state("omega_eng", unit="rad/s", scale=100)
    wl = b.state("omega_load", unit="rad/s", scale=100)
    twist = b.state("twist", unit="rad", scale=0.1)
    torque, load = b.input("T", unit="N m", scale=100), b.input("T_load", unit="N m", scale=100)
    spring = k * twist + c * (wl - we)
    b.ode("omega_eng", (torque + spring - d * we) / je)
    b.ode("omega_load", (-spring - load) / jl)
    b.ode("twist", wl - we)
    b.output("omega", we, unit="rad/s", scale=100)
    return b.model()


def experiment(run, name="run"):
    """A run of the independent simulator as a record."""
    units = {"T": "N m", "T_load": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(
        name, time=run.time, units=units, T=run.torque, T_load=run.load, omega=run.y
    )


def started(model, rng, low, high):
    """A parameter set whose start is the truth times factors, log-uniform between low and high."""
    pars = model.parameters()
    for name in NAMES:
        pars[name].set(source.TRUTH[name] * low * (high / low) ** rng.random())
    return pars


def fit_all(model, seed):
    """Way -> numbers of its fit to the record of this seed."""
    data, rng, found = experiment(source.run(seed)), np.random.default_rng(10_000 + seed), {}
    pars = started(model, rng, 0.8, 1.2)
    lift, kalman, _ = source.stationary_gain()
    for way, noise in WAYS.items():
        clock = time.process_time()
        fit = ce.estimate(model, data, parameters=pars, noise=noise, progress=False)
        spent = time.process_time() - clock
        check = ce.validate(fit)
        error = np.array([fit.values[n] - source.TRUTH[n] for n in NAMES])
        at = [fit.free.index(n) for n in NAMES]
        own = fit.covariance[np.ix_(at, at)]
        row = {
            "converged": fit.converged,
            "cpu": spent,
            "error": error / np.array([source.TRUTH[n] for n in NAMES]),
            "z2": (error**2) / np.diag(own),
            "chi2": float(error @ np.linalg.solve(own, error)),
            "white": check.records["run"]["omega"].whiteness.p_value,
            "percent": fit.fit_percent["run"]["omega"],
        }
        gains = [f"gain.omega.{state}" for state in STATES]
        if gains[0] in fit.free:
            rows = [fit.free.index(g) for g in gains]
            gap = fit.gain[:, 0] - lift
            row["gain chi2"] = float(gap @ np.linalg.solve(fit.covariance[np.ix_(rows, rows)], gap))
        if fit.innovations is not None:
            gap = fit.innovations.kalman[:, 0] - kalman
            row["K z2"] = (gap / fit.innovations.stderr[:, 0]) ** 2
            row["K error"] = gap
            row["radius"] = fit.innovations.radius
        for name, level in source.PROCESS.items():
            if f"process.{name}" in fit.free:
                key = f"process.{name}"
                row[key] = (fit.values[key] - level) / fit.stderr[key]
        found[way] = row
    return found


def study(seeds):
    """Way -> key -> values over the seeds."""
    model, table = two_masses(), {way: {} for way in WAYS}
    for seed in range(seeds):
        for way, row in fit_all(model, seed).items():
            for key, value in row.items():
                table[way].setdefault(key, []).append(value)
    return table


def report(table, seeds):
    """The study as Markdown."""
    truth = f"process noise {source.PROCESS} rad/s per sqrt(s), measurement noise {source.SIGMA} rad/s"
    lines = [
        f"{seeds} seeds, {source.SAMPLES} samples at {source.RATE:g} Hz, one output; {truth}; starts within 20 %.",
        "",
        "| way | converged | median CPU [s] | rms error % of "
        + ", ".join(NAMES)
        + " | mean (error/stderr)^2 of each"
        " | joint chi2_5, mean | white at 1 % | fit % simulation / 1-step (mean) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for way, rows in table.items():
        rms = 100 * np.sqrt(np.mean(np.square(rows["error"]), axis=0))
        z2 = np.mean(rows["z2"], axis=0)
        simulation = np.mean([p["simulation"] for p in rows["percent"]])
        steps = [p["prediction"] for p in rows["percent"] if p["prediction"] is not None]
        cells = [
            way,
            f"{sum(rows['converged'])}/{seeds}",
            f"{np.median(rows['cpu']):.3f}",
            ", ".join(f"{value:.2f}" for value in rms),
            ", ".join(f"{value:.2f}" if value < 100 else f"{value:.0f}" for value in z2),
            f"{np.mean(rows['chi2']):.3g}",
            f"{sum(p > 0.01 for p in rows['white'])}/{seeds}",
            f"{simulation:.1f} / {np.mean(steps):.1f}" if steps else f"{simulation:.1f} / -",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    chi2 = np.array(table["innovations, K free"]["gain chi2"])
    p = stats.kstest(chi2, stats.chi2(3).cdf).pvalue
    kalman = source.stationary_gain()[1]
    lines += [
        "",
        "Gain against the Riccati gain of the truth (chi-squared with 3 degrees of freedom, by the fit's own "
        f"covariance): below {CHI2_99} in {int((chi2 < CHI2_99).sum())}/{seeds}, mean {chi2.mean():.2f} "
        f"(3 expected), largest {chi2.max():.1f}, Kolmogorov-Smirnov p {p:.2f}.",
        "",
        "| way | rms error of K, in units of "
        + ", ".join(f"{k:.4g}" for k in kalman)
        + " (the true K) | mean (error/stderr)^2"
        " | largest spectral radius |",
        "|---|---|---|---|",
    ]
    for way, rows in table.items():
        if "K error" in rows:
            rms = np.sqrt(np.mean(np.square(rows["K error"]), axis=0)) / np.abs(kalman)
            z2 = np.mean(rows["K z2"], axis=0)
            lines.append(
                f"| {way} | {', '.join(f'{v:.3f}' for v in rms)} | {', '.join(f'{v:.2f}' for v in z2)}"
                f" | {max(rows['radius']):.5f} |"
            )
    lines.append("")
    for way, rows in table.items():
        for name in source.PROCESS:
            z = rows.get(f"process.{name}")
            if z:
                lines.append(
                    f"- {way}: process.{name}, mean error {np.mean(z):+.2f} and rms {np.std(z):.2f} standard errors"
                )
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--write", action="store_true")
    chosen = parser.parse_args()
    text = report(study(chosen.seeds), chosen.seeds)
    print(text)
    if chosen.write:
        head = f"# Innovations form, {datetime.date.today():%Y-%m-%d}\n\n"
        path = Path(__file__).with_name("INNOVATIONS.md")
        path.write_text(f"{head}By `python {COMMAND} --write`.\n\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
