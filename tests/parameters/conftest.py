"""What all tests of the parameters room share."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from casadi_engine.errors import CasadiEngineError
from casadi_engine.parameters import Parameters

Refused = Callable[..., AbstractContextManager[pytest.ExceptionInfo[CasadiEngineError]]]


@pytest.fixture
def refused() -> Refused:
    """A context that wants exactly this class of error, with these texts in its four parts."""

    @contextmanager
    def context(
        kind: type[CasadiEngineError], problem: str, *, seen: str, allowed: str, cure: str
    ) -> Iterator[pytest.ExceptionInfo[CasadiEngineError]]:
        with pytest.raises(CasadiEngineError) as caught:
            yield caught
        error = caught.value
        assert type(error) is kind
        assert problem in error.problem
        assert seen in (error.seen if isinstance(error.seen, str) else repr(error.seen))
        assert allowed in (error.allowed or "")
        assert cure in (error.cure or "")
        assert problem in str(error)
        assert "do: " in str(error)

    return context


@pytest.fixture
def engine() -> Parameters:
    """The two-mass set: five of the model, three free, and an auxiliary one."""
    pars = Parameters()
    pars.add("J_eng", 0.39, unit="kg m2", min=0.05, max=4)
    pars.add("J_load", 0.5, unit="kg m2", min=0.05, max=4)
    pars.add("K_el", 1e4, unit="N m/rad", min=0)
    pars.add("C_el", 3.0, unit="N m s/rad", vary=False)
    pars.add("C2", 0.04, unit="N m s/rad", min=0, vary=False)
    pars.add("C_eng", 0.16, unit="N m s/rad", min=0)
    return pars
