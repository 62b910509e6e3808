"""Records of small linear models whose posterior is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_engine as ce
