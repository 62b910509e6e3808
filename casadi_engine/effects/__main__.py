"""``python -m casadi_engine.effects`` prints the library."""

from casadi_engine.effects import table

if __name__ == "__main__":
    print(table())
