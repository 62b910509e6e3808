"""Verbs run the BLAS libraries that are loaded, or will be, on one thread, and give the others back."""

import os
import subprocess
import sys

import numpy as np
import pytest

from casadi_engine import blas_threads
from casadi_engine.blas_threads import VARIABLES, one_blas_thread


class Library:
    """What a library of BLAS says of its threads."""

    def __init__(self, count):
        self.count = count

    def put(self, count):
        self.count = count

    def get(self):
        return self.count


@pytest.fixture
def library(monkeypatch):
    made = Library(4)
    monkeypatch.setattr(blas_threads, "_loaded", lambda: [(made.put, made.get)])
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    return made


def test_one_thread_while_a_verb_runs_and_those_before_afterwards(library):
    @one_blas_thread
    def verb(depth):
        inside = library.count, os.environ.get("OPENBLAS_NUM_THREADS")
        return [inside, *(verb(depth - 1) if depth else [])]

    assert verb(2) == [(1, "1")] * 3
    assert library.count == 4
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_threads_come_back_after_an_error(library):
    @one_blas_thread
    def verb():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        verb()
    assert library.count == 4


def test_what_the_environment_says_stands(library, monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    assert one_blas_thread(lambda: library.count)() == 4


def test_the_libraries_of_numpy_and_scipy_are_found():
    """In a new process, as this one has its environment set."""
    code = (
        "import numpy, scipy.linalg\n"
        "from casadi_engine.blas_threads import _loaded, one_blas_thread\n"
        "print(len(_loaded()), one_blas_thread(lambda: {get() for _, get in _loaded()})())"
    )
    own = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    told = subprocess.run([sys.executable, "-c", code], env=own, capture_output=True, text=True, check=True)
    count, threads = told.stdout.split(maxsplit=1)
    if "openblas" not in str(np.show_config("dicts")["Build Dependencies"]["blas"]["name"]):
        pytest.skip("NumPy has another BLAS here")
    assert int(count) >= 1
    assert threads.strip() == "{1}"
