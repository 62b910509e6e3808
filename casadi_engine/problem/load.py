"""load_problem: the Problem that a user's file defines."""

from __future__ import annotations

import hashlib
import importlib.machinery
import importlib.util
import os
import sys
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from casadi_engine.errors import CasadiEngineError, ProblemError
from casadi_engine.problem.blame import line_in, shown
from casadi_engine.problem.problem import Problem


def load_problem(path: str | os.PathLike[str]) -> Problem:
    """Run a problem file and return what its function ``problem()`` returns.

    The file runs as a module of its own with a private name; nothing is written beside it. Relative paths
    of records in it are taken from its own folder. Raises ProblemError for a file that is missing or is no
    Python file, that has no function ``problem()``, that raises anything (the message names its line), or
    that returns something else than a Problem.
    """
    source = _checked_path(path)
    module = _run(source)
    make = getattr(module, "problem", None)
    if not callable(make):
        raise ProblemError(
            f"{shown(source)}: the file has no function problem()",
            seen="none" if make is None else f"problem = {make!r}",
            allowed="a function without arguments that returns a Problem",
            cure="add `def problem(): return ce.Problem(...)`; `casadi-engine new NAME` writes an example",
        )
    try:
        made = make()
    except (Exception, SystemExit) as error:
        raise _failure(source, error) from error
    if not isinstance(made, Problem):
        raise ProblemError(
            f"{shown(source)}, line {_line_of(make)}: problem() does not return a Problem",
            seen=type(made).__name__ if made is not None else "None",
            allowed="a Problem",
            cure="end the function with `return ce.Problem(...)`",
        )
    return made.located(source)


def _checked_path(path: Any) -> Path:
    cure = "give the path of a problem file; `casadi-engine new NAME` writes one"
    try:
        source = Path(os.fsdecode(path)).absolute()
        found, folder = source.exists(), source.is_dir()
    except (TypeError, ValueError, OSError):
        raise ProblemError("not the path of a problem file", seen=repr(path), cure=cure) from None
    if not found:
        raise ProblemError(f"{path}: no such problem file", cure=cure)
    if folder:
        raise ProblemError(f"{path}: a folder, not a problem file", cure=cure)
    if source.suffix != ".py":
        raise ProblemError(
            f"{path}: a problem file is a Python file", seen=source.name, allowed="NAME.py", cure=cure
        )
    return source


# Names of the modules that problem files become; no other process can import them.
MODULE_PREFIX = "_casadi_engine_problem_"


class _Loader(importlib.machinery.SourceFileLoader):
    """Reads the source itself every time: no stale bytecode, and no __pycache__ in the user's folder."""

    def get_code(self, fullname: str) -> CodeType:  # noqa: ARG002  the name is the interface's
        return self.source_to_code(self.get_data(self.path), self.path)


def _run(source: Path) -> ModuleType:
    # Dataclasses and annotations in the file look their module up, so it is registered, under a name that
    # no other module has; the hash tells files of one name in two folders apart.
    digest = hashlib.sha256(os.fsencode(source)).hexdigest()[:16]
    name = f"{MODULE_PREFIX}{digest}"
    spec = importlib.util.spec_from_file_location(name, source, loader=_Loader(name, str(source)))
    if spec is None or spec.loader is None:
        raise ProblemError(f"{shown(source)}: Python cannot load this file", cure="check the file")
    module = importlib.util.module_from_spec(spec)
    before = sys.modules.get(name)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        if before is None:
            del sys.modules[name]
        else:
            sys.modules[name] = before
        if isinstance(error, (Exception, SystemExit)):
            raise _failure(source, error) from error
        raise  # an interrupt by the user is no fault of the file
    return module


def _failure(source: Path, error: BaseException) -> ProblemError:
    """The error of a file that raised, with the line of that file."""
    line = line_in(source, error)
    place = shown(source) if line is None else f"{shown(source)}, line {line}"
    if isinstance(error, CasadiEngineError):
        return ProblemError(
            f"{place}: {error.problem}", seen=error.seen, allowed=error.allowed, cure=error.cure
        )
    if isinstance(error, SyntaxError):
        code = (error.text or "").strip()
        return ProblemError(
            f"{place}: this is not Python",
            seen=f"{error.msg}: {code}" if code else str(error.msg),
            cure="correct this line",
        )
    if isinstance(error, OSError) and line is None:
        return ProblemError(
            f"{place}: the file cannot be read", seen=str(error), cure="check its permissions"
        )
    if isinstance(error, ModuleNotFoundError):
        return ProblemError(
            f"{place}: the file imports a module that is not there",
            seen=str(error.name),
            allowed="installed modules; a problem file stands alone and does not import files beside it",
            cure="install the module, or put its code into the problem file",
        )
    words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return ProblemError(f"{place}: the problem file raised an error", seen=words, cure="correct this line")


def _line_of(function: Any) -> int | str:
    code = getattr(function, "__code__", None)
    return code.co_firstlineno if code is not None else "?"
