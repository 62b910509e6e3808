"""Models: symbolic equations of motion, their ports, builders, modes and printed form."""
