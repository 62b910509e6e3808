"""``python -m casadi_engine`` is the command ``casadi-engine``."""

import sys

from casadi_engine.cli import main

if __name__ == "__main__":
    sys.exit(main())
