"""The posterior of a fit's parameters: draws, intervals and evidence where a quadratic is not enough."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from .comparison import Comparison, compare
    from .posterior import posterior
    from .predictive import Predictive
    from .result import Mode, Posterior

__all__ = ["Comparison", "Mode", "Posterior", "Predictive", "compare", "posterior"]

import_at_first_use(
    __name__,
    {
        "casadi_engine.posterior.comparison": ("Comparison", "compare"),
        "casadi_engine.posterior.posterior": ("posterior",),
        "casadi_engine.posterior.predictive": ("Predictive",),
        "casadi_engine.posterior.result": ("Mode", "Posterior"),
    },
)
