"""Evidence beside coloured noise: by samples that are worth fewer, and by innovations of a structure's own noise."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.discrepancy.evidence import Levels, innovations, levels_left
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.estimation.autoregression import autoregression

COUNT = 1000


def null_of(residual, slopes=None):
    """One record of one output and one parameter."""
    slopes = np.zeros((len(residual), 1)) if slopes is None else slopes[:, None]
    record = RecordNull(
        name="a",
        path=stub(grid=stub(measured={"y": stub(values=residual)})),
        residual={"y": residual},
        time={"y": np.arange(len(residual), dtype=float)},
        index={"y": np.arange(len(residual))},
        length={"y": len(residual)},
        cycle={"y": np.zeros(len(residual), dtype=int)},
        slopes={"y": slopes},
        starts=(),
    )
    return NullModel(None, ("p",), ("1",), np.ones(1), np.eye(1), np.zeros((0, 2)), (record,))


def test_white_residuals_count_by_their_level():
    e = np.random.default_rng(0).standard_normal(COUNT)
    found = innovations(null_of(e), Levels({"y": 1e-3}))
    assert found == pytest.approx(0.5 * COUNT * np.log(np.mean(e**2)), rel=1e-9)
    stated = innovations(null_of(e), Levels({"y": 3.0}))  # no smaller than what was stated
    normal = COUNT * np.log(3.0) + 0.5 * float(e @ e) / 9.0 - 0.5 * COUNT
    assert stated == pytest.approx(normal, rel=1e-9)


def test_colour_costs_what_its_numbers_cost():
    """Half the logarithm of the samples each, and only as many as pay for themselves; white noise has none."""
    random = np.random.default_rng(4)
    memory = Levels({"y": 1e-3}, {"y": 10.0})
    white = random.standard_normal(COUNT)
    assert innovations(null_of(white), memory) == innovations(null_of(white), Levels({"y": 1e-3}))
    slow = np.sin(np.arange(COUNT) / 40) + 0.7 * random.standard_normal(COUNT)
    variances = autoregression(slow[:, None], np.ones(COUNT, dtype=bool)).variances / COUNT
    whole = variances * float(slow @ slow) / variances[0]
    worth = [0.5 * COUNT * np.log(v / COUNT) + 0.5 * k * np.log(COUNT) for k, v in enumerate(whole)]
    assert np.argmin(worth) > 0
    assert innovations(null_of(slow), memory) == pytest.approx(min(worth), rel=1e-9)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_coloured_residuals_count_by_their_innovations(share):
    """An autoregression of standard deviation 1 has innovations of sqrt(1 - a^2)."""
    e = np.random.default_rng(1).standard_normal(20 * COUNT)
    e = lfilter([1.0], [1.0, -share], e)
    e /= np.std(e)
    found = innovations(null_of(e), Levels({"y": 1e-3}, {"y": 10.0}))
    own = float(e[1:] @ e[:-1]) / len(e)  # near the share, by chance
    assert own == pytest.approx(share, abs=0.02)
    assert found == pytest.approx(0.5 * len(e) * np.log(1 - own**2), rel=0.02)


def test_what_slopes_explain_is_no_colour():
    """A search that ended short of its optimum leaves what its parameters would take: it is no noise, and says nothing
    of how many samples are worth one."""
    noise = lfilter([1.0], [1.0, -0.5], np.random.default_rng(2).standard_normal(COUNT))
    drift = np.linspace(-1, 1, COUNT) ** 2
    there = levels_left(null_of(noise, drift), {}, 0.0, None)
    short = levels_left(null_of(noise + 1e4 * drift, drift), {}, 0.0, None)
    assert 2 < there.memory["y"] < 5  # 3 for the autoregression
    assert short.memory["y"] == pytest.approx(there.memory["y"], rel=1e-6)
    assert short.sigma["y"] == pytest.approx(there.sigma["y"], rel=1e-6)


def pool_of(**structures):
    """Structures by name -> (cost, log evidence by worth, log evidence in their own noise)."""
    pool = {}
    for name, (cost, log, own) in structures.items():
        effects = () if name == "none" else (stub(candidate=stub(key=(name, "p"))),)
        found = stub(log=log, cost=cost, error={})
        pool[frozenset(one.candidate.key for one in effects)] = Tried(
            effects, stub(cost=cost, values={}), None, found, lambda: pool, own
        )
    for one in pool.values():
        one.outdone = Refits._is_outdone(stub(pool=pool), one)
    return dict(zip(structures, pool.values(), strict=True))


def test_whichever_evidence_says_more_counts():
    found = pool_of(none=(900.0, -70.0, 100.0), slow=(300.0, -30.0, 110.0))
    assert found["none"].log == -70.0
    assert found["slow"].log == -30.0  # by how many independent samples say so
    found = pool_of(none=(900.0, -70.0, 100.0), fast=(700.0, -69.0, 180.0))
    assert found["fast"].log == -70.0 + 80.0  # by the innovations


def test_a_gap_that_foretells_itself_outdoes_nothing():
    """Dry friction of a slide, which leaves a tenth of the gap, was behind a spring that leaves nearly all of it: what
    the spring leaves is smooth. Beside the friction it counts for what its innovations say."""
    found = pool_of(none=(900.0, -70.0, 100.0), dry=(90.0, -40.0, 20.0), spring=(850.0, -70.5, 600.0))
    assert found["dry"].log == -40.0
    assert found["spring"].log == -70.5
    near = pool_of(none=(900.0, -70.0, 100.0), dry=(90.0, -68.0, 20.0), spring=(850.0, -70.5, 600.0))
    assert near["spring"].log == -70.0 + 500.0  # the samples do not tell it from the friction


def test_a_wrong_way_that_foretells_itself_is_no_better():
    """An optimum far off is smooth: its innovations are as small as those of the right one."""
    found = pool_of(none=(900.0, -70.0, 100.0), astray=(90000.0, -4000.0, 180.0))
    assert found["astray"].log == -4000.0


def test_in_white_noise_there_is_one_evidence():
    found = pool_of(none=(900.0, -70.0, None), dry=(300.0, -30.0, None))
    assert (found["none"].log, found["dry"].log) == (-70.0, -30.0)
