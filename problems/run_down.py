"""Run-down of a single-cylinder engine as one inertia: its inertia and friction from cylinder pressure.

State    omega_eng [rad/s]
Inputs   theta [rad], p1 [Pa]        Output   omega [rad/s], one value for each tooth of a 60-2 wheel

The record is an .npz with the decoded wheel and the pressure, each with its own times:
    edge_time_s, edge_slot                 tooth edges; slot modulo 60, 0 the first edge after the gap
    omega_time_s, omega_rad_s, omega_step  mean speed between two edges, and how many slots they span
    theta_time_s, theta_deg, p_rel_bar     pressure at each degree from slot 0 on; relative, and it drifts

    casadi-engine fit problems/run_down.py --data RECORD.npz
    python problems/run_down.py RECORD.npz        the scatter of J_eng between engine cycles

The gas torque gives the scale: an error of the pressure's scale is one of J_eng and T_f, and no test sees it.
The residual is not white (what is left repeats with the crank angle): the printed standard errors count with it as
coloured noise; the scatter between cycles assumes nothing of it. T_f follows TDC (-0.25 N m per degree), J_eng hardly.
"""

import sys
from dataclasses import replace

import numpy as np
from scipy.signal import savgol_filter

import casadi_engine as ce
from casadi_engine.model import Geometry

# A guess (piston, pin, rings, a third of the rod); J_eng falls by 2e-5 kg m2 for 0.01 kg more. Left free it
# ends near 0: the speed shows less of the second order than any real piston makes. So it stays fixed.
MASS = 0.22  # kg
GEOMETRY = Geometry.from_bore(0.0677, stroke=0.055, rod=0.0842, mass=MASS, p_crank=1.5e4)
# The motored pressure peaks 243.7 degrees after slot 0. Heat loss puts the peak about half a degree before
# TDC, and with 244.2 the simulated speed is nearest to the measured one, too.
TDC = 244.2  # deg after slot 0
GAP = (0, 1, 55, 56, 57)  # speeds that begin at these slots feel the gap of the wheel


def model():
    return ce.one_inertia(
        name="run_down",
        cylinders=1,
        geometry=GEOMETRY,
        reciprocating_speed="model",
        reciprocating_inertia="variable",  # J_eng is the total mean inertia
        friction_torque=0.8,
    )


def parameters(m):
    p = m.parameters()
    p["J_eng"].set(0.02, min=0.002, max=0.2)  # kg m2
    p["T_f"].set(0.8, min=0, max=10)  # N m
    p["p_crank"].set(1.5e4, min=-1e5, max=1e5, vary=True)  # Pa above the pressure at the start of compression
    p.fix("C_eng", 0)  # one record does not tell it from T_f
    return p


def read(path):
    exp = ce.Experiment.from_npz(
        path,
        channels={
            "theta": ("theta_time_s", "theta_deg", "deg"),
            "p1": ("theta_time_s", "p_rel_bar", "bar"),
            "omega": ("omega_time_s", "omega_rad_s", "rad/s"),
            "step": ("omega_time_s", "omega_step", "1"),
            "slot": ("edge_time_s", "edge_slot", "1"),
        },
        inputs=("theta", "p1"),
    )
    slot = exp["slot"].values[: len(exp["omega"])].astype(int) % 60
    exp = exp.masked("omega", (exp["step"].values == 1) & ~np.isin(slot, GAP)).without("step", "slot")
    return even_teeth(peg(from_combustion_tdc(exp)), slot)


def from_combustion_tdc(exp):
    """Count theta from the TDC that ends a compression, not from slot 0."""
    theta, p = exp["theta"].values - np.radians(TDC), exp["p1"].values
    turn = np.rint(theta / (2 * np.pi))
    top = np.abs(theta - 2 * np.pi * turn) < np.radians(5)
    odd = p[top & (turn % 2 == 1)].mean() > p[top & (turn % 2 == 0)].mean()
    first = TDC + 360 * int(odd)
    return changed(exp, "theta", theta - 2 * np.pi * odd, "from_combustion_tdc", tdc_deg=first)


def peg(exp):
    """Take the sensor's drift away: the pressure at the start of each compression lies on a line in time."""
    theta, p, time = exp["theta"].values, exp["p1"].values, exp["theta"].time
    near = np.abs((theta + np.pi + 2 * np.pi) % (4 * np.pi) - 2 * np.pi) < np.radians(20)
    line = np.polyfit(time[near], p[near], 1)
    return changed(exp, "p1", p - np.polyval(line, time), "peg", drift_bar_per_s=round(line[0] / 1e5, 4))


def even_teeth(exp, slot):
    """Divide out the pitch errors of the teeth: what each tooth does in all turns against its neighbours."""
    omega, keep = exp["omega"], exp["omega"].mask
    filled = np.interp(omega.time, omega.time[keep], omega.values[keep])
    ratio = omega.values / savgol_filter(filled, 9, 3)  # over 9 teeth: the engine's orders stay
    pitch = np.ones(60)
    for k in np.unique(slot[keep]):
        pitch[k] = np.median(ratio[keep & (slot == k)])
    spread = round(float(np.std(pitch[np.unique(slot[keep])])), 5)
    return changed(exp, "omega", omega.values / pitch[slot], "even_teeth", relative_spread=spread)


def changed(exp, name, values, function, **arguments):
    """Replace a channel's values, and write into the history what was done."""
    done = exp.with_channel(replace(exp[name], values=values, origin="derived"))
    step = replace(done.history[-1], function=function, arguments={"channel": name, **arguments})
    return replace(done, history=(*exp.history, step))


def problem():
    m = model()
    return ce.Problem(
        name="run_down",
        goal=__doc__,
        model=m,
        parameters=parameters(m),
        read=read,
        noise=ce.Noise(omega="estimate"),
    )


def leave_one_cycle_out(exp, m, p):
    """J_eng [kg m2] without each engine cycle's speeds, and the jackknife's standard error."""
    time, theta = exp["theta"].time, exp["theta"].values
    omega = exp["omega"]
    cycle = np.floor((np.interp(omega.time, time, theta) + 2 * np.pi) / (4 * np.pi))
    found = [
        ce.estimate(m, exp.masked("omega", cycle != k), parameters=p, progress=False).values["J_eng"]
        for k in np.unique(cycle[omega.mask])
    ]
    return np.array(found), np.sqrt((len(found) - 1) * np.var(found))


if __name__ == "__main__":
    m = model()
    for path in sys.argv[1:]:
        values, error = leave_one_cycle_out(read(path), m, parameters(m))
        print(f"{path}: J_eng without one cycle {values.round(5)}, standard error {error:.2g} kg m2")
