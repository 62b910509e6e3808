"""Experiments: measured channels, each with its own time, their readers and their conditioning."""

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
