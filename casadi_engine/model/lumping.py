"""Rigid lumping: the model in which chosen couplings of a torsional chain do not twist."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casadi_engine.errors import ModelError
from casadi_engine.model.blueprint import Blueprint
from casadi_engine.model.chain import Chain, Coupling, Inertia, declare_chain, write_chain
from casadi_engine.model.declarations import ParameterDeclaration
from casadi_engine.model.model import Model
from casadi_engine.model.skeleton import Skeleton, Sum, sums_of


@dataclass(frozen=True)
class Groups:
    """Which inertias move as one.

    members : for each group the indices of its inertias, rising; groups by their first member
    kept : indices of the couplings between groups, that of group k at k − 1
    labels : a name for each group: "1to6" of inertia_1 … inertia_6, "7", or "engine_load"
    """

    members: tuple[tuple[int, ...], ...]
    kept: tuple[int, ...]
    labels: tuple[str, ...]

    def of(self, inertia: int) -> int:
        """The group of an inertia."""
        return next(k for k, members in enumerate(self.members) if inertia in members)


def group(skeleton: Skeleton, rigid: Sequence[int]) -> Groups:
    """Groups of inertias joined by the couplings `rigid` (indices)."""
    leader = list(range(len(skeleton.inertias)))
    for coupling, (near, far) in enumerate(zip(skeleton.near, skeleton.far, strict=True)):
        if coupling in rigid:  # couplings are listed outwards, so that the near side has its leader already
            leader[far] = leader[near]
    members = tuple(tuple(i for i, first in enumerate(leader) if first == one) for one in sorted(set(leader)))
    by_far = {far: coupling for coupling, far in enumerate(skeleton.far)}
    kept = tuple(by_far[one[0]] for one in members[1:])
    labels = tuple(_label([skeleton.inertias[i] for i in one]) for one in members)
    return Groups(members, kept, labels)


def _label(names: Sequence[str]) -> str:
    ends = [name.rpartition("_")[2] for name in names]
    if len({name.rpartition("_")[0] for name in names}) == 1 and all(end.isdecimal() for end in ends):
        numbers = [int(end) for end in ends]
        if len(numbers) > 2 and numbers == list(range(numbers[0], numbers[-1] + 1)):
            return f"{numbers[0]}to{numbers[-1]}"
        return "and".join(ends)
    return "_".join(names)


@dataclass(frozen=True, eq=False)
class Lumped:
    """A lumped model: `sums` are its new parameters by the original ones."""

    model: Model
    sums: Mapping[str, Sum]


def lump(model: Model, skeleton: Skeleton, groups: Groups, values: Mapping[str, float]) -> Lumped:
    """Build the model of the groups by the chain builder: J and absolute dampers add up, inner couplings vanish.

    Channels, drives, cylinders and their laws stay, with the speed and angle of their group.
    values : of the original parameters, from which the new ones have their defaults
    ModelError if a law needs what is lumped away (the variable reciprocating inertia does).
    """
    return _Builder(model, skeleton, groups, values).build()


class _Builder:
    """One lumping: expressions are made in the original's symbols, then put into those of a blueprint."""

    def __init__(self, model: Model, skeleton: Skeleton, groups: Groups, values: Mapping[str, float]):
        self.full, self.bones, self.groups, self.values = model, skeleton, groups, values
        size = len(groups.members)
        words = f"{model.description}, lumped to {size} inerti{'as' if size > 1 else 'a'}"
        self.b = Blueprint(f"{model.name}_{size}dof", description=words)
        self.inner = [k for k in range(len(skeleton.couplings)) if k not in groups.kept]
        chain_ports = {*skeleton.inertias, *skeleton.couplings}
        made_by_model = {"input", "sensor", "parameter"}
        self.others = [p for p in model.ports if p.name not in chain_ports and p.kind not in made_by_model]
        self.laws = dict(zip((p.name for p in model.ports.with_slot), ca.vertsplit(model.laws), strict=True))
        chain_states = {*skeleton.speeds, *skeleton.twists}
        self.more_states = [i for i in range(len(model.states)) if i not in chain_states]
        self.rigid = self._rigid()
        self.inertia = [sum((skeleton.inertia[i] for i in one), Sum({})) for one in groups.members]
        self.absolute = [sum((skeleton.absolute[i] for i in one), Sum({})) for one in groups.members]
        self.sums: dict[str, Sum] = {}
        self.symbols: dict[str, Any] = {}
        self.old: list[Any] = []
        self.new: list[Any] = []

    def build(self) -> Lumped:
        full, b = self.full, self.b
        laws, outer = self._checked_laws(), self._outer()
        self._parameters([*laws.values(), *outer])
        for row, variable in enumerate(full.inputs):
            self._pair(full.channels[row], b.input(**vars(variable)))
        self._pair(full.t, b.time)
        chain = self._chain()
        for k, variable in enumerate(full.drives):
            value = self._lumped(full.drive_expressions[k])
            self._pair(full.d[k], b.drive(expression=value, **vars(variable)))
        for port in self.others:
            signals = {key: self._lumped(value) for key, value in port.signals.items()}
            self._pair(
                port.slot, b.port(port.name, port.kind, signals, unit=port.unit, description=port.description)
            )
        write_chain(b, chain, [self._lumped(torque) for torque in outer])
        for row in self.more_states:
            b.ode(full.states[row].name, self._lumped(full.ode[row]))
        for name, law in laws.items():
            b.law(name, _cancelled(self._lumped(law)))
        for row, variable in enumerate(full.outputs):
            b.output(expression=self._lumped(full.output_expressions[row]), **vars(variable))
        return Lumped(b.model(), self.sums)

    # ---- from the original's symbols to the blueprint's

    def _rigid(self) -> tuple[Any, Any]:
        """What moves with what: members with the first of their group; inner couplings neither twist nor act."""
        x, bones = self.full.x, self.bones
        followers = [x[bones.speeds[i]] for one in self.groups.members for i in one[1:]]
        leaders = [x[bones.speeds[one[0]]] for one in self.groups.members for _ in one[1:]]
        still = [x[bones.twists[k]] for k in self.inner]
        still += [self.full.ports[bones.couplings[k]].slot for k in self.inner]
        return _column(followers + still), _column(leaders + [ca.SX(0) for _ in still])

    def _held(self, expression: Any) -> Any:
        return ca.substitute(expression, *self.rigid)

    def _lumped(self, expression: Any) -> Any:
        return ca.substitute(self._held(expression), _column(self.old), _column(self.new))

    def _pair(self, old: Any, new: Any) -> None:
        if old is not None and new is not None:
            self.old.append(old)
            self.new.append(new)

    # ---- parts

    def _checked_laws(self) -> dict[str, Any]:
        """Port -> law, where one acts; the laws on the members of a group are added up."""
        slots = [
            self.full.ports[self.bones.inertias[i]].slot
            for one in self.groups.members
            if len(one) > 1
            for i in one
        ]
        made: dict[str, Any] = {}
        for name, law in self.laws.items():
            held = self._held(law)
            if name in {self.bones.couplings[k] for k in self.inner} or held.is_zero():
                continue
            if slots and ca.depends_on(held, _column(slots)):
                raise self._cannot(name, "the torque on one inertia of a rigid group")
            target = self._new_port(name)
            made[target] = made.get(target, ca.SX(0)) + held
        return made

    def _new_port(self, name: str) -> str:
        if name not in self.bones.inertias:
            return name
        return self._body_name(self.groups.of(self.bones.inertias.index(name)))

    def _body_name(self, k: int) -> str:
        """The port of a group: its only member's, or inertia_1to6."""
        members = [self.bones.inertias[i] for i in self.groups.members[k]]
        stem = members[0].rpartition("_")[0]
        label = self.groups.labels[k]
        return (
            members[0] if len(members) == 1 else f"{stem}_{label}" if stem and label[0].isdecimal() else label
        )

    def _outer(self) -> list[Any]:
        """For each group the torque from outside the chain, Σ J_i (ω̇_i without inertias' slots and couplings)."""
        full, core = self.full, self.full.linear
        assert core is not None  # skeleton_of has refused models without one
        slots = {port.name: k for k, port in enumerate(full.ports.with_slot)}
        sources = [(full.d[k], core.B[:, k]) for k in range(full.d.numel())]
        sources += [(port.slot, core.G[:, slots[port.name]]) for port in self.others if port.slot is not None]
        sources += [(full.x[i], core.A[:, i]) for i in self.more_states] + [(ca.SX(1), core.e)]
        made = []
        for one in self.groups.members:
            torque = ca.SX(0)
            for symbol, column in sources:
                share = sum(
                    (
                        column[self.bones.speeds[i]]
                        / core.G[self.bones.speeds[i], slots[self.bones.inertias[i]]]
                        for i in one
                    ),
                    ca.SX(0),
                )
                if not ca.SX(share).is_zero():
                    torque += self._tidy(share) * symbol
            made.append(torque)
        return made

    def _tidy(self, share: Any) -> Any:
        """An expression of parameters as the sum that it is, so that J·(1/J) leaves no trace of J."""
        (found,) = sums_of(self.full, [share])
        if found is None:
            return share
        table = dict(zip(self.full.parameter_names, ca.vertsplit(self.full.p), strict=True))
        return sum((factor * table[name] for name, factor in found.terms.items()), ca.SX(found.constant))

    def _parameters(self, expressions: Sequence[Any]) -> None:
        """Declare the parameters that are left, and one for each sum of several, where its first term stood."""
        full = self.full
        kept = [self.bones.stiffness[k] for k in self.groups.kept] + [
            self.bones.damping[k] for k in self.groups.kept
        ]
        for letter, totals in (("J", self.inertia), ("C", self.absolute)):
            for label, total in zip(self.groups.labels, totals, strict=True):
                if total.terms and total.single is None and total not in self.sums.values():
                    name = f"{letter}{label}" if label[0].isdecimal() else f"{letter}_{label}"
                    self.sums[self._free_name(name)] = total
        needed = {total.single for total in (*self.inertia, *self.absolute)} | {
            n for s in kept for n in s.terms
        }
        gone = {name for total in self.sums.values() for name in total.terms} - needed
        rest = [*full.drive_expressions.elements(), *full.output_expressions.elements()]
        rest += [full.ode[row] for row in self.more_states]
        rest += [value for port in self.others for value in port.signals.values()]
        used = {s.name() for s in ca.symvar(self._held(_column([*expressions, *rest])))}
        for one, symbol in zip(full.declarations, ca.vertsplit(full.p), strict=True):
            for name, total in self.sums.items():
                if next(iter(total.terms)) == one.name:
                    self.symbols[name] = self.b.parameter(**vars(self._declaration(name, total)))
            if one.name in used and one.name in gone:
                raise self._cannot(one.name, f"{one.name} by itself")
            if one.name in used or one.name in needed:
                self.symbols[one.name] = self.b.parameter(**(vars(one) | self._with_room(one)))
                self._pair(symbol, self.symbols[one.name])

    def _free_name(self, name: str) -> str:
        taken = {
            *self.full.parameter_names,
            *self.sums,
            *(v.name for v in (*self.full.states, *self.full.inputs)),
        }
        while name in taken:
            name += "_"
        return name

    def _with_room(self, one: ParameterDeclaration) -> dict[str, float]:
        value = self.values[one.name]
        return {"value": value, "min": min(one.min, value), "max": max(one.max, value)}

    def _declaration(self, name: str, total: Sum) -> ParameterDeclaration:
        """The declaration of a sum: bounds and default are the sums of its terms'."""
        parts = {one.name: one for one in self.full.declarations if one.name in total.terms}
        ends = [sorted((f * parts[key].min, f * parts[key].max)) for key, f in total.terms.items()]
        low, high = (total.constant + sum(end[k] for end in ends) for k in (0, 1))
        value, one = total.value(self.values), next(iter(parts.values()))
        vary = any(part.vary for part in parts.values())
        return ParameterDeclaration(
            name, value, one.unit, min(low, value), max(high, value), vary, str(total)
        )

    def _symbol(self, total: Sum) -> Any:
        """A sum in the blueprint's symbols: a parameter of its own, or its terms."""
        for name, known in self.sums.items():
            if known == total:
                return self.symbols[name]
        terms = (factor * self.symbols[name] for name, factor in total.terms.items())
        return sum(terms, ca.SX(total.constant))

    def _chain(self) -> Chain:
        """Declare the states in their old order, those outside the chain where they stood: before or after it."""
        first = self.bones.speeds[0]
        for row in (i for i in self.more_states if i < first):
            self._pair(self.full.x[row], self.b.state(**vars(self.full.states[row])))
        bodies, joints = (
            [self._body(k) for k in range(len(self.groups.members))],
            [self._joint(k) for k in self.groups.kept],
        )
        angle = self.full.ports[self.bones.inertias[0]].signals.get("angle")
        chain = declare_chain(self.b, bodies, joints, angle=None if angle is None else self._lumped(angle))
        for k, members in enumerate(self.groups.members):
            self._pair(self.full.x[self.bones.speeds[members[0]]], chain.speeds[k])
            if len(members) == 1:
                self._pair(self.full.ports[self.bones.inertias[members[0]]].slot, chain.slots[k])
        for k, twist, slot in zip(self.groups.kept, chain.twists, chain.slots[len(bodies) :], strict=True):
            self._pair(self.full.x[self.bones.twists[k]], twist)
            self._pair(self.full.ports[self.bones.couplings[k]].slot, slot)
        for row in (i for i in self.more_states if i > first):
            self._pair(self.full.x[row], self.b.state(**vars(self.full.states[row])))
        return chain

    def _body(self, k: int) -> Inertia:
        members = self.groups.members[k]
        state, port = (
            self.full.states[self.bones.speeds[members[0]]],
            self.full.ports[self.bones.inertias[members[0]]],
        )
        damper = (
            self._symbol(self.absolute[k]) if self.absolute[k].terms or self.absolute[k].constant else None
        )
        if len(members) == 1:
            return Inertia(
                port.name, state.name, self._symbol(self.inertia[k]), damper, None, state.description
            )
        words = f"speed of {', '.join(self.bones.inertias[i] for i in members)} as one"
        speed = f"{state.name.rpartition('_')[0]}_{self.groups.labels[k]}"
        return Inertia(self._body_name(k), speed, self._symbol(self.inertia[k]), damper, None, words)

    def _joint(self, k: int) -> Coupling:
        port, state = self.full.ports[self.bones.couplings[k]], self.full.states[self.bones.twists[k]]
        stiffness, damping = self._symbol(self.bones.stiffness[k]), self._symbol(self.bones.damping[k])
        return Coupling(
            port.name, state.name, stiffness, damping, port.description, self.groups.of(self.bones.near[k])
        )

    def _cannot(self, name: str, what: str) -> ModelError:
        return ModelError(
            f"the model {self.full.name} cannot be lumped, because a law needs what the lumping takes away",
            seen=f"{name}: it needs {what}",
            allowed="laws of speeds, angles, twists that stay, channels and geometry",
            cure='build it with reciprocating_inertia="mean", or keep that inertia apart (rigid=...)',
        )


def _cancelled(expression: Any) -> Any:
    """The expression with equal parts made one and written anew, so that what cancels does."""
    symbols = ca.symvar(expression)
    shared = ca.cse(expression)
    return ca.Function("law", symbols, [shared])(*symbols) if symbols else expression


def _column(items: Sequence[Any]) -> Any:
    return ca.vertcat(*items) if len(items) else ca.SX(0, 1)
