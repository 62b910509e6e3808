"""The application ``casadi-engine``: its commands and what they share."""

from __future__ import annotations

from typing import Annotated

import typer

from casadi_engine import __version__
from casadi_engine.cli.fit import fit
from casadi_engine.cli.identify import identify
from casadi_engine.cli.new import new
from casadi_engine.cli.repair import repair
from casadi_engine.cli.simulate import simulate
from casadi_engine.cli.validate import validate

EXIT_CODES = (
    "Exit: 0 answered · 1 negative, only with --check · 2 the input is at fault, nothing written · "
    "3 no answer · 4 a bug of this program · 130 interrupted, best so far written."
)

# Plain help and plain errors: they go into logs and scripts, and every message is one of ours.
app = typer.Typer(
    name="casadi-engine",
    help="Grey-box identification of engine-load systems from measured records.",
    epilog=EXIT_CODES,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in (simulate, fit, identify, validate, repair, new):
    app.command(epilog=EXIT_CODES)(command)


def _version(asked: bool) -> None:
    if asked:
        print(__version__)
        raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and stop.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Grey-box identification of engine-load systems from measured records."""
