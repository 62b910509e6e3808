"""The package is imported whole before any room of it is collected: `ce.identifiability` is a function there.

pytest would else import the room of that name first, and leave the module in the function's place.
"""

import os

# Two test processes share the cores; a second thread of the BLAS libraries would only spin.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import casadi_engine  # noqa: E402, F401
