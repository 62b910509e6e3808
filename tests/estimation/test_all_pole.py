"""The recursion of an autoregression, against SciPy's filter."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.estimation import all_pole as module
from casadi_engine.estimation.all_pole import all_pole


@pytest.mark.parametrize(("samples", "order"), [(1, 0), (1, 3), (5, 8), (400, 1), (400, 30)])
def test_of_the_library(samples: int, order: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(order)
    predictor = np.r_[1.0, rng.uniform(-0.9, 0.9, order) / max(order, 1)]
    x = rng.normal(size=(samples, 3))
    wanted = lfilter([0.3], predictor, x, axis=0)
    np.testing.assert_allclose(all_pole(predictor, x, 0.3), wanted, rtol=1e-12, atol=1e-13)
    monkeypatch.setattr(module, "_BAND", 0)
    np.testing.assert_array_equal(all_pole(predictor, x, 0.3), wanted)


def test_loads_no_large_library() -> None:
    code = (
        "import sys, casadi_engine.estimation.all_pole as a; a.all_pole([1, -0.5], a.np.eye(9)); "
        "print('scipy.signal' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]
