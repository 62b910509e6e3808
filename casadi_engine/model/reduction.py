"""How many degrees of freedom a range of frequencies needs, and the lumped model with that many."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.model.lumping import Groups, group, lump
from casadi_engine.model.model import Model
from casadi_engine.model.receptance import Receptance, receptance, response
from casadi_engine.model.skeleton import Skeleton, skeleton_of
from casadi_engine.parameters import Parameters, near_matches

Array = NDArray[np.float64]

# Receptances are compared at this many frequencies a decade and at the natural frequencies, from this share of the
# lowest one (below, every lumping is the rigid body) to this multiple of the highest.
PER_DECADE = 150
LOWEST, HIGHEST = 0.05, 1.5
# The range compared of a model without oscillatory modes [Hz].
RANGE = 100.0


@dataclass(frozen=True)
class Step:
    """One number of degrees of freedom on the way down.

    dof : inertias left      rigid : ports of the couplings that do not twist
    groups : names of the inertias left: ("1to6", "7")
    error : largest relative error of the receptances in the range
    limit_hz : frequency up to which the error stays within what is allowed [Hz]; infinite for the full model
    """

    dof: int
    rigid: tuple[str, ...]
    groups: tuple[str, ...]
    error: float
    limit_hz: float


@dataclass(frozen=True, eq=False)
class Reduction:
    """A model and its reduction by rigid lumping.

    full, model : the model and the lumped one      rigid : ports of the couplings that do not twist
    groups : ports of the inertias that move as one, for each inertia of the lumped model
    sums : the lumped model's new parameters by the original ones, as text: {"J1to6": "J1 + J2 + …"}
    values : the original parameters' values
    steps : what each number of degrees of freedom would give, from all of them down to one
    up_to_hz, within : the range [Hz] and the relative error allowed in it
    exact, lumped : receptances of both models at the same frequencies, beyond the highest natural one
    frequencies : for each oscillatory mode of `full` |λ|/2π there and in `model` [Hz], None where it has none
    """

    full: Model
    model: Model
    rigid: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    sums: Mapping[str, str]
    values: Mapping[str, float]
    steps: tuple[Step, ...]
    up_to_hz: float
    within: float
    exact: Receptance
    lumped: Receptance
    frequencies: tuple[tuple[float, float | None], ...]

    @property
    def dof(self) -> int:
        """Degrees of freedom of the lumped model: its inertias."""
        return len(self.groups)

    @property
    def error(self) -> float:
        """Largest relative error of the lumped model's receptances up to `up_to_hz`."""
        return _largest(self.exact.hz, self.exact.error(self.lumped), self.up_to_hz)

    @property
    def limit_hz(self) -> float:
        """Frequency up to which the lumped model stays within the allowed error [Hz]; infinite for the full one."""
        return _limit(self.exact.hz, self.exact.error(self.lumped), self.within)

    def parameters(self, original: Parameters | None = None) -> Parameters:
        """Return a set for the lumped model whose new parameters are tied to the original ones.

        original : a set of the full model, which is copied (default: its own, at `values`). Free parameters that
        the lumped model does not feel are fixed. To fit the sums themselves take `model.parameters()` instead.
        """
        made = _at(self.full, self.values) if original is None else original.copy()
        declared = {one.name: one for one in self.model.declarations}
        for name, text in self.sums.items():
            made.add(name, declared[name].value, unit=declared[name].unit, description=text)
            made.tie(name, text)
        felt = made.references(declared) | set(declared)
        for name in made:
            if name not in felt and made[name].tie is None:
                made.fix(name)
        return made

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, text and lists, ready for JSON."""
        values = zip(self.model.parameter_names, self.model.parameter_vector().tolist(), strict=True)
        return {
            "dof": self.dof,
            "rigid": list(self.rigid),
            "groups": [list(one) for one in self.groups],
            "parameters": {name: {"value": value, "sum": self.sums.get(name)} for name, value in values},
            "frequencies_hz": [list(row) for row in self.frequencies],
            "up_to_hz": self.up_to_hz,
            "within": self.within,
            "error": self.error,
            "limit_hz": _finite(self.limit_hz),
            "steps": [
                vars(s) | {"rigid": list(s.rigid), "groups": list(s.groups), "limit_hz": _finite(s.limit_hz)}
                for s in self.steps
            ],
        }

    def __str__(self) -> str:
        lines = [
            f"{self.full.name}: {len(self.steps)} degrees of freedom lumped to {self.dof}",
            f"receptances {', '.join(self.exact.outputs)} / {', '.join(self.exact.torques)}: largest error "
            f"{100 * self.error:.3g} % up to {self.up_to_hz:.4g} Hz, within {100 * self.within:g} % up to "
            f"{_hz(self.limit_hz)}",
            *(f"{name} = {text}" for name, text in self.sums.items()),
        ]
        of_modes = [("mode", "full [Hz]", "lumped [Hz]")]
        of_modes += [
            (str(k), f"{one:.4g}", "-" if other is None else f"{other:.4g}")
            for k, (one, other) in enumerate(self.frequencies, start=1)
        ]
        of_steps = [("dof", "error", f"within {100 * self.within:g} % to", "inertias")]
        of_steps += [
            (str(s.dof), f"{100 * s.error:.3g} %", _hz(s.limit_hz), ", ".join(s.groups)) for s in self.steps
        ]
        return "\n".join([*lines, "", *_table(of_modes), "", *_table(of_steps)])


def reduce(
    model: Model,
    *,
    up_to_hz: float | None = None,
    dof: int | None = None,
    rigid: Sequence[str] | None = None,
    within: float = 0.1,
    parameters: Parameters | Mapping[str, float] | None = None,
) -> Reduction:
    """Find how many degrees of freedom a range of frequencies needs, and lump the model rigidly to that many.

    model : a chain or tree of inertias (`crankshaft`, `two_mass`, `declare_chain`)
    up_to_hz : upper end of the range [Hz]; alone, the fewest degrees of freedom that are `within` the error are
        taken. Default with dof or rigid: half of the lowest natural frequency that the lumped model lacks
    dof : how many there shall be      rigid : ports of the couplings that shall not twist; one of the two at most
    within : largest ‖H_lumped − H‖/‖H‖ allowed in the range, 0.1 for 10 %. H holds the receptances from every
        torque to every output, so the sensor's place counts. Counting the resonances in the range
        (`Modes.needed`) is not enough: a mode left out yields long before its resonance, by its static
        compliance times 1/(1 − (f/f_n)²), all of which a rigid coupling leaves out
    parameters : as in `Model.parameter_vector`: errors are at these values, and sums have their defaults of them

    Couplings become rigid one after the other, each time the one that keeps the error `within` up to the highest
    frequency; that a later choice might make an earlier one worse is not searched.
    ModelError if the model is no chain or the options do not fit together.

    >>> from casadi_engine.model import crankshaft
    >>> found = reduce(crankshaft(), up_to_hz=60)
    >>> found.dof, found.sums["J1to6"], round(1 / float(found.model.parameter_vector()[0]), 4)
    (2, 'J1 + J2 + J3 + J4 + J5 + J6', 2.6534)
    """
    bones = skeleton_of(model)
    held = _checked(bones, up_to_hz, dof, rigid, within)
    values = dict(zip(model.parameter_names, model.parameter_vector(parameters).tolist(), strict=True))
    modes = model.modes(values)
    natural = [modes.frequency(k) for k in range(1, modes.oscillatory + 1)]
    left = dof or len(bones.inertias) - len(held or ())
    top = float(up_to_hz) if up_to_hz is not None else _usual_range(natural, left)
    exact = receptance(model, _frequencies(natural, top), values)
    steps = _descend(model, bones, values, exact, top, within)
    if held is None:
        held = [one for one in steps if (one.error <= within if dof is None else one.dof == dof)][-1].rigid
    return _lumped(model, bones, held, values, steps, natural, exact, top, within)


def _lumped(
    model: Model,
    bones: Skeleton,
    rigid: tuple[str, ...],
    values: Mapping[str, float],
    steps: tuple[Step, ...],
    natural: Sequence[float],
    exact: Receptance,
    top: float,
    within: float,
) -> Reduction:
    """Build the lumped model and compare it."""
    groups = _grouped(bones, rigid)
    made = lump(model, bones, groups, values)
    modes = made.model.modes()
    found: list[float | None] = [modes.frequency(k) for k in range(1, modes.oscillatory + 1)]
    found += [None] * (len(natural) - len(found))
    return Reduction(
        full=model,
        model=made.model,
        rigid=rigid,
        groups=tuple(tuple(bones.inertias[i] for i in one) for one in groups.members),
        sums={name: str(total) for name, total in made.sums.items()},
        values=values,
        steps=steps,
        up_to_hz=top,
        within=within,
        exact=exact,
        lumped=receptance(made.model, exact.hz, torques=exact.torques),
        frequencies=tuple(zip(natural, found, strict=True)),
    )


# ---- the search


def _descend(
    model: Model,
    bones: Skeleton,
    values: Mapping[str, float],
    exact: Receptance,
    top: float,
    within: float,
) -> tuple[Step, ...]:
    """From the full model down to one inertia, each time with the coupling rigid that keeps the widest range."""
    projected = _Projected(model, bones, values, exact)
    steps = [Step(len(bones.inertias), (), _grouped(bones, ()).labels, 0.0, math.inf)]
    while steps[-1].dof > 1:
        held, trials = set(steps[-1].rigid), []
        for one in bones.couplings:
            if one not in held:
                rigid = tuple(name for name in bones.couplings if name in held or name == one)
                groups = _grouped(bones, rigid)
                errors = projected.errors(groups)
                error, limit = _largest(exact.hz, errors, top), _limit(exact.hz, errors, within)
                trials.append(Step(len(groups.members), rigid, groups.labels, error, limit))
        steps.append(max(trials, key=lambda trial: (trial.limit_hz, -trial.error)))
    return tuple(steps)


class _Projected:
    """Errors of lumpings by projection of the matrices alone, without building the models."""

    def __init__(self, model: Model, bones: Skeleton, values: Mapping[str, float], exact: Receptance):
        core = model.linear
        assert core is not None  # skeleton_of has refused models without one
        parts = ca.Function("core", [model.p], [ca.densify(m) for m in (core.A, core.B, core.G, core.C)])
        self.a, b, g, self.c = (np.array(part.full()) for part in parts(model.parameter_vector(values)))
        slots = [port.name for port in model.ports.with_slot]
        columns = dict(zip(slots, g.T, strict=True))
        columns |= dict(zip((variable.name for variable in model.drives), b.T, strict=True))
        self.b = np.transpose([columns[name] for name in exact.torques])
        self.inertia = np.array([one.value(values) for one in bones.inertia])
        self.bones, self.exact = bones, exact
        self.through = exact.values - response(self.a, self.b, self.c, exact.hz)

    def errors(self, groups: Groups) -> Array:
        """(N,) relative errors of the receptances when the groups are rigid: x = T q, q̇ = W (A T q + B u)."""
        bones, size = self.bones, len(self.a)
        spread, gather = np.eye(size), np.eye(size)
        gone = {bones.twists[k] for k in range(len(bones.couplings)) if k not in groups.kept}
        for one in groups.members:
            first, *others = (bones.speeds[i] for i in one)
            rows, weights = [bones.speeds[i] for i in one], self.inertia[list(one)]
            spread[rows, first] = 1.0
            gather[first, rows] = weights / weights.sum()
            gone |= set(others)
        left = [row for row in range(size) if row not in gone]
        t, w = spread[:, left], gather[left]
        found = response(w @ self.a @ t, w @ self.b, self.c @ t, self.exact.hz) + self.through
        return self.exact.error(replace(self.exact, values=found))


def _grouped(bones: Skeleton, rigid: Sequence[str]) -> Groups:
    return group(bones, [bones.couplings.index(name) for name in rigid])


def _frequencies(natural: Sequence[float], top: float) -> Array:
    """(N,) Hz, even on a logarithmic scale, with the natural frequencies and the end of the range among them."""
    marks = [*natural, top]
    low, high = LOWEST * min(marks), HIGHEST * max(marks)
    even = np.geomspace(low, high, math.ceil(PER_DECADE * math.log10(high / low)))
    return np.unique(np.concatenate([even, marks]))


def _usual_range(natural: Sequence[float], dof: int) -> float:
    """Half of the lowest natural frequency that a model of `dof` inertias lacks, or of the highest one [Hz]."""
    lacking = list(natural[dof - 1 : dof]) or list(natural[-1:])
    return 0.5 * lacking[0] if lacking else RANGE


def _largest(hz: Array, errors: Array, top: float) -> float:
    return float(errors[hz <= top].max())


def _limit(hz: Array, errors: Array, within: float) -> float:
    """The last frequency before the first error that is too large; infinite if there is none."""
    wrong = np.flatnonzero(errors > within)
    return math.inf if not wrong.size else float(hz[max(wrong[0] - 1, 0)])


# ---- options and printing


def _checked(
    bones: Skeleton, up_to_hz: Any, dof: Any, rigid: Sequence[str] | None, within: Any
) -> tuple[str, ...] | None:
    """The couplings to hold rigid in the chain's order, None if they are to be found."""
    if up_to_hz is not None and not _positive(up_to_hz, math.inf):
        raise ModelError(
            "the option up_to_hz is not acceptable",
            seen=repr(up_to_hz),
            allowed="a frequency > 0, in Hz",
            cure="give up_to_hz=100, for instance",
        )
    if not _positive(within, 1.0):
        raise ModelError(
            "the option within is not acceptable",
            seen=repr(within),
            allowed="a share between 0 and 1",
            cure="give within=0.1 for 10 %",
        )
    if (dof is not None and rigid is not None) or (up_to_hz is None and dof is None and rigid is None):
        raise ModelError(
            "it is not clear how far to reduce the model",
            seen=f"up_to_hz={up_to_hz!r}, dof={dof!r}, rigid={rigid!r}",
            allowed="up_to_hz alone, or one of dof and rigid, with or without up_to_hz",
            cure="give up_to_hz=100 to have the number of degrees of freedom found",
        )
    count = len(bones.inertias)
    if dof is not None and not (isinstance(dof, Integral) and _positive(dof, count + 1)):
        raise ModelError(
            "the number of degrees of freedom is not acceptable",
            seen=repr(dof),
            allowed=f"a whole number from 1 to {count}",
            cure="give dof=2, for instance" if count > 1 else "there is nothing to lump",
        )
    if isinstance(rigid, str) or not isinstance(rigid, Iterable | None):
        raise ModelError(
            "the rigid couplings are not a sequence of names",
            seen=repr(rigid),
            allowed=near_matches(str(rigid), bones.couplings),
            cure=f'give rigid=("{bones.couplings[0]}",), for instance' if bones.couplings else "leave it out",
        )
    for name in rigid or ():
        if name not in bones.couplings:
            raise ModelError(
                "there is no such coupling",
                seen=repr(name),
                allowed=near_matches(name, bones.couplings),
                cure="name ports of the kind coupling; print(model.ports) lists them",
            )
    return None if rigid is None else tuple(name for name in bones.couplings if name in rigid)


def _positive(value: Any, most: float) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and 0.0 < float(value) < most


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _hz(value: float) -> str:
    return f"{value:.3g} Hz" if math.isfinite(value) else "any frequency"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]


def _at(model: Model, values: Mapping[str, float]) -> Parameters:
    """The model's own parameters at these values."""
    made = model.parameters()
    for name, value in values.items():
        made[name].set(value, min=min(made[name].min, value), max=max(made[name].max, value))
    return made
