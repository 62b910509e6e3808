"""Problem: everything that a command needs to know of one system, as one immutable object."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from casadi_engine.errors import CasadiEngineError, ProblemError
from casadi_engine.experiment import Experiment, read_experiment, with_unique_names
from casadi_engine.experiment.source import record_key
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, near_matches
from casadi_engine.problem.blame import line_in, shown
from casadi_engine.problem.noise import Noise

Record = str | os.PathLike[str] | Experiment

# The name becomes part of a folder's name (results/<name>-<command>) on every operating system.
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,99}")


@dataclass(frozen=True, eq=False)
class Problem:
    """A model with its parameters, the records to fit and to validate on, and how to read them.

    name : letters, digits, _ and -; the default output folder is results/<name>-<command>
    goal : what is asked of the data, in the user's words; a problem file gives its docstring
    model, parameters : the model and a set that holds all of its parameters; a frozen copy of the set is kept
    read : path -> Experiment; also serves the files given by --data and --validate
    records, validation : paths of data files, or experiments; files are read only when they are needed, by
        `load_records` and `load_validation`
    noise : Noise; left out, the level of every output is estimated
    initial : None (free, started from the measurement), or state -> number (fixed), (low, high) or "free"; or
        record -> such a mapping
    interval, loss, ties, method, starts : options of `estimate`, which checks them
    source : the file that the problem was loaded from, or None

    Raises ProblemError for a part that does not fit; the message names it.
    """

    name: str
    goal: str
    model: Model
    parameters: Parameters
    read: Callable[[Any], Experiment] = read_experiment
    records: tuple[Record, ...] = ()
    validation: tuple[Record, ...] = ()
    noise: Noise = dataclasses.field(default_factory=Noise)
    initial: Mapping[str, Any] | None = None
    interval: Any = "auto"
    loss: Any = "square"
    ties: str = "substitute"
    method: str = "exact"
    starts: int = 1
    source: Path | None = None

    def __post_init__(self) -> None:
        _check_name(self.name)
        _check_kind(self.goal, str, "goal", "text", "give goal=__doc__ and begin the file with a docstring")
        _check_kind(
            self.model, Model, "model", "a Model", "call a builder such as ce.two_mass() or Blueprint.model()"
        )
        _check_kind(self.parameters, Parameters, "parameters", "Parameters", "start from model.parameters()")
        _check_parameters(self.model, self.parameters)
        if not callable(self.read):
            raise ProblemError(
                "the problem's read is not a function",
                seen=repr(self.read),
                allowed="a function path -> Experiment",
                cure="give read=ce.read_experiment, or your own function that calls it",
            )
        _check_kind(self.noise, Noise, "noise", "Noise", 'write noise=ce.Noise(omega="estimate")')
        _check_names(self.noise.outputs, self.model.outputs, "noise", "an output", self.model)
        _check_initial(self.initial, self.model)
        object.__setattr__(self, "records", _record_tuple(self.records, "records"))
        object.__setattr__(self, "validation", _record_tuple(self.validation, "validation"))
        object.__setattr__(self, "parameters", self.parameters.frozen())

    # ---- records

    def load_records(self) -> tuple[Experiment, ...]:
        """Read the records to fit; a repeated file stem gets ``stem_2``.

        ProblemError if there are none, or if `read` fails or returns something else; errors of the data
        files themselves come through as they are.
        """
        if not self.records:
            raise ProblemError(
                f"the problem {self.name} has no records",
                seen="records=()",
                allowed="one data file or more",
                cure="give --data FILE on the command line, or list files as records= in the problem file",
            )
        return with_unique_names(self._read_one(record) for record in self.records)

    def load_validation(self) -> tuple[Experiment, ...]:
        """Read the records to validate on, none if the problem has none; errors as in `load_records`."""
        return with_unique_names(self._read_one(record) for record in self.validation)

    def _read_one(self, record: Record) -> Experiment:
        if isinstance(record, Experiment):
            return record
        place = f"read({os.fspath(record)!r})"
        try:
            experiment = self.read(record)
        except CasadiEngineError:
            raise
        except Exception as error:  # user code may raise anything
            raise ProblemError(
                f"{self._place(error)}{place} failed",
                seen=f"{type(error).__name__}: {error}",
                allowed="a function that returns an Experiment",
                cure="correct read in the problem file",
            ) from error
        if not isinstance(experiment, Experiment):
            raise ProblemError(
                f"{self._place(None)}{place} returned something else than an Experiment",
                seen=type(experiment).__name__,
                allowed="Experiment",
                cure="end read with `return ce.read_experiment(path, ...)`",
            )
        return experiment

    def _place(self, error: BaseException | None) -> str:
        if self.source is None:
            return ""
        line = None if error is None else line_in(self.source, error)
        return f"{shown(self.source)}{'' if line is None else f', line {line}'}: "

    def initial_of(self, experiments: Iterable[Experiment]) -> dict[str, Any] | None:
        """The `initial` that concerns these experiments, without settings of the problem's other records."""
        if self.initial is None:
            return None
        others = {*record_keys(self.records), *record_keys(self.validation)}
        others -= {experiment.name for experiment in experiments}
        return {key: value for key, value in self.initial.items() if key not in others} or None

    # ---- changed copies

    def with_data(self, files: Iterable[Record] = (), validate: Iterable[Record] = ()) -> Problem:
        """The problem on other records, as --data and --validate have it.

        files : replace the records; then the validation records, which belong to the old ones, go too
        validate : replace the validation records
        """
        files, validate = _record_tuple(files, "records"), _record_tuple(validate, "validation")
        if not files and not validate:
            return self
        made = dataclasses.replace(self, records=files or self.records, validation=validate)
        if self.initial is None:
            return made
        # Settings of a record that is no longer there would name nothing.
        gone = {*record_keys(self.records), *record_keys(self.validation)}
        gone -= {*record_keys(made.records), *record_keys(made.validation)}
        kept = {key: value for key, value in self.initial.items() if key not in gone}
        return dataclasses.replace(made, initial=kept or None)

    def with_parameters(self, parameters: Parameters) -> Problem:
        """The problem with another parameter set."""
        return dataclasses.replace(self, parameters=parameters)

    def located(self, source: Path) -> Problem:
        """The problem as loaded from a file: relative records are taken from the folder of that file."""
        folder = source.parent
        return dataclasses.replace(
            self,
            source=source,
            records=tuple(_from_folder(folder, record) for record in self.records),
            validation=tuple(_from_folder(folder, record) for record in self.validation),
        )

    def __str__(self) -> str:
        def files(records: tuple[Record, ...]) -> str:
            names = [r.name if isinstance(r, Experiment) else os.path.basename(os.fspath(r)) for r in records]
            return ", ".join(names) or "(none)"

        first = next((line for line in self.goal.splitlines() if line.strip()), "")
        return (
            f"{self.name}: {first.strip()}\nmodel       {self.model.name}: {self.model.description}\n"
            f"records     {files(self.records)}\nvalidation  {files(self.validation)}\n"
            f"noise       {self.noise!r}\n\n{self.parameters}"
        )

    __repr__ = __str__


def record_keys(records: Iterable[Record]) -> tuple[str, ...]:
    """The keys that records will have when they are read by file stem; a repeat gets ``stem_2``.

    >>> record_keys(["a/run.csv", "b/run.csv.gz"])
    ('run', 'run_2')
    """
    stems = [r.name if isinstance(r, Experiment) else record_key(os.fsdecode(os.fspath(r))) for r in records]
    keys: list[str] = []
    for stem in stems:
        # As with_unique_names does it: a number that no other record's own stem has taken.
        numbered = (f"{stem}_{number}" for number in range(2, 2 * len(stems) + 2))
        keys.append(stem if stem not in keys else next(key for key in numbered if key not in (*keys, *stems)))
    return tuple(keys)


def _from_folder(folder: Path, record: Record) -> Record:
    return record if isinstance(record, Experiment) else folder / record


def _check_name(name: object) -> None:
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise ProblemError(
            "the problem's name is not acceptable",
            seen=repr(name),
            allowed="up to 100 letters A-Z a-z, digits, _ and -, not starting with -",
            cure='give a name such as name="two_mass"; it becomes part of a folder name',
        )


def _check_kind(value: object, kind: type, field: str, allowed: str, cure: str) -> None:
    if not isinstance(value, kind):
        raise ProblemError(
            f"the problem's {field} is of the wrong kind",
            seen=type(value).__name__,
            allowed=allowed,
            cure=cure,
        )


def _check_parameters(model: Model, parameters: Parameters) -> None:
    missing = [name for name in model.parameter_names if name not in parameters]
    if missing:
        raise ProblemError(
            f"the problem's parameters lack ones of the model {model.name}",
            seen=f"without {', '.join(missing)}",
            allowed=f"a set with {', '.join(model.parameter_names)}",
            cure="start from model.parameters() of this very model, or use parameters.extended(model)",
        )


def _check_names(names: Iterable[Any], known: Iterable[Any], field: str, what: str, model: Model) -> None:
    allowed = [variable.name for variable in known]
    for name in names:
        if name not in allowed:
            raise ProblemError(
                f"the problem's {field} names {what} that the model {model.name} does not have",
                seen=repr(name),
                allowed=near_matches(name, allowed),
                cure="correct the name; print(model.table()) lists them",
            )


def _check_initial(initial: object, model: Model) -> None:
    if initial is None:
        return
    if not isinstance(initial, Mapping):
        raise ProblemError(
            "the problem's initial is of the wrong kind",
            seen=type(initial).__name__,
            allowed="a mapping from state to value, or None",
            cure=f'write initial={{"{model.states[0].name}": 0.5}}, for instance',
        )
    for key, value in initial.items():
        # A mapping inside is the settings of one record, which is known by name only when it is read.
        names = value if isinstance(value, Mapping) else (key,)
        _check_names(names, model.states, "initial", "a state", model)


def _record_tuple(records: object, field: str) -> tuple[Record, ...]:
    if isinstance(records, (str, os.PathLike, Experiment)):
        return (records,)
    found = tuple(records) if isinstance(records, Iterable) else (records,)
    for record in found:
        if not isinstance(record, (str, os.PathLike, Experiment)) or (
            isinstance(record, str) and not record.strip()
        ):
            raise ProblemError(
                f"an entry of the problem's {field} is not a record",
                seen=repr(record),
                allowed="the path of a data file, or an Experiment",
                cure="give a list of paths",
            )
    return found
