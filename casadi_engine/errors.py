"""Named exceptions: each message says what was wrong, the value seen, what is allowed and what to do."""

from __future__ import annotations

from typing import Any

# Characters of what was seen that a message shows: of a posterior with its draws they were thirty thousand.
_SHOWN = 1000


def _shown(seen: Any) -> str:
    text = seen if isinstance(seen, str) else repr(seen)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN].rstrip()} … ({type(seen).__name__})"


class CasadiEngineError(Exception):
    """Base of every error that this package raises on purpose.

    Parameters
    ----------
    problem : what was wrong, one clause without a full stop
    seen : the value that was found (any object; shown by ``repr`` unless it is text)
    allowed : what would have been accepted
    cure : what the user can do next

    The class attribute ``exit_code`` is the process exit code of the command line.
    """

    exit_code = 2

    def __init__(
        self, problem: str, *, seen: Any = None, allowed: str | None = None, cure: str | None = None
    ):
        self.problem, self.seen, self.allowed, self.cure = problem, seen, allowed, cure
        parts = [problem]
        if seen is not None:
            parts.append(f"seen: {_shown(seen)}")
        if allowed is not None:
            parts.append(f"allowed: {allowed}")
        if cure is not None:
            parts.append(f"do: {cure}")
        super().__init__("; ".join(parts))


class ParameterError(CasadiEngineError):
    """A parameter's value, bound, prior or name is not acceptable."""


class ExpressionError(ParameterError):
    """A text expression of a tie or constraint could not be read."""


class TieError(ParameterError):
    """A tie refers to an unknown name, closes a cycle, or meets a fixed parameter."""


class ConstraintError(ParameterError):
    """A constraint is malformed or cannot be met within the bounds."""


class ExperimentError(CasadiEngineError):
    """An experiment's channels do not fit together or lack something that is needed."""


class UnitError(ExperimentError):
    """A unit is not known or not of the kind needed."""


class DataFileError(ExperimentError):
    """A data file breaks the data contract; the message names file, column and row."""


class ModelError(CasadiEngineError):
    """A model definition is inconsistent, or asked for something that it does not have."""


class EffectError(ModelError):
    """An effect breaks the protocol, or does not fit the port or the model that it was given."""


class SimulationError(CasadiEngineError):
    """A simulation could not be carried out."""


class ProblemError(CasadiEngineError):
    """A problem file could not be loaded or does not define a problem."""


class EstimationError(CasadiEngineError):
    """An estimation was asked for with options that do not fit."""


class NoValueError(EstimationError):
    """A model has no value where a search ended."""


class NotIdentifiableError(EstimationError):
    """The data leave directions of the free parameters undetermined."""


class PosteriorError(EstimationError):
    """A posterior was asked for that does not exist, or with options that do not fit."""


class UntrustedPosteriorError(PosteriorError):
    """The draws of a posterior do not agree, or are too few: they are no answer."""

    exit_code = 3


class StudyError(EstimationError):
    """A study's pieces or its checkpoint cannot be used."""


class IdentifiabilityError(CasadiEngineError):
    """A question about identifiability names something unknown, or the exact test cannot answer it."""


class NotConvergedError(EstimationError):
    """The solver stopped without an answer."""

    exit_code = 3


class ResultError(CasadiEngineError):
    """A stored result could not be read, or does not fit what was asked of it."""


class UnknownNameError(CasadiEngineError, KeyError):
    """A result has nothing of that name."""

    __str__ = Exception.__str__  # that of a KeyError shows the text as a literal


class OutputError(CasadiEngineError):
    """A result could not be written."""


class MissingDependencyError(CasadiEngineError):
    """An optional package is needed and not installed."""
