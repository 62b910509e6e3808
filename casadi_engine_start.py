"""Where the command ``casadi-engine`` begins: ready for Ctrl-C before the package is imported.

It lies beside the package because importing anything inside one imports the package first.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

# Matrices of a fit are small: a second thread of the BLAS libraries spins more than it works, and takes a core from
# --jobs. They read their environment when they are loaded; what the user has set stands.
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
    """Import the package and run its command line; return the exit code, 130 if interrupted before it could begin."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    # A job in the background may have Ctrl-C ignored: then it stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)
    from casadi_engine import cli

    return cli.main()


def _stop(_number: int, _frame: Any) -> None:
    """End at once: half-imported packages are in no state to be taken down in order."""
    os.write(2, b"casadi-engine: interrupted before there was anything to write\n")
    os._exit(130)


_stop.until_a_command_begins = True  # type: ignore[attr-defined]


if __name__ == "__main__":
    sys.exit(main())
