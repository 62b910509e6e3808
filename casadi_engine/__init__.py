"""casadi-engine: grey-box identification of engine-load systems in CasADi."""

__version__ = "0.1.0"
