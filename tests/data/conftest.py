"""Make the simulator beside the records importable, and run once what several tests look at."""

import sys
from pathlib import Path
from typing import Any

import pytest

DATA = Path(__file__).resolve().parents[2] / "data"
if str(DATA) not in sys.path:
    sys.path.insert(0, str(DATA))


@pytest.fixture(scope="session")
def data_folder() -> Path:
    return DATA


@pytest.fixture(scope="session")
def clean_normal() -> dict[str, Any]:
    """Two noise-free cycles of the two-mass engine with unequal cylinders and scatter."""
    from simulator import simulate_two_mass

    return simulate_two_mass(1200.0, cycles=2, scatter_seed=3, sigma=0.0)


@pytest.fixture(scope="session")
def clean_misfire() -> dict[str, Any]:
    """The same with cylinder 2 dead."""
    from simulator import simulate_two_mass

    return simulate_two_mass(1200.0, cycles=2, scatter_seed=3, sigma=0.0, misfire={2: "all"})


@pytest.fixture(scope="session")
def clean_crankshaft() -> dict[str, Any]:
    """One noise-free cycle of the seven-inertia crankshaft at 1800 RPM."""
    from simulator import simulate_crankshaft

    return simulate_crankshaft(1800.0, cycles=1, scatter_seed=3, sigma=0.0)
