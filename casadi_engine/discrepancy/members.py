"""The class of an effect that was added: all effects that the data do not exclude beside it."""

from __future__ import annotations

from collections.abc import Mapping

from casadi_engine.discrepancy.classes import confusable
from casadi_engine.discrepancy.proposals import freed
from casadi_engine.discrepancy.repaired import Member
from casadi_engine.discrepancy.screening import Screened

# A member leaves the class when the lead beats it by so much, squared: see ``classes``.
KEEP = 2.326**2


def members_of(screened: Screened, lead: int, gains: Mapping[int, float]) -> tuple[Member, ...]:
    """The class of the lead: all effects that the data do not exclude beside it.

    gains : candidate -> drop of chi-squared of its refit. Candidates without a refit are taken to gain in the share in
    which the lead's refit differs from its prediction.
    """
    scores, drop = screened.scores, screened.scores.drop
    ratio = gains[lead] / drop[lead] if drop[lead] > 0 else 1.0
    # what no refit has shown, or whose refit failed, does not put the lead out of its own class
    gain = {k: min(float(ratio * drop[k]), gains[lead]) for k in range(len(drop))}
    for tried, value in gains.items():
        # an estimated nuisance fits some noise: one unit of chi-squared each
        own = value - freed(screened, tried)
        for k, candidate in enumerate(screened.candidates):
            if candidate.key == screened.candidates[tried].key:
                gain[k] = own if k == tried else min(gain[k], own - 1e-9)
    gain[lead] = max(gain[lead], max(gain[k] for k in gains))
    found: list[Member] = []
    for member in confusable(scores, gain=gain):
        names = [k for k in member.names if k == lead or gain[lead] - gain[k] <= KEEP]
        for k in names:
            candidate = screened.candidates[k]
            rho = float(scores.correlation[lead, k])
            found.append(Member(candidate.effect, candidate.port, rho, member.probability / len(names)))
    key = screened.candidates[lead].key
    found.sort(key=lambda m: ((m.name, m.at) != key, -m.probability))
    total = sum(m.probability for m in found)
    return tuple(Member(m.name, m.at, m.rho, m.probability / total) for m in found)
