"""The benchmark scripts import one another by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

# These need packages that the tests' environment has not.
collect_ignore = ["opponent_lmfit.py", "opponent_jax_sysid.py"]
