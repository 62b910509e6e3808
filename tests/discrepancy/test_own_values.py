"""Effects that are refitted from the parameters' own values, where no step along the model foretells what they do."""

from types import SimpleNamespace as stub

import numpy as np
import pytest

from casadi_engine.discrepancy import additions as module


@pytest.mark.parametrize(
    ("coloured", "left", "tried"),
    [
        (True, np.inf, ["drag", "gain", "load", "storage"]),
        (False, np.inf, ["drag"]),  # what is left is noise: as long as the others took
        (True, 6.0, ["drag"]),  # a quarter of what is left
    ],
)
def test_all_effects_have_their_turn_while_more_than_noise_is_left(monkeypatch, coloured, left, tried):
    """A wall behind a jacket was never refitted, as its turn came last, and "no effect of the library names it"."""
    ticks = iter(range(100))
    monkeypatch.setattr(
        module.time, "perf_counter", lambda: float(next(ticks))
    )  # a second each time it is asked
    monkeypatch.setattr(module, "costs_of", lambda screened, step, families: dict.fromkeys(families, 1.0))
    monkeypatch.setattr(module, "chosen_of", lambda screened, lead, own: stub(moves=False))
    monkeypatch.setattr(module, "time_left", lambda: left)
    keys = [(name, "port") for name in ("drag", "gain", "load", "storage")]
    candidates = [stub(key=key, source=stub(effect=stub(nuisance={}))) for key in keys]
    told: list[str] = []
    own = stub(
        refits=stub(weigh=lambda: None, levels=stub(foretold=9.0)),
        screened=stub(candidates=candidates, second_names={}),
        families={key: [k] for k, key in enumerate(keys)},
        done=list(keys),
        lead=None,
        start=None,
        tell=told.append,
        _tried=list,
        _own_step=lambda numbers: stub(error=np.ones(len(candidates))),
        _best=lambda: None,
        _led=lambda left, best: left,
        _try=lambda one, start, **how: None,
        _is_coloured=lambda: coloured,
    )
    module.Additions._from_own_values(own, begun=-2.0)
    assert [words.split(": ")[1].split(" at")[0] for words in told] == tried
