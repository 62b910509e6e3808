"""Two test processes share the cores; a second thread of the BLAS libraries would only spin."""

import gc
import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# What is collected stays until the end: a third of the time of its collection went into looking for garbage in it.
gc.disable()


def pytest_collection_finish():
    gc.freeze()
    gc.enable()
