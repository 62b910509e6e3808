"""result.json of ``Posterior.save``, by the contract: the fit that it started from, and its draws."""

from __future__ import annotations

from typing import Any

from casadi_engine.posterior.result import Posterior
from casadi_engine.report.result_file import content


@content.register
def _(result: Posterior) -> dict[str, Any]:
    return content(result.fit) | {"posterior": result.to_dict(), "summary": str(result)}
