"""Experiments: measured channels, each with its own time, their readers and their conditioning."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from .channel import Channel, Step
    from .experiment import Experiment, with_unique_names
    from .order_analysis import Orders, orders
    from .reader import read_experiment
    from .units import ALLOWED_UNITS, si_unit, split_header, to_si

__all__ = [
    "ALLOWED_UNITS",
    "Channel",
    "Experiment",
    "Orders",
    "Step",
    "orders",
    "read_experiment",
    "si_unit",
    "split_header",
    "to_si",
    "with_unique_names",
]

import_at_first_use(
    __name__,
    {
        "casadi_engine.experiment.channel": ("Channel", "Step"),
        "casadi_engine.experiment.experiment": ("Experiment", "with_unique_names"),
        "casadi_engine.experiment.order_analysis": ("Orders", "orders"),
        "casadi_engine.experiment.reader": ("read_experiment",),
        "casadi_engine.experiment.units": ("ALLOWED_UNITS", "si_unit", "split_header", "to_si"),
    },
)
