"""The tables of problems and the tests that run them import one another by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
