"""Random small models, records for them, and the same recursions written out as CasADi graphs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

from casadi_engine.experiment import Channel, Experiment
from casadi_engine.model import Blueprint
from casadi_engine.simulation.grid import Grid, Measured
from casadi_engine.simulation.observed import with_states_shown
from casadi_engine.simulation.split import split


def _linear_model(rng, *, states, inputs=1, outputs=1, parameters=2, through=True, offsets=True):
    """A random linear model: every matrix depends on the parameters in its own nonlinear way."""
    b = Blueprint("random")
    p = [b.parameter(f"p{i}", rng.uniform(0.5, 1.5)) for i in range(parameters)]
    x = [b.state(f"x{i}", scale=rng.uniform(0.2, 5.0)) for i in range(states)]
    u = [b.input(f"u{i}") for i in range(inputs)]
    drives = []
    for i, channel in enumerate(u):
        if i % 2 == 0 and p:
            drives.append(b.drive(f"d{i}", p[i % len(p)] ** 2 * channel + ca.sin(p[0] * b.time), unit="1"))
        else:
            drives.append(channel)

    def number():
        base = rng.normal()
        return (
            base * ca.exp(rng.normal() * 0.3 * p[rng.integers(len(p))])
            if p and rng.random() < 0.6
            else ca.SX(base)
        )

    for i in range(states):
        rate = sum((number() * other for other in x), -ca.SX(1.0) * x[i])
        rate += sum((number() * d for d in drives), ca.SX(0))
        b.ode(f"x{i}", rate + (number() if offsets else 0))
    for i in range(outputs):
        value = sum((number() * other for other in x), ca.SX(0)) + (number() if offsets else 0)
        b.output(f"y{i}", value + (sum((number() * d for d in drives), ca.SX(0)) if through else 0))
    return without_rates(b.model())


def _general_model(rng, *, states=2):
    """A smooth model with a nonlinear ode, nonlinear outputs, a channel, a drive and time in it."""
    b = Blueprint("bent")
    p = [b.parameter(f"p{i}", rng.uniform(0.5, 1.5)) for i in range(2)]
    x = [b.state(f"x{i}", scale=rng.uniform(0.5, 2.0)) for i in range(states)]
    u = b.input("u0")
    d = b.drive("d0", p[0] * u**2 + ca.cos(b.time), unit="1")
    for i in range(states):
        near = x[(i + 1) % states]
        b.ode(f"x{i}", -p[0] * x[i] + p[1] * ca.sin(near) * x[i] + rng.normal() * d - 0.1 * x[i] ** 3)
    b.output("y0", x[0] * p[1] + 0.3 * x[-1] ** 2 + 0.2 * d)
    b.output("y1", ca.tanh(x[-1]))
    return without_rates(b.model())


def without_rates(model):
    """A model for grids that are made by hand, of channels alone."""
    return replace(model, u=model.channels, rates=())


def _switched_model():
    """A model that jumps in time: a load that comes at an instant of its own, and a square wave."""
    b = Blueprint("switched")
    x, v, u = b.state("x"), b.state("v", scale=2.0), b.input("u0")
    on, size, rate = b.parameter("on", 0.537), b.parameter("size", 1.5), b.parameter("rate", 2.1)
    load = ca.if_else(b.time > on, size * ca.cos(b.time), 0)
    b.ode("x", v)
    b.ode("v", u - x - 0.3 * v * x**2 - load + 0.4 * ca.sign(ca.sin(rate * b.time + 0.3)))
    b.output("x", x)
    b.output("power", v * (x + u))
    return without_rates(b.model())


@dataclass(frozen=True)
class Made:
    """Makers of test objects, in one fixture because test folders share no modules."""

    linear = staticmethod(_linear_model)
    general = staticmethod(_general_model)
    switched = staticmethod(_switched_model)
    without_rates = staticmethod(lambda model: without_rates(model))

    @staticmethod
    def grid(channels, *, step=0.05, samples=None, holds=None, start=0.3, measured=None):
        """A grid with the given channels (nu, N)."""
        channels = np.atleast_2d(np.asarray(channels, dtype=float))
        count = channels.shape[1] if samples is None else samples
        return Grid(start, step, count, channels, holds or ("first",) * len(channels), measured or {})

    @staticmethod
    def points(grid, position, values=None):
        """Measured samples at positions in steps from the grid's start."""
        position = np.asarray(position, dtype=np.intp)
        values = np.zeros(len(position)) if values is None else np.asarray(values, dtype=float)
        time = grid.start + grid.step * position
        return Measured(time, values, position, np.arange(len(position)))

    @staticmethod
    def experiment(model, time, *, outputs=None, hold="first", **values):
        """A record on one time axis, units from the model."""
        units = {v.name: v.unit.replace("-", "1") for v in (*model.inputs, *model.outputs)}
        holds = hold if isinstance(hold, dict) else dict.fromkeys(values, hold)
        channels = []
        for name, row in values.items():
            own = (time, row) if not isinstance(row, tuple) else row
            channels.append(
                Channel(name, units[name], time=own[0], values=own[1], hold=holds.get(name, "first"))
            )
        return Experiment("run", tuple(channels))

    reference = staticmethod(lambda *arguments: Reference(*arguments))
    exact_step = staticmethod(lambda holds: exact_step(holds))
    euler_step = staticmethod(lambda *arguments: euler_step(*arguments))
    runge_kutta_step = staticmethod(lambda substeps=1: runge_kutta_step(substeps))
    krogstad_step = staticmethod(lambda *arguments: krogstad_step(*arguments))
    compare = staticmethod(lambda *arguments: compare(*arguments))
    by_interval = staticmethod(lambda *arguments: by_interval(*arguments))
    sample_numbers = staticmethod(lambda plan: sample_numbers(plan))
    off = staticmethod(lambda found, wanted: off(found, wanted))

    @staticmethod
    def scale(model):
        return np.array([state.scale for state in model.states])


@pytest.fixture(scope="session")
def made():
    return Made()


def _unrolled(model, grid, plan, physical, z, one_step, scale):
    """Function (z, start, u (nu, L+1), t0) -> outputs ((L+1)*ny, 1), end state: an interval written out."""
    x = ca.SX.sym("x", len(scale))
    u = ca.SX.sym("u", model.u.numel(), plan.length + 1)
    t0, zm = ca.SX.sym("t0"), ca.SX.sym("z", z.numel())
    p = ca.Function("physical", [z], [physical])(zm)
    out = ca.Function("out", [model.x, model.u, model.t, model.p], [model.closed_outputs])
    step = one_step(model, grid, p)
    state, rows, s = x, [], ca.DM(scale)
    for k in range(plan.length):
        rows.append(out(state * s, u[:, k], t0 + k * grid.step, p))
        state = step(state * s, u[:, k], u[:, k + 1], t0 + k * grid.step) / s
    rows.append(out(state * s, u[:, plan.length], t0 + plan.length * grid.step, p))
    return ca.Function("unrolled", [zm, x, u, t0], [ca.vertcat(*rows), state])


def krogstad_step(holds, substeps=1, terms=18):
    """The scheme with its phi functions as Taylor polynomials, drives and channels on straight lines."""

    def make(model, grid, p):
        parts = split(with_states_shown(model))
        inner, core, h = parts.model, parts.core, grid.step / substeps
        dense = [ca.densify(part) for part in (core.A, core.B, core.G, core.e)]
        a, b, g, e = ca.Function("core", [inner.p], dense)(p)
        whole, half = phi(a * h, terms), phi(a * h / 2, terms)
        arguments = [inner.u, inner.t, inner.p]
        drive = ca.Function("drive", arguments, [ca.densify(inner.drive_expressions)])
        law = ca.Function("law", [inner.x, *arguments], [parts.laws])
        first = ca.DM([1.0 if hold == "first" else 0.0 for hold in holds])

        def step(x, u0, u1, t):
            start, rise = drive(u0, t, p), drive(u1, t + grid.step, p) - drive(u0, t, p)
            for k in range(substeps):
                v0, dv = start + first * rise * k / substeps, first * rise / substeps

                def push(state, place, k=k):
                    share = (k + place) / substeps
                    return g @ law(state, u0 + first * (u1 - u0) * share, t + share * grid.step, p)

                middle = half[0] @ x + h / 2 * half[1] @ (b @ v0 + e) + h / 4 * half[2] @ (b @ dv)
                free = whole[0] @ x + h * whole[1] @ (b @ v0 + e) + h * whole[2] @ (b @ dv)
                n1 = push(x, 0)
                n2 = push(middle + h / 2 * half[1] @ n1, 0.5)
                n3 = push(middle + h * (half[1] / 2 - half[2]) @ n1 + h * half[2] @ n2, 0.5)
                n4 = push(free + h * (whole[1] - 2 * whole[2]) @ n1 + 2 * h * whole[2] @ n3, 1)
                x = free + h * (
                    (whole[1] - 3 * whole[2] + 4 * whole[3]) @ n1
                    + (2 * whole[2] - 4 * whole[3]) @ (n2 + n3)
                    + (4 * whole[3] - whole[2]) @ n4
                )
            return x

        return step

    return make


def phi(z, terms):
    """phi_0 .. phi_3."""
    found = []
    for k in range(4):
        power = ca.SX.eye(z.shape[0])
        total = power / math.factorial(k)
        for j in range(1, terms):
            power = power @ z
            total = total + power / math.factorial(k + j)
        found.append(total)
    return found


def exact_step(holds, terms=24):
    """Exact steps by one Taylor series of the exponential of the augmented matrix (Van Loan's way)."""

    def make(model, grid, p):
        core = model.linear
        n, m, h = core.A.shape[0], core.B.shape[1], grid.step
        a, b, e = ca.Function("core", [model.p], [ca.densify(part) for part in (core.A, core.B, core.e)])(p)
        # d/dtau [x; v; r; 1] with tau = t/h: v rises by r = v1 - v0 in a step.
        size = n + 2 * m + 1
        z = ca.SX.zeros(size, size)
        z[:n, :n], z[:n, size - 1] = a * h, e * h
        if m:
            z[:n, n : n + m] = b * h
            z[n : n + m, n + m : n + 2 * m] = ca.SX.eye(m)
        power = total = ca.SX.eye(size)
        for k in range(1, terms):
            power = power @ z / k
            total = total + power
        drive = ca.Function("drive", [model.u, model.t, model.p], [ca.densify(model.drive_expressions)])
        first = ca.DM([1.0 if hold == "first" else 0.0 for hold in holds])

        def step(x, u0, u1, t):
            v0, v1 = drive(u0, t, p), drive(u1, t + h, p)
            return (total @ ca.vertcat(x, v0, first * (v1 - v0), 1))[:n]

        return step

    return make


def euler_step(model, grid, p):
    """x + h dx/dt."""
    ode = ca.Function("ode", [model.x, model.u, model.t, model.p], [model.closed_ode])
    return lambda x, u0, u1, t: x + grid.step * ode(x, u0, t, p)


def runge_kutta_step(substeps=1):
    """The classical rule with linearly interpolated channels."""

    def make(model, grid, p):
        ode = ca.Function("ode", [model.x, model.u, model.t, model.p], [model.closed_ode])
        h = grid.step / substeps

        def step(x, u0, u1, t):
            def slope(state, after):
                return ode(state, u0 + (u1 - u0) * (after / grid.step), t + after, p)

            for k in range(substeps):
                at = k * h
                k1 = slope(x, at)
                k2 = slope(x + h / 2 * k1, at + h / 2)
                k3 = slope(x + h / 2 * k2, at + h / 2)
                k4 = slope(x + h * k3, at + h)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            return x

        return step

    return make


class Reference:
    """CasADi's own derivatives of a record cut into intervals, each interval written out sample by sample.

    Everything is in the order (sample, output) for the outputs and in scaled states.
    """

    def __init__(self, model, grid, plan, z, physical, scale, one_step):
        self.model, self.grid, self.plan = model, grid, plan
        self.n, self.nz, self.ny = len(scale), z.numel(), len(model.outputs)
        f = _unrolled(model, grid, plan, physical, z, one_step, scale)
        zs, x, u, t0 = f.sx_in()
        y, end = f(zs, x, u, t0)
        both = ca.vertcat(x, zs)
        rho, lam = ca.SX.sym("rho", y.numel()), ca.SX.sym("lam", self.n)
        jacobians = [ca.densify(ca.jacobian(part, both)) for part in (y, end)]
        self._first = ca.Function("first", [zs, x, u, t0], [y, end, *jacobians])
        hessian = ca.densify(ca.hessian(ca.dot(rho, y) + ca.dot(lam, end), both)[0])
        self._second = ca.Function("second", [zs, x, u, t0, rho, lam], [hessian])

    def _arguments(self, i):
        length, grid = self.plan.length, self.grid
        u = np.concatenate(
            [grid.channels, np.repeat(grid.channels[:, -1:], self.plan.padded + 1 - grid.samples, axis=1)],
            axis=1,
        )
        at = i * length
        return u[:, at : at + length + 1], grid.start + grid.step * at

    def first(self, z, nodes):
        """Per interval: y (L+1, ny), end (n,), dy (L+1, ny, n+nz), dend (n, n+nz), columns (start, z)."""
        found = []
        for i, node in enumerate(nodes):
            y, end, dy, dend = (
                np.asarray(part, dtype=float) for part in self._first(z, node, *self._arguments(i))
            )
            found.append(
                (y.reshape(-1, self.ny), end.ravel(), dy.reshape(-1, self.ny, self.n + self.nz), dend)
            )
        return [np.array(part) for part in zip(*found, strict=True)]

    def second(self, z, nodes, rho, lam):
        """(M, n+nz, n+nz) Hessians of sum(rho (M, L+1, ny) * y) + sum(lam (M, n) * end)."""
        return np.array(
            [
                np.asarray(self._second(z, node, *self._arguments(i), rho[i].ravel(), lam[i]), dtype=float)
                for i, node in enumerate(nodes)
            ]
        )


def by_interval(plan, ny, y):
    """(..., R*ny, b, M) of a propagator as (M, samples of the interval that have outputs, ny, ...)."""
    rows = y.reshape(*y.shape[:-3], len(plan.samples), ny, plan.b, plan.m)
    moved = np.moveaxis(rows, (-1, -2, -4, -3), (0, 1, 2, 3))
    return moved.reshape(plan.m, plan.b * len(plan.samples), ny, *rows.shape[:-4])


def sample_numbers(plan):
    """Numbers within the interval of the samples that have outputs, in time order."""
    return (plan.q * np.arange(plan.b)[:, None] + plan.samples[None, :]).ravel()


def off(found, wanted):
    """Largest difference, relative to the largest wanted value."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert found.shape == wanted.shape
    if not wanted.size:
        return 0.0
    return float(np.abs(found - wanted).max() / max(np.abs(wanted).max(), 1e-12))


def compare(propagator, reference, z, nodes, rng):
    """Relative differences of value, first and second derivatives between a propagator and the reference.

    What lies behind the record's last sample does not count: nobody asks for it, and drives are held there.
    """
    plan, n, ny = propagator.intervals, reference.n, reference.ny
    path = propagator.propagate(z, nodes, 1)
    y, end, dy, dend = reference.first(z, nodes)
    at, m = sample_numbers(plan), plan.m
    real = (np.arange(m)[:, None] * plan.length + at[None, :]) < reference.grid.samples
    inner = (np.arange(m) + 1) * plan.length < reference.grid.samples
    found_y = by_interval(plan, ny, path.y)[real]
    ys = path.ys if path.ys.ndim == 4 else np.repeat(path.ys[:, :, None], m, axis=2)
    found_ys = by_interval(plan, ny, np.moveaxis(ys, -1, 0))[real]
    end_s = np.broadcast_to(path.end_s, (m, n, n))
    dy = dy[:, at][real]
    value = [off(found_y[..., 0], y[:, at][real]), off(path.end.T[inner], end[inner])]
    first = [
        off(found_y[..., 1:], dy[..., n:]),
        off(found_ys, dy[..., :n]),
        off(path.end_z.transpose(2, 1, 0)[inner], dend[inner][:, :, n:]),
        off(end_s[inner], dend[inner][:, :, :n]),
    ]
    spread = np.zeros((m, plan.length + 1, ny))
    weights = rng.normal(size=(m, len(at), ny)) * real[:, :, None]
    np.add.at(spread, (slice(None), at), weights)
    rho = weights.reshape(m, plan.b, len(plan.samples), ny).transpose(2, 3, 1, 0).reshape(-1, plan.b, m)
    lam = rng.normal(size=(n, m)) * inner
    hessian = reference.second(z, nodes, spread, lam.T)
    zz, zs, ss = propagator.contraction(z, path, rho, lam)
    second = [
        off(zz, hessian[:, n:, n:].sum(axis=0)),
        off(zs, hessian[:, n:, :n].transpose(1, 2, 0)),
        off(ss, hessian[:, :n, :n]),
    ]
    return max(value), max(first), max(second)
