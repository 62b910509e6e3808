"""What a kind of system has to say of itself, and the tasks that are made of it.

A kind is one file ``kind_NAME.py`` with ``KIND``. Its tasks and nulls follow from its name and a number alone.
"""

from __future__ import annotations

import importlib.util
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import casadi_engine as ce

HERE = Path(__file__).parent
TASKS, NULLS = 20, 140
SNRS = (20, 30, 40, 20, 10)
NOISES = ("white", "coloured", "quantised", "white")
# Free parameters and sizes of terms differ from one task to the next by up to this factor either way; a user's start
# values are off by 20 to 50 %.
_VARIED, _OFF = 1.2, (0.2, 0.5)


@dataclass(frozen=True)
class Hidden:
    """A true effect that may be deleted from the model.

    amplitude : true size, in the unit of the effect's amplitude; nuisance : true values of its nuisance parameters,
        "event" for the instant at which something happens in a record
    effect, at : what writes the true structure, by ``model.with_effect``; None where the library has no such effect
    wrong : the fixed parameter that is wrong by the share `amplitude`, "" for none: ``parameter_NAME.wrong_value``
    right : answers that count as right, ``port.effect``, shell patterns allowed; the term's own name always does
    needs : outputs without which nothing is seen of it; unseen : manoeuvres in which nothing is seen of it
    """

    amplitude: float
    effect: Any = None
    at: str = ""
    nuisance: Mapping[str, Any] = field(default_factory=dict)
    right: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    wrong: str = ""

    @property
    def in_library(self) -> bool:
        """True if an answer can name it."""
        return self.effect is not None or bool(self.wrong)


@dataclass(frozen=True)
class Manoeuvre:
    """Times [s] (N,), inputs by name (N,), and the true states at the start.

    event : when a load comes or goes, if one does [s]: another instant in every record, as it is in life
    """

    time: np.ndarray
    inputs: Mapping[str, np.ndarray]
    start: tuple[float, ...]
    event: float = float("nan")

    @classmethod
    def of(
        cls,
        rng: np.random.Generator,
        time: np.ndarray,
        inputs: Mapping[str, np.ndarray],
        start: Sequence[float],
    ) -> Manoeuvre:
        """A manoeuvre with an event somewhere in its middle half."""
        event = float(time[0] + rng.uniform(0.25, 0.75) * (time[-1] - time[0]))
        return cls(time, inputs, tuple(start), event)


@dataclass(frozen=True)
class Kind:
    """A kind of system.

    truth : true values of the model's parameters by name, the fixed ones too
    terms : name -> Hidden; choices : the sets of terms that are deleted, ``a`` or ``a+b``, and ``a|b`` for a hidden
        where b is true and in the model too
    model : outputs -> the model as a user would write it, without any of the terms
    outputs : choices of what is measured, the full one first
    course : (values, manoeuvre) -> output -> noise-free values (N,), and inputs that come of the motion; values hold
        `truth` and by their names the amplitudes of the terms that are there; "states" -> (N, n or more), the
        model's states first, for rivals that are given them
    manoeuvres : name -> (rng -> Manoeuvre); pairs : (to find it on, fresh)
    units : unit of every channel        effects : what `repair` is given; None for the library
    absent : declared parameters that may be 0 in truth
    """

    name: str
    sentence: str
    truth: Mapping[str, float]
    terms: Mapping[str, Hidden]
    choices: tuple[str, ...]
    model: Callable[[tuple[str, ...]], Any]
    outputs: tuple[tuple[str, ...], ...]
    course: Callable[[Mapping[str, float], Manoeuvre], Mapping[str, np.ndarray]]
    manoeuvres: Mapping[str, Callable[[np.random.Generator], Manoeuvre]]
    pairs: tuple[tuple[str, str], ...]
    units: Mapping[str, str]
    effects: Callable[[], Sequence[Any]] | None = None
    absent: tuple[str, ...] = ()


@dataclass(frozen=True)
class Task:
    """One record to repair, and what is true of it.

    deleted : terms that are true and not in the model; declared : terms that are true and in it
    absent : a parameter of the model that is 0 in truth, "" for none
    """

    kind: str
    number: int
    deleted: tuple[str, ...]
    declared: tuple[str, ...]
    absent: str
    snr: int
    noise: str
    outputs: tuple[str, ...]
    pair: tuple[str, str]

    @property
    def null(self) -> bool:
        return not self.deleted

    @property
    def label(self) -> str:
        """What is hidden, in a word."""
        words = "+".join(self.deleted) or "null"
        words += "".join(f"|{one}" for one in self.declared)
        return words + (f"|no {self.absent}" if self.absent else "")

    @property
    def key(self) -> str:
        return f"{self.kind}/{self.label}/{self.snr}/{self.number}"

    def rng(self, what: str) -> np.random.Generator:
        """A generator of its own for each purpose, the same on every machine."""
        word = f"{self.kind}/{'null' if self.null else 'task'}/{self.number}/{what}"
        return np.random.default_rng(zlib.crc32(word.encode()))


def tasks_of(kind: Kind) -> list[Task]:
    """The tasks of a kind; any first part of them holds all SNRs and choices in turn."""
    return [_task(kind, number, kind.choices[number % len(kind.choices)]) for number in range(TASKS)]


def nulls_of(kind: Kind) -> list[Task]:
    """The nulls of a kind: nothing deleted; every third has a term of the library in truth and in the model."""
    known = [name for name, one in kind.terms.items() if one.effect is not None]
    return [
        _task(kind, number, f"|{known[number // 3 % len(known)]}" if number % 3 == 2 and known else "")
        for number in range(NULLS)
    ]


def _task(kind: Kind, number: int, choice: str) -> Task:
    deleted, _, declared = choice.partition("|")
    turn = number + number // len(kind.choices)
    there = [one for one in choice.replace("|", "+").split("+") if one]
    needed = {name for one in there for name in kind.terms[one].needs}
    # a term of a sensor needs its sensor
    needed |= {one.partition(".")[0].removeprefix("sensor_") for one in there if one.startswith("sensor_")}
    unseen = {name for one in there for name in kind.terms[one].unseen}
    pairs = [pair for pair in kind.pairs if pair[0] not in unseen]
    ways = [way for way in kind.outputs if needed <= set(way)]
    return Task(
        kind.name,
        number,
        tuple(one for one in deleted.split("+") if one),
        tuple(one for one in declared.split("+") if one),
        kind.absent[number % len(kind.absent)] if kind.absent and number % 5 == 4 else "",
        SNRS[turn % len(SNRS)],
        NOISES[turn // 2 % len(NOISES)],
        ways[turn % len(ways)],
        pairs[turn % len(pairs)],
    )


def true_values(kind: Kind, task: Task, free: Sequence[str]) -> dict[str, float]:
    """Parameters and amplitudes of a task's plant: those that are `free` in the model, and the terms, are its own."""
    rng = task.rng("plant")
    factor = {name: _VARIED ** rng.uniform(-1, 1) for name in sorted({*kind.truth, *kind.terms})}
    values = {name: value * (factor[name] if name in free else 1.0) for name, value in kind.truth.items()}
    there = {*task.deleted, *task.declared}
    values |= {name: one.amplitude * factor[name] for name, one in kind.terms.items() if name in there}
    return values | ({task.absent: 0.0} if task.absent else {})


def start_values(kind: Kind, task: Task, free: Sequence[str]) -> dict[str, float]:
    """What a user starts from: 20 to 50 % off the true ones, or off the usual ones of what is absent."""
    values = true_values(kind, task, free)
    rng = task.rng("start values")
    found = {}
    for name in sorted(free):
        off = 1 + rng.choice((-1, 1)) * rng.uniform(*_OFF)
        found[name] = float(off * (values[name] if values.get(name) else kind.truth[name]))
    return found


@cache
def load_kinds(*, sealed: bool = False) -> dict[str, Kind]:
    """The kinds of this folder by name, those that are kept sealed only if asked for."""
    files = sorted(HERE.glob("kind_*.py")) + (sorted(HERE.glob("sealed/kind_*.py")) if sealed else [])
    found = {}
    for file in files:
        spec = importlib.util.spec_from_file_location(f"hidden_terms_{file.stem}", file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        found[module.KIND.name] = module.KIND
    return found


def with_own(*effects: Any) -> list[Any]:
    """The library and a kind's own effects, which come before those of the library with their names."""
    names = [one.name for one in effects]
    return [*(one for one in ce.effects.library() if one.name not in names), *effects]
