"""SciPy at a relative 1e-11, started anew at every jump, at every sample of an input, and where a law changes sides."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
RELATIVE = 1e-11


@dataclass(frozen=True, eq=False)
class Pieces:
    """Inputs (time, SI values), joined by lines ("first") or held until the next sample ("zero")."""

    channels: Mapping[str, tuple[Array, Array]]
    hold: str

    def knots(self) -> Array:
        """Times at which an input has a sample."""
        return np.unique(np.concatenate([[], *(t for t, _ in self.channels.values())]))

    def between(self, first: float, last: float) -> Callable[[float], dict[str, float]]:
        """The inputs as functions of time on an interval that holds no sample inside."""
        lines = {}
        middle = (first + last) / 2
        for name, (t, v) in self.channels.items():
            k = int(np.clip(np.searchsorted(t, middle, side="right") - 1, 0, len(t) - 2))
            slope = 0.0 if self.hold == "zero" else (v[k + 1] - v[k]) / (t[k + 1] - t[k])
            lines[name] = (t[k], v[k], slope)
        return lambda now: {name: v + slope * (now - t) for name, (t, v, slope) in lines.items()}

    def at(self, time: Array) -> dict[str, Array]:
        """Values at the times; at a jump those after it."""
        made = {}
        for name, (t, v) in self.channels.items():
            k = np.clip(np.searchsorted(t, time, side="right") - 1, 0, len(t) - 1)
            made[name] = v[k] if self.hold == "zero" else np.interp(time, t, v)
        return made


def solve(
    rates: Callable[..., Any],
    p: Mapping[str, float],
    x0: Array,
    first: float,
    time: Array,
    pieces: Pieces,
    breaks: tuple[float, ...] = (),
    switch: Callable[..., Any] | None = None,
    method: str = "DOP853",
) -> Array:
    """States (n, N) at the times."""
    last = float(time[-1])
    stops = np.concatenate([[first, last], pieces.knots(), np.asarray(breaks, dtype=float)])
    stops = np.unique(stops[(stops >= first) & (stops <= last)])
    x, made, mode = np.array(x0, dtype=float), np.empty((len(x0), len(time))), 0
    size = np.maximum(np.abs(x), 1e-3)
    for a, b in itertools.pairwise(stops.tolist()):
        inside = (time >= a) & (time <= b)
        u = pieces.between(a, b)
        if switch is None:
            answer = _smooth(_inside(rates, p, u, a, b), x, a, b, size, method=method)
            if inside.any():
                made[:, inside] = answer.sol(time[inside])
            x = answer.y[:, -1]
        else:
            x, mode = _switched(rates, p, u, switch, x, mode, (a, b), (time, inside, made), size)
        size = np.maximum(size, np.abs(x))
    return made


def _inside(
    rates: Callable[..., Any],
    p: Mapping[str, float],
    u: Callable[[float], dict[str, float]],
    a: float,
    b: float,
) -> Callable[[float, Array], Array]:
    """The rates on one piece: a jump at either end belongs to the neighbour, so the ends are seen from inside."""
    first, last = a + 1e-12 * (b - a), b - 1e-12 * (b - a)

    def f(t: float, x: Array) -> Array:
        now = min(max(t, first), last)
        return np.asarray(rates(now, x, p, u(now)), dtype=float)

    return f


def _smooth(
    f: Callable[[float, Array], Array],
    x: Array,
    a: float,
    b: float,
    size: Array,
    events: Any = None,
    method: str = "DOP853",
) -> Any:
    """One smooth piece."""
    options: dict[str, Any] = {
        "rtol": RELATIVE,
        "atol": RELATIVE * size,
        "dense_output": True,
        "events": events,
    }
    answer = solve_ivp(f, (a, b), x, method=method, **options)
    if not answer.success:
        raise RuntimeError(answer.message)
    return answer


def _switched(
    rates: Callable[..., Any],
    p: Mapping[str, float],
    u: Callable[[float], dict[str, float]],
    switch: Callable[..., Any],
    x: Array,
    mode: int,
    span: tuple[float, float],
    put: tuple[Array, Any, Array],
    size: Array,
) -> tuple[Array, int]:
    """A piece whose rates hold s = sign(g): on either side, or sliding along g = 0 with |s| <= 1 (Filippov).

    The rates are affine in s. mode : +1, -1, or 0 for "see where the state is".
    """
    a, b = span
    time, inside, made = put

    def g(t: float, x: Array) -> float:
        return float(switch(x, p))

    def side(s: float) -> Callable[[float, Array], Array]:
        return lambda t, x: np.asarray(rates(t, x, p, u(t), s), dtype=float)

    def drift(t: float, x: Array, s: float) -> float:
        """dg/dt with s; g is affine in x."""
        return float(switch(x + side(s)(t, x), p) - switch(x, p))

    def held(t: float, x: Array) -> float:
        up, down = drift(t, x, 1.0), drift(t, x, -1.0)
        return (up + down) / (down - up)

    mode = 0 if mode == 2 else mode  # an input may have jumped: what held may slide now
    for _ in range(500):
        if mode == 0:
            value = g(a, x)
            if abs(value) > 1e-9 * max(1.0, float(np.abs(x).max())):
                mode = 1 if value > 0 else -1
            else:
                up, down = drift(a, x, 1.0), drift(a, x, -1.0)
                mode = 2 if up < 0 < down else (1 if up >= 0 else -1)
        if mode == 2:
            f: Callable[[float, Array], Array] = lambda t, x: side(held(t, x))(t, x)  # noqa: E731
            event: Callable[[float, Array], float] = lambda t, x: 1 - abs(held(t, x))  # noqa: E731
        else:
            f, event = side(float(mode)), g
        event.terminal, event.direction = True, -1.0 if mode in (1, 2) else 1.0  # type: ignore[attr-defined]
        answer = _smooth(f, x, a, b, size, event)
        end = float(answer.t[-1])
        here = inside & (time >= a) & (time <= end)
        if here.any():
            made[:, here] = answer.sol(time[here])
        x = answer.y[:, -1]
        if answer.status == 0:
            return x, mode
        mode = (1 if held(end, x) > 0 else -1) if mode == 2 else 0
        if mode == 0:
            x = x.copy()
        elif abs(end - a) == 0:
            mode = 0
        a = end
    raise RuntimeError("the law changes sides without end")
