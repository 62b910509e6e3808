"""Hidden physical terms in systems of many kinds: true equations by SciPy, and ``ce.repair`` by its public verb."""
