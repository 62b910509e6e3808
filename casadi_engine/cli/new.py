"""``casadi-engine new``: a problem file to start from."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from casadi_engine.cli.job import ANSWERED, guarded, say
from casadi_engine.cli.options import Debug
from casadi_engine.errors import OutputError, ProblemError

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the problem; writes NAME.py.")]
Equations = Annotated[
    bool, typer.Option("--equations", help="For a system of your own equations, in place of an engine.")
]


def new(name: Name, equations: Equations = False, debug: Debug = False) -> None:
    """Write a commented problem file NAME.py that runs on a data file of yours; nothing is overwritten."""
    raise typer.Exit(guarded("new", lambda: _work(name, equations), debug=debug))


def _work(name: str, equations: bool) -> int:
    path = write_template(name, equations=equations)
    shown = os.fspath(path)
    say(
        f"Written: {shown}\n"
        f"Next: casadi-engine fit {shown} --data YOUR_RECORD.csv\n"
        "The file says what the record holds, and which lines to change."
    )
    return ANSWERED


def _is_module(name: str) -> bool:
    """True if a module of Python or of an installed package has this name."""
    import importlib.machinery

    here = {"", os.getcwd()}
    places = [place for place in sys.path if place not in here]
    spec = importlib.machinery.PathFinder.find_spec(name, places)
    # a folder alone, as of results, has no file to load
    return name in sys.stdlib_module_names or (spec is not None and spec.origin is not None)


def write_template(name: str, *, equations: bool = False) -> Path:
    """Write the template, of an engine or of any equations, as NAME.py (NAME may have folders before it, which must be
    there).

    ProblemError for a name that is not acceptable, OutputError for a file that is there or cannot be made.
    """
    import importlib.resources

    from casadi_engine.problem import NAME

    path = Path(name if name.endswith(".py") else f"{name}.py")
    if not NAME.fullmatch(path.stem):
        raise ProblemError(
            "the name of the new problem is not acceptable",
            seen=repr(name),
            allowed="up to 100 letters A-Z a-z, digits, _ and -, not starting with -",
            cure="give a name such as my_engine",
        )
    if _is_module(path.stem):
        raise ProblemError(
            "the name of the new problem is that of a Python module, which the file would stand in the way of",
            seen=path.stem,
            allowed="a name that no installed module has",
            cure="give a name such as my_engine",
        )
    template = "template_equations.txt" if equations else "template.txt"
    resource = importlib.resources.files("casadi_engine.cli") / template
    text = resource.read_text(encoding="utf-8").replace("{{name}}", path.stem)
    try:
        # Mode x: a file that appears in this very moment is not overwritten either.
        with open(path, "x", encoding="utf-8", newline="\n") as stream:
            try:
                stream.write(text)
            except OSError:
                with contextlib.suppress(OSError):
                    path.unlink()
                raise
    except FileExistsError:
        raise OutputError(
            f"{path}: there is a file of that name already",
            allowed="a name that is not taken; nothing is overwritten",
            cure="give another name, or move that file away",
        ) from None
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written",
            seen=error.strerror or str(error),
            cure="give a name in a folder that is there and may be written",
        ) from None
    return path
