"""Command line: one thin file a command."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence

from casadi_engine.errors import MissingDependencyError

NEEDED = ("typer", "rich", "jinja2")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``casadi-engine`` with `arguments` (left out: those of the process) and return its exit code.

    0 answered, 1 negative with --check, 2 the input is at fault, 3 no answer, 4 our bug, 130 interrupted.
    """
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        error = MissingDependencyError(
            "the command line needs packages that are not installed",
            seen=f"without {', '.join(missing)}",
            cure="pip install 'casadi-engine[app]'",
        )
        print(f"casadi-engine: {error}", file=sys.stderr)
        return error.exit_code
    from casadi_engine.cli.app import app

    try:
        app(args=arguments if arguments is None else list(arguments), prog_name="casadi-engine")
    except SystemExit as end:  # typer ends every call so, also after --help and wrong options
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0
