"""The list of all small models, in the order of their files."""

import models_circuits  # noqa: F401 (each file adds its cases to the list)
import models_forcing  # noqa: F401
import models_friction  # noqa: F401
import models_life  # noqa: F401
import models_machines  # noqa: F401
from small_case import CASES

__all__ = ["CASES"]
