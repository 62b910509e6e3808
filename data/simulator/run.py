"""Integrate an engine on a shaft, from a warmed-up start, and sample what sensors would see."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from .engine import Engine
from .geometry import CYCLE
from .shaft import Shaft

Load = Callable[[float], float]
Extra = Callable[[float, np.ndarray], np.ndarray]

WARM_UP_CYCLES = 60  # at most
SETTLED = 1e-4  # rad/s between one warm-up cycle and the next


@dataclass(frozen=True)
class Start:
    """What a warm-up comes to: the burn strength [Pa], and the state (2n,) at angle 0."""

    strength: float
    state: tuple[float, ...]


@dataclass(frozen=True)
class Plant:
    """What the state equation needs; `extra(t, state)` is a torque on each inertia (n,), or None."""

    shaft: Shaft
    engine: Engine
    load: Load
    extra: Extra | None = None

    def equation(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Right-hand side f(t, state); cylinders see their own throw's angle and speed (nonlinear form)."""
        shaft, load, extra = self.shaft, self.load, self.extra
        torques = self.engine.torque_law()
        matrix, columns = shaft.matrix(), shaft.torque_columns()
        throws = list(shaft.throws)
        # one product gives the linear part, the angles of the four throws and their speeds
        everything = np.vstack([matrix, shaft.angle_rows()[throws], np.eye(2 * shaft.size)[1:][throws]])
        size, last = 2 * shaft.size, shaft.size
        spins = slice(1, 1 + shaft.size)

        def derivative(time: float, state: np.ndarray) -> np.ndarray:
            product = everything @ state
            seen = product[size:].tolist()
            rate = product[:size] + columns @ torques(seen[:4], seen[4:])
            rate[last] -= load(time) / shaft.inertia[-1]
            if extra is not None:
                rate[spins] += extra(time, state) / shaft.inertia
            return rate

        return derivative


def tolerances(shaft: Shaft, rtol: float) -> np.ndarray:
    """Absolute tolerances of the states: angle, speeds, twists (a twist is 1e-5 to 3e-2 rad)."""
    n = shaft.size
    return np.concatenate([[10.0], np.full(n, 10.0), np.full(n - 1, 1e-3)]) * rtol


def integrate(plant: Plant, start: np.ndarray, times: np.ndarray, *, rtol: float = 1e-11) -> np.ndarray:
    """States (2n, N) at `times` [s] from the state at times[0]."""
    solution = solve_ivp(
        plant.equation(),
        (times[0], times[-1]),
        start,
        method="DOP853",
        t_eval=times,
        rtol=rtol,
        atol=tolerances(plant.shaft, rtol),
    )
    if not solution.success:
        raise RuntimeError(f"the integrator stopped: {solution.message}")
    return solution.y


def one_cycle(plant: Plant, start: np.ndarray, *, rtol: float = 1e-7) -> tuple[float, np.ndarray]:
    """Duration of the cycle that begins with `start` at angle 0 [s], and the state at its end, angle 4 pi."""

    def end(_time: float, state: np.ndarray) -> float:
        return state[0] - CYCLE

    end.terminal = True  # type: ignore[attr-defined]
    limit = 2.0 * CYCLE / start[1]
    atol = tolerances(plant.shaft, rtol)
    solution = solve_ivp(
        plant.equation(), (0.0, limit), start, method="DOP853", events=end, rtol=rtol, atol=atol
    )
    if not solution.t_events or not solution.y_events or not len(solution.t_events[0]):
        raise RuntimeError("the engine stalled in a warm-up cycle")
    return float(solution.t_events[0][0]), solution.y_events[0][0]


def warm_up(plant: Plant, speed: float) -> tuple[Engine, np.ndarray]:
    """Run the mean cycle until it repeats itself at the wanted mean `speed` [rad/s].

    After every cycle the burn strength is moved by the torque that was missing to end at the speed it began
    with, and all speeds together by what the mean speed lacks.  Returns the engine with that strength, and
    the state at angle 0.
    """
    shaft, load = plant.shaft, plant.load(0.0)
    friction = float(shaft.absolute_damping.sum()) * speed
    engine = plant.engine.with_strength(plant.engine.strength_for(load + friction))
    per_torque = engine.strength_for(1.0) - engine.strength_for(0.0)
    state = shaft.steady_state(speed, load + friction)
    spins = slice(1, 1 + shaft.size)
    for _ in range(WARM_UP_CYCLES):
        mean_cycle = Plant(shaft, engine.before_record(), lambda _t: load, plant.extra)
        duration, end = one_cycle(mean_cycle, state)
        gained = float(shaft.inertia @ (end[spins] - state[spins]))
        off_speed = speed - CYCLE / duration
        settled = np.abs(end[spins] - state[spins]).max() < SETTLED and abs(off_speed) < SETTLED
        state = end.copy()
        state[0] = 0.0
        if settled:
            return engine, state
        engine = engine.with_strength(engine.strength - per_torque * gained / duration)
        state[spins] += off_speed - 0.5 * gained / float(shaft.inertia.sum())
    raise RuntimeError(f"the engine did not settle at {speed:.3f} rad/s in {WARM_UP_CYCLES} warm-up cycles")
