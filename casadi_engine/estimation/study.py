"""A study: one function of many pieces, in several processes if asked, that goes on where it was stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from casadi_engine.errors import StudyError
from casadi_engine.estimation.checkpoint import Checkpoint, key_of
from casadi_engine.estimation.parallel import spread

Piece = Any
Row = Any


def study(
    work: Callable[[Piece], Row],
    pieces: Sequence[Piece],
    *,
    name: str = "study",
    setting: Any = None,
    jobs: int | None = 1,
    checkpoint: Path | str | None = None,
    watch: Callable[[int, int], Any] | None = None,
) -> list[Row]:
    """The rows work(piece) of all pieces, in the pieces' order.

    work : a function of one piece whose result JSON can hold; it is called once for each different piece
    pieces : data that JSON can hold and that say all that a row depends on, such as {"variant": "ties", "seed": 7}
    name, setting : of the study; what all pieces share and a row depends on (a version, the truth)
    jobs : 1 for this process, more for so many of joblib's, None for what ``joblib.parallel_config`` says
    checkpoint : a file into which every finished piece is written at once; a study that finds it does what is not done
    watch : called with (pieces done, pieces in all) whenever one is finished

    Raises StudyError for a checkpoint or pieces that cannot be used, MissingDependencyError without joblib, and what
    ``work`` raises; the pieces finished before are kept.

    >>> study(lambda piece: piece["seed"] ** 2, [{"seed": 2}, {"seed": 3}])
    [4, 9]
    """
    if not callable(work) or not (watch is None or callable(watch)):
        raise StudyError(
            f"the {'watch' if callable(work) else 'work'} of a study is not a function",
            seen=repr(watch if callable(work) else work),
            allowed="work(piece) -> row; watch(pieces done, pieces in all), or none",
            cure="give a function",
        )
    if isinstance(pieces, (str, Mapping)) or not isinstance(pieces, Iterable):
        raise StudyError(
            "the pieces of a study are not a sequence",
            seen=repr(pieces),
            allowed="a sequence of data that JSON can hold",
            cure='give a list such as [{"seed": 0}, {"seed": 1}]',
        )
    pieces = list(pieces)
    keys = [key_of(piece) for piece in pieces]
    with nullcontext() if checkpoint is None else Checkpoint(checkpoint, name, setting) as kept:
        rows: dict[str, Row] = {} if kept is None else dict(kept.rows)
        left = {key: piece for key, piece in zip(keys, pieces, strict=True) if key not in rows}
        order, total = list(left), len(set(keys))
        if watch is not None:
            watch(total - len(left), total)
        finished = spread(work, list(left.values()), jobs=jobs)
        for count, (k, row) in enumerate(finished, total - len(left) + 1):
            key = order[k]
            rows[key] = row if kept is None else kept.add(left[key], row)
            if watch is not None:
                watch(count, total)
        return [rows[key] for key in keys]
