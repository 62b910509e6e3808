"""How fast a predictor forgets: a smooth estimate of its closed loop's spectral radius.

Unit noise that enters the closed loop F at each of m samples adds up to Y = sum F^k F^k'. Of these errors F^m Y F^m' is
left after m more samples, and log(tr F^m Y F^m' / tr Y) / 2m tends to log rho(F) as m grows: kept below zero it keeps
all eigenvalues inside the unit circle. It is defined for stable and unstable F alike and smooth also where two
eigenvalues meet or take turns in being the largest, where the largest itself is not. The sum over m samples averages
the phase of oscillations, which makes the norm of F^m alone (Gelfand 1941) a wiggly function of the parameters. Each
doubling of m takes a few matrix products; compare the Lyapunov form of Vanbiervliet et al., SIAM J. Optim. 20 (2009).
"""

from __future__ import annotations

import numpy as np

from casadi_engine.simulation import jets
from casadi_engine.simulation.jets import Array


def log_decay(f: Array, d: int, doublings: int) -> Array:
    """Jet (k,) of log(tr F^m Y F^m' / tr Y) / 2m, m = 2^doublings, of a jet F (k, n, n) in d parameters.

    -inf with zero derivatives where F^m vanishes.
    """
    power, log = f, 0.0  # F^m is power * exp(log)
    sum_ = jets.constant(np.eye(f.shape[1]), d, len(jets.orders(f, d)))
    left = sum_
    for k in range(doublings + 1):
        # Sizes are taken out at each squaring, or powers would leave the range of numbers.
        size = float(np.linalg.norm(power[0]))
        if size == 0.0:
            return np.concatenate([[-np.inf], np.zeros(len(f) - 1)])
        power, log = power / size, log + np.log(size)
        left = jets.product(jets.product(power, sum_, d), jets.transpose(power), d)
        if k == doublings:
            break
        # What came first is the smaller part where the loop grows, what comes where it decays.
        early, late = np.exp(min(-2 * log, 0.0)), np.exp(min(2 * log, 0.0))
        sum_ = sum_ * early + left * late
        power, log = jets.product(power, power, d), 2 * log
    total = _log(np.trace(left, axis1=1, axis2=2), d) - _log(np.trace(sum_, axis1=1, axis2=2), d)
    total[0] += 2 * log
    return total / 2.0 ** (doublings + 1)


def _log(x: Array, d: int) -> Array:
    """The jet (k,) of a logarithm."""
    found = x / x[0]
    first = found[1 : 1 + d]
    if len(x) > 1 + d:
        i, j = jets.pairs(d)
        found[1 + d :] -= first[i] * first[j]
    found[0] = np.log(x[0])
    return found
