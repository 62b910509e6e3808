"""What a command prints in place of Python: the next command to type, the file to look at."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

# How paragraphs begin that speak to the user; their later lines are indented.
_SPOKEN = ("Next: ", "Note: ")
_IN_PYTHON = "in Python"


def in_shell(
    text: str, *, problem: Path, folder: Path | None, tested: bool | None = None, repaired: bool = False
) -> str:
    """The text of a result with its notes and next steps in the words of the command line.

    problem : the problem file; folder : of the result that holds the values, None where the problem file does; tested :
    whether the tests on fresh records passed, None where there were none; repaired : whether the fit is one of a
    repaired model, which `casadi-engine fit` does not know
    """
    from casadi_engine.estimation.summary import wrapped

    said = []
    for paragraph in _paragraphs(text.splitlines()):
        if not paragraph[0].startswith(_SPOKEN):
            said += paragraph
            continue
        words = " ".join(line.strip() for line in paragraph)
        for phrase, others in _phrases(problem, folder, tested, repaired):
            words = re.sub(phrase, others, words)
        said += wrapped(words, "      ")
    return "\n".join(said)


def _paragraphs(lines: list[str]) -> list[list[str]]:
    """Lines in groups: what is spoken with the lines that go on with it, every other line by itself."""
    found: list[list[str]] = []
    spoken = False
    for line in lines:
        if spoken and line.startswith("    ") and line.strip():
            found[-1].append(line)
            continue
        found.append([line])
        spoken = line.startswith(_SPOKEN)
    return found


def _phrases(
    problem: Path, folder: Path | None, tested: bool | None, repaired: bool
) -> list[tuple[str, str | Callable[[re.Match[str]], str]]]:
    """Patterns, and what stands in their place."""

    def command(name: str, more: str = "") -> str:
        source = "" if folder is None else f" --from {folder}"
        return f"casadi-engine {name} {problem}{source}{more}"

    def posterior(said: re.Match[str]) -> str:
        return f"{said[1]}, {_IN_PYTHON}" if repaired else f"casadi-engine fit {problem} --posterior"

    validate, simulate = command("validate", " --data FRESH.csv"), command("simulate")
    fresh = {
        None: f"test it on data it has not seen: {validate}",
        True: f"use it: {simulate}",
        False: "see below what the fresh records say of it",
    }[tested]
    return [
        (r"test it on data it has not seen: print\(ce\.validate\(fit, fresh\)\)", lambda _: fresh),
        (r"go on with repair\.fit, the repaired model: print\(repair\.fit\)",
         lambda _: f"go on with the repaired model: {validate}, or {simulate}"),
        (r"keep it: ce\.report\(validation, \"report\.html\"\)", lambda _: f"use it: {simulate}"),
        (r",? ?ce\.report\(repair, 'repair\.html'\)", " in report.html"),
        (r"look at the residual: ce\.plot\(validation\)", "look at the residual in report.html"),
        (r"it says what the model lacks", lambda _: f"casadi-engine repair {problem} looks for what the model lacks"),
        (r"look at the curves: ce\.plot\(profile\)", "look at the curves in report.html"),
        (r"repeat with starts=(\d+)", r"repeat with starts=\1 in the problem file"),
        (r", starts=8,", ", starts=8 in the problem file,"),
        (r"(?:print\()?(ce\.posterior\((?:repair\.)?fit\))\)?", posterior),
        (r"(ce\.estimate\([^()]*\))", rf"\1, {_IN_PYTHON}"),
        (r"(\d+) more in repair\.messages", r"\1 more in result.json, messages"),
        (r"repair\.fit is the best model", "result.json holds the best model"),
        (r", or ce\.repair\(\.\.\., fresh=other_record\)", ""),
        (r"ce\.repair\(\.\.\., effects=\[\.\.\.\]\)", "--effects NAME"),
        (r"ce\.profile\(fit\)", lambda _: f"casadi-engine identify {problem} --profiles"),
    ]  # fmt: skip
