"""Independent reference simulator: it made the records and shares nothing with the package."""

from .engine import Engine, burn_factors
from .hidden import Hidden, hidden
from .hidden_runs import Case, simulate_hidden
from .pressure import Cylinders, identical_cylinders, unequal_cylinders
from .shaft import Shaft, crankshaft_shaft, two_mass_shaft
from .simulate import add_noise, simulate_crankshaft, simulate_shaft, simulate_two_mass

__all__ = [
    "Case",
    "Cylinders",
    "Engine",
    "Hidden",
    "Shaft",
    "add_noise",
    "burn_factors",
    "crankshaft_shaft",
    "hidden",
    "identical_cylinders",
    "simulate_crankshaft",
    "simulate_hidden",
    "simulate_shaft",
    "simulate_two_mass",
    "two_mass_shaft",
    "unequal_cylinders",
]
