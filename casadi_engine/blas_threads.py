"""One thread for the BLAS libraries while a verb runs.

Matrices of a fit are small: a second thread spins more than it works, and on a machine that lends fewer cores than it
shows, a repair takes ten times as long. The command sets this in its environment; a script may have imported NumPy
before this package, so that its libraries are asked to change their mind, and asked again in the end.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
# Packages that bring a library of their own, and where their wheels keep it.
_PACKAGES, _FOLDERS = ("numpy", "scipy"), ("../{}.libs", ".dylibs", "../{}/.libs")
# Names of OpenBLAS's functions, by how it was built.
_PREFIXES, _SUFFIXES = ("scipy_", ""), ("64_", "", "_64_")

_lock = threading.Lock()
_running = 0
_before: list[tuple[Callable[[int], None], int]] = []
_unset: list[str] = []


def one_blas_thread(verb: Callable[P, R]) -> Callable[P, R]:
    """The same function with one thread for BLAS; where the environment says how many, that stands."""

    @functools.wraps(verb)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _one_thread():
            return verb(*args, **kwargs)

    return limited


@contextmanager
def _one_thread() -> Iterator[None]:
    global _running
    with _lock:
        _running += 1
        if _running == 1 and not any(name in os.environ for name in VARIABLES):
            _limit()
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            if _running == 0:
                _restore()


def _limit() -> None:
    """Libraries that are there by their functions, those that are loaded later by the environment."""
    for put, get in _loaded():
        _before.append((put, get()))
        put(1)
    _unset.extend(VARIABLES)
    os.environ.update(dict.fromkeys(VARIABLES, "1"))


def _restore() -> None:
    for put, count in _before:
        put(count)
    for name in _unset:
        os.environ.pop(name, None)
    _before.clear()
    _unset.clear()


def _loaded() -> list[tuple[Callable[[int], None], Callable[[], int]]]:
    """Set and get the number of threads, of each library of a package that is imported."""
    return [one for name in _PACKAGES if name in sys.modules for one in _of_package(name)]


@functools.cache
def _of_package(name: str) -> tuple[tuple[Callable[[int], None], Callable[[], int]], ...]:
    root = Path(str(sys.modules[name].__file__)).parent
    files = [file for folder in _FOLDERS for file in (root / folder.format(name)).glob("*openblas*")]
    found = []
    for file in files:
        try:
            library = ctypes.CDLL(str(file))
        except OSError:  # a file of that name that is none: the library keeps its threads
            continue
        put, get = _function(library, "set"), _function(library, "get")
        if put is not None and get is not None:
            put.argtypes, put.restype, get.argtypes, get.restype = [ctypes.c_int], None, [], ctypes.c_int
            found.append((put, get))
    return tuple(found)


def _function(library: ctypes.CDLL, verb: str) -> Any:
    names = (f"{prefix}openblas_{verb}_num_threads{suffix}" for prefix in _PREFIXES for suffix in _SUFFIXES)
    return next((getattr(library, name) for name in names if hasattr(library, name)), None)
