"""Motion with dry friction by SciPy: sliding either way and sticking, each integrated until it ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

_REST = 1e-9


def motion(free: Callable[..., Any], speed: int, dry: tuple[float, float], times: Any, start: Any) -> Any:
    """States (n, N) at `times`.

    free(t, x, friction) : ẋ, affine in the friction force, which acts on the state number `speed`
    dry : size of the friction when moving in the positive and in the negative direction
    """
    now, x = times[0], np.array(start, float)
    made = np.empty((len(x), len(times)))
    made[:, 0], done = x, 1
    while done < len(times):
        mode = _mode(free, speed, dry, now, x)
        found = _until_it_ends(free, speed, dry, mode, (now, times[-1]), x)
        inside = (times >= now) & (times <= found.t[-1]) & (np.arange(len(times)) >= done)
        made[:, inside] = found.sol(times[inside])
        done += int(inside.sum())
        now, x = found.t[-1], found.y[:, -1].copy()
        if mode == 0 or found.status == 1:
            x[speed] = 0.0
    return made


def _holding(free: Any, speed: int, t: float, x: Any) -> float:
    """The friction that keeps the speed where it is."""
    at_none = free(t, x, 0.0)[speed]
    return float(-at_none / (free(t, x, 1.0)[speed] - at_none))


def _mode(free: Any, speed: int, dry: tuple[float, float], t: float, x: Any) -> int:
    if abs(x[speed]) > _REST:
        return int(np.sign(x[speed]))
    hold = _holding(free, speed, t, x)
    if -dry[0] * (1 - 1e-9) <= hold <= dry[1] * (1 - 1e-9):
        return 0
    return 1 if hold < 0 else -1


def _until_it_ends(free: Any, speed: int, dry: tuple[float, float], mode: int, span: Any, x: Any) -> Any:
    if mode == 0:

        def stuck(t: float, x: Any) -> Any:
            return free(t, x, _holding(free, speed, t, x))

        def breaks(t: float, x: Any) -> float:
            hold = _holding(free, speed, t, x)
            return min(hold + dry[0], dry[1] - hold)

        breaks.terminal, breaks.direction = True, -1  # type: ignore[attr-defined]
        return _solved(stuck, breaks, span, x)

    def sliding(t: float, x: Any) -> Any:
        return free(t, x, -dry[0] if mode > 0 else dry[1])

    def stops(t: float, x: Any) -> float:
        return mode * x[speed] if t > span[0] else 1.0

    stops.terminal, stops.direction = True, -1  # type: ignore[attr-defined]
    return _solved(sliding, stops, span, x)


def _solved(rhs: Any, event: Any, span: Any, x: Any) -> Any:
    return solve_ivp(rhs, span, x, events=event, dense_output=True, rtol=1e-8, atol=1e-10, max_step=0.02)
