"""Block matrices: q samples of a linear model advanced by one matrix product.

From x (n,) at the start of a block and the drives v at its q + 1 samples, one product gives the state at the block's
end and the outputs at the chosen samples of the block:

    [x_end; y] = P [x; v_0; ...; v_q]

P and its parameter derivatives are made once per iterate from the discrete matrices; the work per sample of a record
is then one row of a large matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation import jets
from casadi_engine.simulation.discretisation import Discretisation, long_transition
from casadi_engine.simulation.jets import Array


@dataclass(frozen=True)
class Blocks:
    """Jet of the block matrix: p (k, n + rows*ny, n + (q+1)*m); the outputs stand sample by sample."""

    p: Array
    states: int
    length: int
    samples: NDArray[np.intp]  # sample numbers within the block at which outputs are given


def _powers(discrete: Discretisation, length: int) -> Array:
    """Jets of F^l [I, G0, G1] for l = 0 .. length, side by side; (k, n, (length+1) * (n + 2m))."""
    nz, n = discrete.parameters, discrete.f.shape[1]
    base = np.concatenate([jets.constant(np.eye(n), nz, discrete.order), discrete.g0, discrete.g1], axis=2)
    chain, power, have, width = base, discrete.f, 1, base.shape[2]
    while have < length + 1:
        need = min(have, length + 1 - have)
        chain = np.concatenate([chain, jets.product(power, chain[:, :, : need * width], nz)], axis=2)
        have += need
        if have < length + 1:
            power = jets.product(power, power, nz)
    return chain


def second_powers(discrete: Discretisation, length: int) -> Array | None:
    """Second derivatives (pairs, n, length+1, n + 2m) of what the block matrix is made of; None where C moves, for then
    it is made of more."""
    nz, n = discrete.parameters, discrete.f.shape[1]
    if not jets.is_constant(discrete.c):
        return None
    return _powers(discrete, length)[1 + nz :].reshape(-1, n, length + 1, n + 2 * discrete.g0.shape[2])


def second_products(
    discrete: Discretisation, powers: Array, samples: NDArray[np.intp], outer: Array
) -> Array:
    """Sums (pairs,) of the products of the block matrix's second derivatives with weights ``outer`` of its shape.

    powers : of ``second_powers``. The block matrix holds each of them many times: their weights are summed, and it is
    not made.
    """
    (_, n, count, _), m, c = powers.shape, discrete.g0.shape[2], discrete.c[0]
    seen = outer[n:].reshape(len(samples), len(c), -1)
    states = np.concatenate([c.T @ seen, outer[None, :n]])
    weights = np.zeros((count, n, powers.shape[3]))
    held, ramp = weights[:, :, n : n + m], weights[:, :, n + m :]
    for at, state in zip([*samples.tolist(), count - 1], states, strict=True):
        drives = state[:, n:].reshape(n, count, m).swapaxes(0, 1)
        weights[at, :, :n] += state[:, :n]
        held[:at] += drives[at - 1 :: -1] if at else 0.0  # a drive acts one step after its sample
        ramp[:at] += drives[at:0:-1]  # and where it ends a step at once
    found = powers.reshape(len(powers), -1) @ weights.swapaxes(0, 1).ravel()
    second = discrete.d[1 + discrete.parameters :]
    if second.any():
        rows = enumerate(samples.tolist())
        direct = sum(seen[row][:, n + at * m : n + (at + 1) * m] for row, at in rows)
        found += second.reshape(len(second), -1) @ np.ravel(direct)
    return np.asarray(found)


def block_matrices(
    discrete: Discretisation, length: int, samples: NDArray[np.intp], *, lasting: bool = True
) -> Blocks:
    """The block matrix of ``length`` samples with outputs at ``samples`` (numbers 0 .. length-1).

    lasting : without derivatives, the last digit of the transition is right: a simulation may run for long
    """
    nz, n, m = discrete.parameters, discrete.f.shape[1], discrete.g0.shape[2]
    ny, k = discrete.c.shape[1], len(discrete.f)
    chain = _powers(discrete, length).reshape(k, n, length + 1, n + 2 * m)
    free = chain[..., :n]
    # The response at sample s to the drive at sample j depends on the lag s - j only, but for the first column.
    lag = np.zeros((k, n, length + 2, m))
    lag[:, :, 1 : length + 2] = chain[..., n : n + m]
    first = lag.copy()
    lag[:, :, : length + 1] += chain[..., n + m :]
    at = np.concatenate([samples, [length]])
    behind = at[:, None] - np.arange(length + 1)[None, :]
    index = np.where(behind >= 0, behind, length + 1)
    lag[:, :, length + 1] = 0.0
    forced = lag[:, :, index, :]
    forced[:, :, :, 0, :] = first[:, :, at, :]
    rows = len(samples)
    x_end = np.concatenate([free[:, :, length], forced[:, :, rows].reshape(k, n, -1)], axis=2)
    if discrete.order == 0 and lasting:
        exact = long_transition(discrete, length)
        if exact is not None:
            x_end[0, :, :n] = exact
    wide = np.concatenate([free[:, :, samples], forced[:, :, :rows].reshape(k, n, rows, -1)], axis=3)
    flat = wide.reshape(k, n, -1)
    c = discrete.c
    y = c[0] @ flat if jets.is_constant(c) else jets.product(c, flat, nz)
    y = y.reshape(k, ny, rows, -1)
    y = np.ascontiguousarray(y.transpose(0, 2, 1, 3))
    if discrete.d.any():
        for row, sample in enumerate(samples):
            y[:, row, :, n + sample * m : n + (sample + 1) * m] += discrete.d
    return Blocks(np.concatenate([x_end, y.reshape(k, rows * ny, -1)], axis=1), n, length, samples)
