"""The exact test of structural identifiability: can these outputs tell these parameters, in principle?"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.errors import IdentifiabilityError
from casadi_engine.identifiability.draw import Drawn, draw
from casadi_engine.identifiability.probability import error_probability
from casadi_engine.identifiability.question import Question, read_question
from casadi_engine.identifiability.remedies import Remedy, find_remedies
from casadi_engine.identifiability.run import gradients_at
from casadi_engine.identifiability.symmetry import Symmetry, symmetries
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters

_MOST_SEEDS = 20


@dataclass(frozen=True, eq=False)
class Identifiability:
    """The answer of the exact test, local and generic: for almost all values, up to isolated other solutions.

    rank, size : of the free parameters and initial states together; equal if all of them can be told
    identifiable : free parameter, or ``state(0)`` for a free initial state -> True if it can be told by itself
    directions : how many independent combinations of the parameters alone can be told
    symmetries : scalings and shifts that no output shows; there may be further directions that are neither
    combinations : text as asked -> True if that combination of parameters can be told
    order : of the output's derivative at which the last of the rank came. orders : up to which it was looked
    final : True if theory says that no higher derivative adds to the rank; if not, a negative means
        "not seen up to order `orders`" (a known start may hide a parameter for a while)
    error_probability : bound for a single one of the drawings, which all agreed
    seconds : CPU time of the test
    """

    model: Model
    parameters: Parameters
    rank: int
    size: int
    identifiable: Mapping[str, bool]
    directions: int
    symmetries: tuple[Symmetry, ...]
    combinations: Mapping[str, bool]
    order: int
    orders: int
    final: bool
    error_probability: float
    seeds: int
    seconds: float
    question: Question = field(repr=False)
    drawings: tuple[Drawn, ...] = field(repr=False)
    _found: dict[int, tuple[Remedy, ...]] = field(default_factory=dict, repr=False)

    @property
    def free(self) -> tuple[str, ...]:
        """The free parameters."""
        return self.question.free

    @property
    def lost(self) -> tuple[str, ...]:
        """The free parameters that cannot be told by themselves."""
        return tuple(name for name in self.free if not self.identifiable[name])

    @property
    def lost_states(self) -> tuple[str, ...]:
        """The free initial states that cannot be told."""
        return tuple(name for name in self.question.initial if not self.identifiable[name])

    @property
    def passed(self) -> bool:
        """True if every free parameter can be told."""
        return not self.lost

    @property
    def other_directions(self) -> int:
        """Invisible directions that are not among the symmetries."""
        return self.size - self.rank - len(self.symmetries)

    def remedies(self, *, most: int = 10) -> tuple[Remedy, ...]:
        """Changes that bring lost parameters back, the best first: single ones, or pairs where no single one does.

        A further sensor (a state), an excited or measured drive, a start from rest, a parameter fixed or tied.
        """
        if most not in self._found:
            self._found[most] = find_remedies(self.question, self.lost, most=most)
        return self._found[most]

    def to_dict(self) -> dict[str, Any]:
        """The answer as JSON-able data; `remedies` are searched for it."""
        return {
            "passed": self.passed,
            "rank": self.rank,
            "size": self.size,
            "identifiable": dict(self.identifiable),
            "lost": list(self.lost),
            "directions": self.directions,
            "symmetries": [
                {
                    "kind": one.kind,
                    "text": str(one),
                    "exponents": {name: float(power) for name, power in one.exponents},
                }
                for one in self.symmetries
            ],
            "other_directions": self.other_directions,
            "combinations": dict(self.combinations),
            "order": self.order,
            "orders": self.orders,
            "final": self.final,
            "error_probability": self.error_probability,
            "seeds": self.seeds,
            "settings": [
                {
                    "name": one.name,
                    "inputs": {name: str(word) for name, word in one.inputs.items()},
                    "start": {name: str(word) for name, word in one.start.items()},
                    "outputs": list(one.outputs),
                }
                for one in self.question.settings
            ],
            "remedies": [
                {
                    "text": str(one),
                    "changes": [
                        {"kind": c.kind, "name": c.what, "sentence": c.sentence} for c in one.changes
                    ],
                    "restored": list(one.restored),
                    "lost": list(one.lost),
                }
                for one in self.remedies()
            ],
        }

    def __str__(self) -> str:
        from casadi_engine.identifiability.summary import summary

        return summary(self)

    def _repr_html_(self) -> str:
        from casadi_engine.identifiability.summary import html_summary

        return html_summary(self)


@one_blas_thread
def identifiability(
    model: Model,
    *,
    parameters: Parameters | None = None,
    inputs: Any = "generic",
    start: Any = "free",
    outputs: Sequence[str] | None = None,
    experiments: Sequence[Mapping[str, Any]] | None = None,
    combinations: Sequence[str] = (),
    seeds: int = 2,
    seed: int = 0,
) -> Identifiability:
    """Test exactly whether the free parameters can be told from the outputs, noise apart.

    parameters : which are free, fixed or tied; None for the model's defaults. Fixed ones count with their values
    inputs : how the drives behave, one word for all or drive -> word ("*" for the others): "generic" (known, rich),
        "constant", "zero", "unknown constant", "unknown polynomial" (or "unknown polynomial 3"), "unknown arbitrary"
    start : what is known of the initial states, one word for all or state -> word: "free", "known" (a generic
        value), "rest" (zero); for a state also a number, or an expression of parameters
    outputs : names of outputs, or of states as further sensors; None for all outputs of the model
    experiments : several experiments jointly, each a mapping of `inputs`, `start`, `outputs`, `name`; what is left
        out is as in the call. Parameters are shared, initial states are not
    combinations : expressions of parameters, such as "K21*J1", to be tested beside the parameters themselves
    seeds : random drawings that have to agree, >= 1. seed : the first of them

    The model's equations and their Jacobians are replayed on power series over a prime field: no rounding, so
    stiffness does not matter, and derivatives of any order come at no loss. A "yes" for all is a proof up to the
    relations of exp, sin and log; a "no" is wrong with at most `error_probability`. Raises IdentifiabilityError for
    unknown words and names, an output that depends on nothing, an operation without an exact rule (abs, if_else,
    min, max), and a start at which the equations have a pole; ExpressionError for a combination that cannot be read.
    Source: A. Sedoglavic, J. Symb. Comput. 33 (2002); thesis (2.27) to (2.29).

    >>> import casadi_engine as ce
    >>> two_mass = ce.two_mass(reciprocating_speed="measured")
    >>> found = ce.identifiability(two_mass, inputs="zero", combinations=["(C_eng + C_el)/J_eng + C_el/J_load"])
    >>> found.rank, found.size, found.directions, list(found.combinations.values())
    (6, 8, 3, [True])
    >>> print(found.symmetries[0])
    J_eng, J_load, K_el, C_el, C_eng times s, for any s > 0
    >>> print(found.remedies()[0])
    excite T_1 (now zero): restores all
    """
    began = time.process_time()
    question = read_question(
        model, parameters=parameters, inputs=inputs, start=start, outputs=outputs, experiments=experiments
    )
    texts = _texts(combinations)
    drawings = _agreed(question, _seeds(seeds), _first_seed(seed))
    told = dict.fromkeys(texts, True)
    for drawn in drawings:
        for text, good in zip(texts, _combinations(question, drawn, texts), strict=True):
            told[text] &= good
    return answer(question, drawings, told, began)


def answer(
    question: Question, drawings: Sequence[Drawn], combinations: Mapping[str, bool], began: float
) -> Identifiability:
    """The result of drawings that agree; `began` is the process time [s] at which the work began."""
    first = drawings[0]
    names = question.initial + question.free
    determined = np.all([drawn.identifiable for drawn in drawings], axis=0)
    orders = max(drawn.orders for drawn in drawings)
    return Identifiability(
        model=question.model,
        parameters=question.parameters,
        rank=first.rank,
        size=len(names),
        identifiable=MappingProxyType(dict(zip(names, map(bool, determined), strict=True))),
        directions=len(first.parameter_rows),
        symmetries=symmetries(drawings, names),
        combinations=MappingProxyType(dict(combinations)),
        order=max(drawn.order for drawn in drawings),
        orders=orders,
        final=first.rank == len(names) or not (question.special or question.arbitrary),
        error_probability=error_probability(question, orders, first.rank),
        seeds=len(drawings),
        seconds=time.process_time() - began,
        question=question,
        drawings=tuple(drawings),
    )


def _agreed(question: Question, seeds: int, seed: int) -> list[Drawn]:
    """Drawings with the highest rank seen: a lower one is bad luck, and is drawn again."""
    found: list[Drawn] = []
    tried = 0
    while len(found) < seeds and tried < seeds + _MOST_SEEDS:
        drawn = draw(question, seed + tried)
        tried += 1
        if found and (drawn.rank, len(drawn.parameter_rows)) != (found[0].rank, len(found[0].parameter_rows)):
            if drawn.rank < found[0].rank:
                continue
            found = []
        found.append(drawn)
    return found


def _combinations(question: Question, drawn: Drawn, texts: Sequence[str]) -> list[bool]:
    """For each combination: is its gradient one that the outputs determine?"""
    if not texts:
        return []
    wanted = {f"the combination {text}": text for text in texts}
    point = drawn.point[drawn.states :]
    _, gradients = gradients_at(question.equations[0], wanted, drawn.values, point)
    space = drawn.null_space[drawn.states :]
    product = drawn.field.product(gradients, space) if space.shape[1] else np.zeros((len(texts), 0))
    return [not row.any() for row in product]


def _texts(combinations: Any) -> tuple[str, ...]:
    if isinstance(combinations, str):
        return (combinations,)
    made = tuple(combinations) if isinstance(combinations, Iterable) else (combinations,)
    for one in made:
        if not isinstance(one, str):
            raise IdentifiabilityError(
                "a combination is not text",
                seen=repr(one),
                allowed='expressions of parameter names, such as "K21*J1"',
                cure="put it in quotes",
            )
    return tuple(dict.fromkeys(made))


def _seeds(seeds: Any) -> int:
    if isinstance(seeds, bool) or not isinstance(seeds, int) or not 1 <= seeds <= _MOST_SEEDS:
        raise IdentifiabilityError(
            "the number of seeds is not acceptable",
            seen=repr(seeds),
            allowed=f"1 to {_MOST_SEEDS}",
            cure="two are enough: the chance of an error is multiplied with each",
        )
    return seeds


def _first_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise IdentifiabilityError(
            "the first seed is not acceptable",
            seen=repr(seed),
            allowed="a whole number >= 0",
            cure="leave seed out",
        )
    return int(seed)
