"""The package is imported whole before any room of it is collected: `ce.identifiability` is a function there.

pytest would else import the room of that name first, and leave the module in the function's place.
"""

import casadi_engine  # noqa: F401
