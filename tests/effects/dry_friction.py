"""A mass with dry friction by SciPy, from one reversal or rest to the next: no rounding anywhere."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq


def speed_of(time, force, mass, viscous, forward, backward, start=0.0):
    """(N,) speed of mass v' = force(t) - viscous v - friction, `forward` against v > 0 and `backward` against v < 0."""
    found, t, v = np.full(len(time), np.nan), time[0], float(start)
    while t < time[-1]:
        drive = force(t)
        way = np.sign(v) or (1.0 if drive > forward else -1.0 if drive < -backward else 0.0)
        if way == 0:  # held until the force is larger than the friction
            later = time[time > t]
            free = next((s for s in later if not -backward <= force(s) <= forward), None)
            if free is None:
                found[time >= t] = 0.0
                return found
            level = forward if force(free) > forward else -backward
            before = max([t, *later[later < free]])
            end = (
                before
                if force(before) == level
                else brentq(lambda s, level=level: force(s) - level, before, free)
            ) + 1e-9
            found[(time >= t) & (time <= end)] = 0.0
            t = end
            continue
        held = forward if way > 0 else -backward

        def rest(_, state, way=way):
            return state[0] * way + 1e-12

        rest.terminal, rest.direction = True, -1
        run = solve_ivp(
            lambda s, state, held=held: (force(s) - viscous * state - held) / mass,
            (t, time[-1]),
            [v or 1e-12 * way],
            events=rest,
            dense_output=True,
            rtol=1e-9,
            atol=1e-12,
        )
        end = float(run.t[-1])
        inside = (time >= t) & (time <= end)
        found[inside] = run.sol(time[inside])[0]
        t, v = end, 0.0
        if run.status != 1:
            break
    return found
