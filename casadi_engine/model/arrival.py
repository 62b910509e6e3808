"""Data arrive in the units that a model declares."""

from __future__ import annotations

from typing import TYPE_CHECKING

from casadi_engine.experiment.units import NOT_STATED

if TYPE_CHECKING:
    from casadi_engine.experiment import Experiment
    from casadi_engine.model.declarations import Variable
    from casadi_engine.model.model import Model


def arriving(model: Model, record: Experiment) -> Experiment:
    """The record with the model's channels in the units that it declares; the same object if they are already.

    A variable whose unit was not stated takes its data in SI. Channels that the model does not use stay as they are.
    Raises UnitError for a channel whose unit is of another dimension than the declared one.
    """
    units: dict[str, str] = {}
    for variable in (*model.inputs, *model.outputs):
        if variable.name in record and units.get(variable.name, NOT_STATED) == NOT_STATED:
            units[variable.name] = variable.unit
    return record.in_units(units)


def channel_unit(variable: Variable, record: Experiment) -> str:
    """The unit of a channel made for a variable: the declared one, else that of the record's channel, else 1."""
    if variable.unit != NOT_STATED:
        return variable.unit
    return record[variable.name].unit if variable.name in record else "1"
