"""Parameters: values, bounds, ties, constraints, priors and their map to the vector that is estimated."""
