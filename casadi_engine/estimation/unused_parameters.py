"""unused_parameters: free parameters that nothing asks for stay where they are."""

from __future__ import annotations

from collections.abc import Collection

import casadi as ca

from casadi_engine.model import Model
from casadi_engine.parameters import Parameters


def held_if_unused(model: Model, parameters: Parameters) -> tuple[str, ...]:
    """Fix, in the set that is given, what stands in no equation of the model; say of which that is so.

    A search would move it, as far as its bounds go, though no sample asks for that. What has a prior, a constraint or
    another one tied to it is asked for there.
    """
    free = {name for name, one in parameters.items() if one.vary and one.tie is None and one.prior is None}
    acting = ca.symvar(ca.vertcat(model.closed_ode, model.closed_outputs, *_signals(model)))
    seen = {symbol.element_hash() for symbol in acting}
    used = {name for k, name in enumerate(model.parameter_names) if model.p[k].element_hash() in seen}
    used |= parameters.references(name for name in parameters if name in used)
    used.update(*(one.names for one in parameters.constraints))
    unused = sorted(free - used, key=list(parameters).index)
    if not unused or len(unused) == len(free):
        return ()
    for name in unused:
        parameters.fix(name)
    return tuple(
        f"{name} stands in no equation of {model.name} and was kept at {parameters[name].value:.6g}: nothing asks for "
        "another value; if it should act, its name in an equation may be misspelt"
        for name in unused
    )


def not_asked(parameters: Parameters, records: Collection[str]) -> tuple[str, ...]:
    """What is said of a set and nothing in the fit asks for: priors of parameters that are fixed, and values for
    records that are not among the data."""
    found = [
        f"{name} is fixed at {one.value:.6g}: its prior, {one.prior[0]:.6g} ± {one.prior[1]:.2g}, is not used"
        for name, one in parameters.items()
        if one.prior is not None and not one.vary and one.tie is None
    ]
    for name, one in parameters.items():
        others = [record for record in one.own_records if record not in records]
        if one.varies_by_experiment and others:
            found.append(
                f"{name} has its own value for {', '.join(others)}, which is none of the records "
                f"({', '.join(records)}): look whether a name is misspelt"
            )
    return tuple(found)


def _signals(model: Model) -> list[ca.SX]:
    """What a law at a port may read; at a parameter it reads the parameter itself, which says nothing of a use."""
    return [signal for port in model.ports if port.kind != "parameter" for signal in port.signals.values()]
