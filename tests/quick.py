"""Which of many parameters the quick run takes; the command for long studies has the others."""

import pytest


def few(values, *kept):
    """The values, of which those that are not kept are slow; a tuple stands for several parameters."""
    found = []
    for one in values:
        several = one if isinstance(one, tuple) else (one,)
        found.append(one if one in kept else pytest.param(*several, marks=pytest.mark.slow))
    return found
