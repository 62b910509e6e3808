"""Which of many parameters the quick run takes; the command for long studies has the others."""

import pytest


def few(values, *kept):
    """The values, of which those that are not kept are slow."""
    return [one if one in kept else pytest.param(one, marks=pytest.mark.slow) for one in values]
